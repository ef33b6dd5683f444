"""What all packages use: files and guards, configuration, options, progress, workers, Lightning."""

"""What all rooms use: files and guards, configuration, options, progress, workers, Lightning."""

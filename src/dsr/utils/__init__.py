"""What every part of the package uses: files, hashes, the console, what Lightning is told."""

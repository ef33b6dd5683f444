"""Utilities of the whole package: files, hashes, the console, Lightning."""

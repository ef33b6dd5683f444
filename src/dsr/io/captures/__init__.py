"""Readers of the captures of phone apps, depth cameras and robots, one module for each layout."""

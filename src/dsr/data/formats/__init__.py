"""Readers of the original formats of data sets, a module each; each reads a frame as a Scene."""

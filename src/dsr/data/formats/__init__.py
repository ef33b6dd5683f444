"""The native file formats of data sets: a module each, one frame in, one Scene out."""

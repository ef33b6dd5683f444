"""Data sets, a module each, with readers of their formats, preparation and download."""

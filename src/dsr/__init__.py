"""Guided depth super-resolution, trained, run and judged by how the surface looks."""

__version__ = "0.1.0"

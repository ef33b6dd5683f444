"""Metrics of depth maps and of their renderings."""

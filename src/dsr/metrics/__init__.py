"""Metrics of depth maps and of their renderings, and the losses that use the same kernels."""

"""Metrics of depth maps and of their renderings, and the losses that share their kernels."""

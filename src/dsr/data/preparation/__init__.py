"""Preparation of scenes: resizing, cropping, inpainting, dequantization."""

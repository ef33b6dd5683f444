"""Scenes made ready: resized, cropped, inpainted, freed of quantization."""

"""Frames with one picture of colour and depth each, as other programs read them."""

"""Weights of our own networks; README.md beside them is their card."""

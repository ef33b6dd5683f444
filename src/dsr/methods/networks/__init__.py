"""Trained networks, and the readers of their weights."""

"""Perceptual study: a page of questions for participants, and the percentages of their answers."""

"""The perceptual study: a page that people answer, and the percentages of their answers."""

"""Predictions to files, scores from files, and what runs left in their directories."""

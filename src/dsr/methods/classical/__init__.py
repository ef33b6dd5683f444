"""Methods without training: interpolation, filters, variational methods."""

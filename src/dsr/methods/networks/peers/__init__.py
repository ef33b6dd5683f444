"""Networks that others published for guided depth super-resolution, with their authors' weights."""

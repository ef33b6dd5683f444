"""Super-resolution methods, one module each."""

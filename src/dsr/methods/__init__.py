"""Super-resolution methods: one module each, all of them Upsamplers."""

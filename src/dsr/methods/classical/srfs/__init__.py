"""SRfS: super-resolution by shape from shading (Haefner et al. 2018)."""

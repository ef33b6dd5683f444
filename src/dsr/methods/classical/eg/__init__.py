"""EG: edge-guided super-resolution of depth alone (Xie et al. 2016)."""

"""Deep image priors: depth maps as the output of a network that is optimised for one image."""

"""Everything that makes a low-resolution depth map out of a high-resolution one: downsampling, noise, holes."""

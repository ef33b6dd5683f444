"""Data sets: each module reads one and yields DepthSamples."""

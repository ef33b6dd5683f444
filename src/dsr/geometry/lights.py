"""The names of the paper's four lights; :mod:`dsr.geometry.shading` has their directions."""

LIGHT_NAMES: tuple[str, ...] = ("e1", "e2", "e3", "e4")

"""Choices of an upsampling and their defaults, in a module that imports nothing heavy."""

from typing import Literal

DEFAULT = "facets"  # the method where none is chosen
USUAL_SCALE = 4
Fill = Literal["all", "small", "none"]  # which holes are filled
# Degrees of view of the widest hole that counts as small. On Middlebury 2014 and ICL-NUIM with holes cut into them,
# depth that ``facets`` fills in is off by 1.2 % on average at 0.2 to 0.4 degrees from a measured pixel, by 3 % at 0.7
# to 1 degree, and by 6 % and more beyond; half of these pixels are off by more than 2 %.
WIDEST = 2.0
SIZES = (1, 2, 4, 8, 16)  # by what the size of a sensor's map may be divided before it is worked on

"""``dsr doctor``: checks of the depth maps and cameras of scenes, with advice on how to correct them."""

from dsr.doctor.examine import examine_directory

__all__ = ["examine_directory"]

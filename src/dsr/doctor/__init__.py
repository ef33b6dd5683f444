"""``dsr doctor``: what looks wrong with the depth and the cameras of scenes, and what to do about it."""

from dsr.doctor.examine import examine_directory

__all__ = ["examine_directory"]

"""Which app made a capture, by what lies in its folder."""

from __future__ import annotations

from pathlib import Path

from dsr.io.captures.arkitscenes import find_arkitscenes
from dsr.io.captures.polycam import find_polycam
from dsr.io.captures.record3d import find_record3d
from dsr.io.captures.ros import find_ros
from dsr.io.captures.stray import find_stray
from dsr.io.pairs import PairingResult

CAPTURE_FILES = (".r3d", ".bag")
"""Suffixes of captures that are a single file."""
_LAYOUTS = (find_stray, find_record3d, find_polycam, find_arkitscenes, find_ros)


def find_capture(place: Path) -> PairingResult | None:
    """Return the frames of a capture, a folder or a file with one of :data:`CAPTURE_FILES`; None if it is none.

    Raises:
        ValueError: it is a capture, and a file that all of its frames need is missing or damaged.

    """
    layouts = (find_record3d, find_ros) if place.is_file() else _LAYOUTS
    return next((found for layout in layouts if (found := layout(place)) is not None), None)

"""Guided depth super-resolution, trained, run and judged by how the surface looks.

>>> import dsr
>>> camera = dsr.Camera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)

and ``dsr.upsample(photo, depth, camera)``, see :func:`dsr.inference.api.upsample`; ``dsr.upsample_with_errors`` also
says how far off the result may be, and ``dsr.Upsampler`` keeps the weights for many frames.
``dsr.compose("eval", ["method=facets"])`` composes the configuration of a command, whose nodes
:func:`hydra.utils.instantiate` makes.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import dsr.utils.threads  # noqa: F401 - for forks

if TYPE_CHECKING:
    from dsr.app.composition import compose
    from dsr.geometry.camera import Camera
    from dsr.inference.api import Upsampler, upsample, upsample_with_errors
    from dsr.io.files import read, read_depth

__version__ = "0.1.0"
__all__ = ["Camera", "Upsampler", "__version__", "compose", "read", "read_depth", "upsample", "upsample_with_errors"]

_HOMES = {
    "Camera": "dsr.geometry.camera",
    "Upsampler": "dsr.inference.api",
    "compose": "dsr.app.composition",
    "read": "dsr.io.files",
    "read_depth": "dsr.io.files",
    "upsample": "dsr.inference.api",
    "upsample_with_errors": "dsr.inference.api",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for: ``import dsr`` alone loads nothing heavy."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """List the names that are imported when asked for, too."""
    return sorted({*globals(), *__all__})

"""Guided depth super-resolution: training, upsampling, and evaluation by the look of the surface.

>>> import dsr
>>> camera = dsr.Camera.from_fov(60, width=640, height=480)

``dsr.read`` and ``dsr.read_depth`` read files, ``dsr.upsample(photo, depth, camera)`` gives depth of the photo's size,
and ``dsr.Upsampler`` a ``dsr.Surface`` with its normals, renderings, mesh and expected errors, see docs/python.md.
``dsr.compose("eval", ["method=facets"])`` composes the configuration of a command, whose nodes
:func:`hydra.utils.instantiate` makes.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dsr.app.schema import compose
    from dsr.app.upsample.api import Upsampler, upsample
    from dsr.app.upsample.surface import Surface
    from dsr.geometry.camera import Camera
    from dsr.io.files import read, read_depth

__version__ = "0.1.0"
__all__ = ["Camera", "Surface", "Upsampler", "__version__", "compose", "read", "read_depth", "upsample"]

_HOMES = {
    "Camera": "dsr.geometry.camera",
    "Surface": "dsr.app.upsample.surface",
    "Upsampler": "dsr.app.upsample.api",
    "compose": "dsr.app.schema",
    "read": "dsr.io.files",
    "read_depth": "dsr.io.files",
    "upsample": "dsr.app.upsample.api",
}


def __getattr__(name: str) -> Any:
    """Import what is asked for: ``import dsr`` alone loads nothing heavy."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """List the names that are imported when asked for, too."""
    return sorted({*globals(), *__all__})

"""The names of what is written."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence

PARTS = ("depth", "renderings", "normals", "cloud", "mesh", "before_after", "confidence", "input")
"""What is written unless something else is asked for."""
MORE_PARTS = ("rgbd", "open3d", "nerfstudio", "gaussian", "rerun")
"""What is written if it is asked for; all but the first are of all frames, see :mod:`dsr.app.upsample.scene`."""
SCENE_PARTS = MORE_PARTS[1:]
FORMATS = ("png", "tiff", "npy", "npz", "pfm", "exr")


def check_libraries(parts: Sequence[str]) -> None:
    """Check that the libraries of some parts are installed.

    Raises:
        ValueError: one is not.

    """
    if "rerun" in parts and importlib.util.find_spec("rerun") is None:
        raise ValueError("--with rerun: expected the library rerun-sdk, which `pip install dsr[rerun]` installs")

"""Rendered scenes and their cache."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from platformdirs import user_cache_path

from dsr.geometry.camera import Camera
from dsr.sample import Scene
from dsr.utils.arrays import read_arrays
from dsr.utils.files import replacing
from dsr.utils.guards import parse_json


@dataclass(frozen=True)
class Rendering:
    """An rgb image with exact depth.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) float64 orthogonal depth in metres.
        camera: camera of both.

    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float64]
    camera: Camera

    def scene(self, dataset: str, name: str) -> Scene:
        """Return the rendering as a scene of a data set."""
        rgb = torch.from_numpy(self.rgb).permute(2, 0, 1).float() / 255
        return Scene(dataset, name, rgb, self.camera, torch.from_numpy(self.depth)[None])


def load_or_render(path: Path, make: Callable[[], Rendering]) -> Rendering:
    """Return the rendering at ``path`` in the cache directory; if there is none, make it and store it there.

    A damaged file is replaced. If the cache cannot be written, the rendering is made each time.
    """
    path = cache_directory() / path
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # missing or damaged
        kept = read_arrays(path)
        return Rendering(kept["rgb"], kept["depth"], Camera(**parse_json(str(kept["camera"]))))
    rendering = make()
    with contextlib.suppress(OSError), replacing(path) as temporary:
        camera = json.dumps(asdict(rendering.camera))
        np.savez_compressed(temporary, rgb=rendering.rgb, depth=rendering.depth, camera=camera)
    return rendering


def cache_directory() -> Path:
    """Return the directory for files that can be made again: $DSR_CACHE, else the platform's, such as ~/.cache/dsr."""
    if "DSR_CACHE" in os.environ:
        return Path(os.environ["DSR_CACHE"]).expanduser()
    return user_cache_path("dsr", appauthor=False)

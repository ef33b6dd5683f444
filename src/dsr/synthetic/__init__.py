"""Rendered scenes: ray casters, the SimGeo scenes, and random scenes to train on."""

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
from dsr.utils.console import note_once, printable
from dsr.utils.files import replacing
from dsr.utils.guards import expect_memory, parse_json

_BYTES = 150  # least memory that a pixel takes while a scene is made; random ones take four times as much


@dataclass(frozen=True)
class Rendering:
    """An rgb image with exact orthogonal depth in metres, and their camera."""

    rgb: NDArray[np.uint8]  # (H, W, 3)
    depth: NDArray[np.float64]  # (H, W)
    camera: Camera

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        came = (self.rgb.dtype, self.rgb.shape, self.depth.dtype, self.depth.shape)
        if came != (np.uint8, (*size, 3), np.float64, size):
            raise ValueError(f"expected rgb and depth of {size} pixels, got {came}")

    def scene(self, dataset: str, name: str) -> Scene:
        """Return the rendering as a scene of a data set."""
        rgb = torch.from_numpy(self.rgb).permute(2, 0, 1).float() / 255
        return Scene(dataset, name, rgb, self.camera, torch.from_numpy(self.depth)[None])


def load_or_render(path: Path, make: Callable[[], Rendering]) -> Rendering:
    """Return the rendering at ``path`` in the cache directory; make it if it lacks or is damaged, and store it."""
    path = cache_directory() / path
    try:
        kept = read_arrays(path)
        return Rendering(kept["rgb"], kept["depth"], Camera(**parse_json(str(kept["camera"]))))
    except OSError:
        pass  # there is none
    except (ValueError, KeyError, TypeError):
        note_once(f"{printable(str(path))}: damaged, so it is made again")
    rendering = make()
    with contextlib.suppress(OSError), replacing(path) as temporary:
        camera = json.dumps(asdict(rendering.camera))
        np.savez_compressed(temporary, rgb=rendering.rgb, depth=rendering.depth, camera=camera)
    return rendering


def expect_room_for(size: int) -> None:
    """Refuse a height and width of scenes that is too small, or that this machine has too little memory to make."""
    if size < 32:
        raise ValueError(f"size: expected at least 32 pixels, got {size}")
    expect_memory("size", size, _BYTES * size**2)


def cache_directory() -> Path:
    """Return the directory for files that can be made again: $DSR_CACHE, else the platform's, such as ~/.cache/dsr."""
    if "DSR_CACHE" in os.environ:
        return Path(os.environ["DSR_CACHE"]).expanduser()
    return user_cache_path("dsr", appauthor=False)

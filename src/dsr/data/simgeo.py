"""``dataset=simgeo``: the paper's geometric scenes, rendered here, and a statue.

The paper's own files are not needed. Its sixth scene, Lucy, takes the statue's place where ``root/lucy`` holds it in
the layout of :mod:`dsr.data.folder`. Renderings are kept in a cache: $DSR_CACHE, else $XDG_CACHE_HOME/dsr or
~/.cache/dsr.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from dsr.atomic import read_arrays, replacing
from dsr.data.base import chosen
from dsr.data.folder import Folder
from dsr.data.simgeo_scenes import SCENES, SCENES_VERSION, Rendering, render_scene
from dsr.geometry.camera import Camera
from dsr.sample import Scene


class SimGeo:
    """The SimGeo scenes.

    Args:
        root: where ``lucy`` may lie; None or a missing directory for the statue instead.
        scenes: names of the ones to use; None for all.
        size: height and width in pixels; the paper's are 512.

    Raises:
        ValueError: an unknown scene or a size below 32.

    """

    name = "simgeo"

    def __init__(self, root: str | None = None, scenes: Sequence[str] | None = None, size: int = 512) -> None:
        if size < 32:
            raise ValueError(f"dataset.size: expected at least 32 pixels, got {size}")
        self._size = size
        self._lucy: Folder | None = None
        available = list(SCENES)
        if root is not None and (Path(root).expanduser() / "lucy").is_dir():
            self._lucy = Folder(root, ["lucy"], self.name)
            available[available.index("statue")] = "lucy"
        self._scenes = chosen(available, scenes)

    def scenes(self) -> list[str]:
        """Return the names of the scenes, in order."""
        return list(self._scenes)

    def load(self, scene: str) -> Scene:
        """Return one scene; see :class:`dsr.data.base.SceneSource`."""
        if scene == "lucy" and self._lucy is not None:
            return self._lucy.load(scene)
        rendering = _cached(scene, self._size)
        rgb = torch.from_numpy(rendering.rgb).permute(2, 0, 1).float() / 255
        return Scene(self.name, scene, rgb, rendering.camera, torch.from_numpy(rendering.depth)[None])

    def fingerprint(self, scene: str) -> str:
        """Return the version of the renderings, or the SHA-256 of Lucy's files."""
        if scene == "lucy" and self._lucy is not None:
            return self._lucy.fingerprint(scene)
        return f"simgeo-v{SCENES_VERSION}-{self._size}"


def _cached(scene: str, size: int) -> Rendering:
    """Return a rendering from the cache, or make it and try to keep it."""
    path = cache_directory() / f"simgeo-v{SCENES_VERSION}-{size}" / f"{scene}.npz"
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):  # missing, damaged, without a key, a wrong one
        kept = read_arrays(path)
        return Rendering(kept["rgb"], kept["depth"], Camera(**json.loads(str(kept["camera"]))))
    rendering = render_scene(scene, size)
    with contextlib.suppress(OSError), replacing(path) as temporary:  # no room or no right to write: render again
        camera = json.dumps(asdict(rendering.camera))
        np.savez_compressed(temporary, rgb=rendering.rgb, depth=rendering.depth, camera=camera)
    return rendering


def cache_directory() -> Path:
    """Return where things that can be made again are kept."""
    if "DSR_CACHE" in os.environ:
        return Path(os.environ["DSR_CACHE"]).expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "dsr"

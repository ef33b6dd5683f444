"""Folders of a few small frames for ``dsr upsample``, and its results as values to compare."""

from __future__ import annotations

import json

import numpy as np
from PIL import Image

FRAMES = 7


def write_frames(folder, count=FRAMES, *, holes=2):
    """Write frames of millimetres; the first maps are all holes, so that the unit is guessed from a later one."""
    rng = np.random.default_rng(0)
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for number in range(count):
        Image.fromarray(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)).save(folder / "rgb" / f"{number:03}.png")
        depth = 5 + 900 * (number > holes) + np.arange(8)[None] * 10 + np.zeros((6, 1))
        Image.fromarray((depth * (number >= holes)).astype(np.uint16)).save(folder / "depth" / f"{number:03}.png")
    return folder


def results(output):
    """Return the content of all files of frames, by name, without times."""
    found = {}
    for path in sorted(output.rglob("*")):
        if path.is_file() and path.parent != output:
            content = path.read_bytes()
            if path.name == "info.json":
                content = {**json.loads(content), "seconds": None}
            found[str(path.relative_to(output))] = content
    return found

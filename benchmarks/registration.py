"""What ``dsr upsample --register`` finds on a pair of photo and depth map, as a picture of the edges before and after.

python benchmarks/registration.py --rgb PHOTO --depth MAP [--depth-unit UNIT] --picture FILE.jpg
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.geometry.registration import find_displacement, find_edges, undo
from dsr.io.inputs import read_picture
from dsr.io.pairs import Pair
from dsr.io.reading import Reading, parse_unit

_WIDTH = 560
_HOLE, _EDGE = (160, 60, 160), (0, 0, 255)
"""Colours, blue first."""


def drawn(rgb: Tensor, depth_lr: Tensor, title: str) -> np.ndarray:
    """Return the photo with the holes of a depth map tinted, and its steps drawn, (H, W, 3) uint8."""
    height = round(_WIDTH * rgb.shape[-1] ** -1 * rgb.shape[-2])
    size = (_WIDTH, height)
    photo = cv2.resize((255 * rgb.permute(1, 2, 0).numpy()[..., ::-1]).astype(np.uint8), size)
    depth = cv2.resize(depth_lr[0].double().numpy(), size, interpolation=cv2.INTER_NEAREST)
    holes = np.isnan(depth)
    photo[holes] = photo[holes] // 2 + np.array(_HOLE, np.uint8) // 2
    edges = find_edges(depth, 1, gap=12)
    for rows, columns in (edges.right.astype(int), edges.below.astype(int)):
        photo[rows, columns] = photo[rows, (columns + 1).clip(0, size[0] - 1)] = _EDGE
    bar = np.full((30, size[0], 3), 255, np.uint8)
    cv2.putText(bar, title, (6, 21), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack((bar, photo))


def main() -> None:
    """Register, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rgb", type=Path, required=True)
    parser.add_argument("--depth", type=Path, required=True)
    parser.add_argument("--depth-unit", default="mm")
    parser.add_argument("--picture", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    reading = Reading(unit=parse_unit(arguments.depth_unit))
    picture = read_picture(Pair("pair", arguments.rgb, arguments.depth), reading, {})
    found = find_displacement(picture.depth_lr, picture.rgb)
    print(found)
    if found is None:
        return
    after = undo(picture.depth_lr, found)
    columns = [
        drawn(picture.rgb, picture.depth_lr, "steps (red) and holes of the depth map, as it is"),
        drawn(picture.rgb, after, f"--register: {found}"),
    ]
    gap = np.full((columns[0].shape[0], 8, 3), 255, np.uint8)
    cv2.imwrite(str(arguments.picture), np.hstack((columns[0], gap, columns[1])), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()

"""Measure what upsampling a large photo costs, and whether its tiles show.

    OMP_NUM_THREADS=1 python benchmarks/tiling.py --shared DIR [--method facets_box] [--width 4000 --height 3000]

The picture is made of a real scene and its mirror images. Memory is the peak of the whole process. Seams: the largest
difference to the answer with tiles of another size, as a share of the range of inverse depth (with one answer instead
of the ensemble's mean, as it takes long), near the tiles' borders and elsewhere.
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

import torch
from torch import Tensor

from dsr.data.folder import Folder
from dsr.geometry.camera import Camera
from dsr.inference import upsample_depth
from dsr.methods.networks import base as network
from dsr.methods.registry import build_method, list_methods, read_method


def mirrored(values: Tensor, height: int, width: int) -> Tensor:
    """Return (C, H, W) continued by its mirror images to a size."""
    rows, columns = (_reflected(new, old) for new, old in ((height, values.shape[-2]), (width, values.shape[-1])))
    return values[:, rows][:, :, columns]


def _reflected(new: int, old: int) -> Tensor:
    index = torch.arange(new) % (2 * old)
    return torch.minimum(index, 2 * old - 1 - index)


def peak() -> float:
    """Return the most memory that this process has held, in GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, required=True, help="the folder that holds scenes/")
    parser.add_argument("--scene", default="plant")
    parser.add_argument("--method", default="facets_box", choices=list_methods())
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--width", type=int, default=4000)
    parser.add_argument("--height", type=int, default=3000)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seams", action="store_true", help="measure the seams, too")
    options = parser.parse_args()
    scene = Folder(str(options.shared / "scenes")).load(options.scene)
    height, width, scale = options.height, options.width, options.scale
    rgb = mirrored(scene.rgb.float(), height, width)
    depth = mirrored(scene.depth.float(), height, width)
    coarse = torch.nn.functional.avg_pool2d(depth.reciprocal(), scale).reciprocal()
    camera = Camera(width, height, scene.camera.fx, scene.camera.fy, width / 2, height / 2)
    del depth, scene
    before, start = peak(), time.perf_counter()
    upsample_depth(rgb, coarse, camera, scale, method=options.method, device=options.device)
    seconds = time.perf_counter() - start
    print(
        f"{options.method} x{scale}, {width} x {height}: {seconds:.0f} s, {peak():.2f} GB at most, {before:.2f} before"
    )
    if options.seams:
        seams(rgb, coarse.reciprocal(), options.method, scale, options.device)


def seams(rgb: Tensor, inverse: Tensor, method: str, scale: int, device: str) -> None:
    """Print how much answers with tiles of two sizes differ."""
    net = build_method(read_method(method, scale, {"ensemble": 1}), scale, device=device, precision="float32")
    rgb, inverse = rgb.to(device), inverse.to(device)
    with torch.inference_mode():
        usual = net.upsample_disparity(rgb[None], inverse[None])
        net.tile = network.TILE * 5 // 8
        other = net.upsample_disparity(rgb[None], inverse[None])
    off = (usual - other).abs() / (inverse.max() - inverse.min())
    print(f"largest difference of inverse depth: {float(off.max()):.1e} of its range, mean {float(off.mean()):.1e}")


if __name__ == "__main__":
    main()

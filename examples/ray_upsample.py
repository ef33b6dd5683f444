"""Upsample a folder of frames on a Ray cluster that sees it, or on this machine: one task for each frame.

python examples/ray_upsample.py FOLDER OUT FX FY CX CY

FOLDER has photos rgb/NAME.png and maps depth/NAME.png in millimetres, 0 in holes; OUT gets NAME.npy in metres.
"""

import sys
from pathlib import Path

import numpy as np
import ray

import dsr


@ray.remote(num_cpus=1, max_retries=3)  # add num_gpus=1 on a cluster with GPUs
def upsample_frame(photo: Path, target: Path, intrinsics: list[float]) -> None:
    rgb, depth = dsr.read(photo), dsr.read_depth(photo.parents[1] / "depth" / photo.name, unit="mm")
    camera = dsr.Camera(rgb.shape[1], rgb.shape[0], *intrinsics)
    np.save(target, dsr.upsample(rgb, depth, camera))


if __name__ == "__main__":
    folder, out, intrinsics = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve(), [float(v) for v in sys.argv[3:]]
    out.mkdir(exist_ok=True)
    ray.init()  # the cluster of $RAY_ADDRESS, or this machine
    photos = sorted((folder / "rgb").glob("*.png"))
    ray.get([upsample_frame.remote(photo, out / f"{photo.stem}.npy", intrinsics) for photo in photos])

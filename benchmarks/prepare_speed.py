"""How much faster scenes are ready when several are prepared at a time, and once they are kept.

    python benchmarks/prepare_speed.py [--scenes 4] [--height 1944] [--width 2880]

Made-up scenes in the format and size of Middlebury 2014 are resized and cropped to 512 x 512: one by one as they are
loaded, by ``prepare``, and loaded from the cache. The ratios of the times within the run are the result.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from dsr.data.middlebury import Middlebury


def write_scene(folder: Path, height: int, width: int, seed: int) -> None:
    """Write a scene of slanted stripes with holes."""
    folder.mkdir(parents=True)
    random = np.random.default_rng(seed)
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    disparity = (60 + 40 * (columns // 300 % 2) + 0.01 * rows + random.normal(0, 0.02, (height, width))).astype("<f4")
    disparity[random.random((height // 16, width // 16)).repeat(16, 0).repeat(16, 1) < 0.03] = np.inf
    header = f"Pf\n{width} {height}\n-1\n".encode()
    (folder / "disp0.pfm").write_bytes(header + disparity[::-1].tobytes())
    photo = random.integers(0, 256, (height // 8, width // 8, 3), np.uint8)
    cv2.imwrite(str(folder / "im0.png"), cv2.resize(photo, (width, height), interpolation=cv2.INTER_CUBIC))
    (folder / "calib.txt").write_text(
        f"cam0=[{width} 0 {width / 2}; 0 {width} {height / 2}; 0 0 1]\ndoffs=0\nbaseline=180\n"
        f"width={width}\nheight={height}\n"
    )


def seconds(action: Callable[[], object]) -> float:
    """Return how long an action takes."""
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--height", type=int, default=1944)
    parser.add_argument("--width", type=int, default=2880)
    options = parser.parse_args()
    size = options.height // 16 * 16, options.width // 16 * 16
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        for number in range(options.scenes):
            write_scene(root / "data" / f"scene{number}", *size, seed=number)
        data = Middlebury(str(root / "data"), "found", fill=[], without_offset=[])
        names = data.scenes()
        os.environ["DSR_CACHE"] = str(root / "one_by_one")
        one_by_one = seconds(lambda: [data.load(name) for name in names])
        os.environ["DSR_CACHE"] = str(root / "together")
        together = seconds(lambda: list(data.prepare(names)))
        kept = seconds(lambda: [data.load(name) for name in names])
    print(f"{options.scenes} scenes of {size[0]} x {size[1]}, {os.cpu_count()} processors")
    print(f"one by one            {one_by_one:.2f} s")
    print(f"prepared together     {together:.2f} s, {one_by_one / together:.2f} times as fast")
    print(f"loaded from the cache {kept:.3f} s, {one_by_one / kept:.2f} times as fast")


if __name__ == "__main__":
    main()

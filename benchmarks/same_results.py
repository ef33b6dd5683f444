"""Record what the commands compute, and compare a later state of the code with it, bit by bit.

    python benchmarks/same_results.py record before.json --scenes ../shared/scenes
    python benchmarks/same_results.py compare before.json --scenes ../shared/scenes

It runs ``eval.py`` with every method in ``conf/method`` at x4 and x8, short DIPs, noisy and holey inputs, a training of
60 steps and ``dsr upsample`` with everything written, each in a process of its own and with one thread, and stores a
digest of every array and file. It uses nothing but the command line, so that it also runs from an older checkout.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import torch
from safetensors.numpy import load_file

ROOT = Path.cwd()
SLOW = {"dip": ["method.steps=20"], "dip_v": ["method.steps=20"]}
UNTIMED = ("seconds", "versions")


def main() -> int:
    """Record or compare, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("record", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--scenes", type=Path, required=True, help="folder that holds plant/")
    parser.add_argument("--only", default="", help="only jobs whose name contains this")
    options = parser.parse_args()
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, command in jobs(options.scenes.resolve(), Path(folder)):
            if options.only in name:
                found |= {f"{name}: {key}": value for key, value in digests(name, command, Path(folder)).items()}
    if options.action == "record":
        options.file.write_text(json.dumps(found, indent=0, sort_keys=True) + "\n")
        print(f"{len(found)} digests")
        return 0
    before = {key: value for key, value in json.loads(options.file.read_text()).items() if options.only in key}
    changed = sorted(key for key in before.keys() | found.keys() if before.get(key) != found.get(key))
    for key in changed:
        print("missing" if key not in found else "new" if key not in before else "changed", key)
    print(f"{len(before)} digests, {len(changed)} differ")
    return 1 if changed else 0


def jobs(scenes: Path, folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the name and the command of each job; the results go to ``folder / name``."""
    plant = ["dataset=folder", f"dataset.root={scenes}", "dataset.scenes=[plant]", "metrics.lpips=false", "device=cpu"]
    python = [sys.executable, "eval.py"]
    weights = {"msg_v_noisy": (4,)}
    for path in sorted((ROOT / "conf" / "method").glob("*.yaml")):
        for scale in weights.get(path.stem, (4, 8)):
            name = f"{path.stem} x{scale}"
            more = [f"scale={scale}", f"method={path.stem}", *SLOW.get(path.stem, []), f"output_dir={folder / name}"]
            yield name, [*python, *plant, *more]
    for kind in ("noise=kinect", "noise=tof", "noise=gaussian_multiplicative", "holes=blobs", "holes=shadows"):
        for method in ("facets", "tgv", "bicubic"):
            name = f"{method} {kind.replace('=', ' ')}"
            yield name, [*python, *plant, kind, f"method={method}", f"output_dir={folder / name}"]
    for kind in ("nearest", "bilinear", "bicubic", "gaussian"):
        yield (
            f"msg_v {kind}",
            [*python, *plant, f"downsampling={kind}", "method=msg_v", f"output_dir={folder / f'msg_v {kind}'}"],
        )
    yield (
        "simgeo facets",
        [*python, "method=facets", "dataset.size=128", "metrics.lpips=false", f"output_dir={folder / 'simgeo facets'}"],
    )
    train = [
        sys.executable,
        "train.py",
        "dataset.count=6",
        "dataset.size=128",
        "trainer.max_steps=60",
        "patches.batch=2",
    ]
    train += [
        "model.scheduler.warmup=10",
        "trainer.val_check_interval=30",
        "patches.validation_scenes=1",
        "patches.patch=64",
    ]
    train += ["precision=float32", "metrics.lpips=false", "device=cpu"]
    for model in ("msg_v", "facets"):
        name = f"train {model}"
        yield name, [*train, f"model={model}", f"output_dir={folder / name}"]
    photo, depth = pictures(scenes / "plant", folder)
    for method in ("facets", "msg_v", "bicubic"):
        name = f"upsample {method}"
        command = [sys.executable, "-m", "dsr", "upsample", "--rgb", str(photo), "--depth", str(depth)]
        yield name, [*command, "--method", method, "-o", str(folder / name)]


def pictures(scene: Path, folder: Path) -> tuple[Path, Path]:
    """Write a photo and a 16-bit depth map in millimetres with a hole, and return their paths."""
    camera = json.loads((scene / "camera.json").read_text())
    disparity = torch.from_numpy(np.load(scene / "disparity.npy").astype(np.float64))
    coarse = torch.nn.functional.avg_pool2d(disparity[None, None], 4)[0, 0].numpy()
    depth = camera["baseline"] * (1e-3 if camera["baseline_unit"] == "mm" else 1) * camera["fx"] / coarse * 1e3
    depth[40:50, 60:72] = 0
    source = folder / "source"
    source.mkdir(exist_ok=True)
    photo = source / "plant.png"
    photo.write_bytes((scene / "rgb.png").read_bytes())
    cv2.imwrite(str(source / "plant_depth.png"), depth.round().astype(np.uint16))
    return photo, source / "plant_depth.png"


def digests(name: str, command: list[str], folder: Path) -> dict[str, str]:
    """Run a job and return the digests of what it computed."""
    print(name, end=" ", flush=True)
    threads = {"OMP_NUM_THREADS": "1", "DSR_CACHE": str(folder / "cache")}
    done = subprocess.run(command, cwd=ROOT, env=os.environ | threads, capture_output=True, text=True, check=False)
    print("ok" if done.returncode == 0 else f"exit {done.returncode}: {done.stderr.strip()[-300:]}", flush=True)
    found = {"exit": str(done.returncode)}
    for path in sorted(path for path in (folder / name).rglob("*") if path.is_file()):
        value = digest(path)
        if value is not None:
            found[str(path.relative_to(folder / name))] = value
    return found


def digest(path: Path) -> str | None:
    """Return the digest of a result; None of what holds times or versions."""
    content: bytes | None = None
    if path.name in {"scores.csv", "validation.csv"} or path.parent.name == "iterations":
        table = pd.read_csv(path)
        content = table.drop(columns=[name for name in table if "seconds" in name]).to_csv(index=False).encode()
    elif path.suffix == ".npz" and path.parent.name == "predictions":
        with np.load(path) as arrays:
            content = arrays["depth"].tobytes()
    elif path.suffix == ".npz" and path.parent.name == "scenes":
        with np.load(path) as arrays:
            content = b"".join(arrays[name].tobytes() for name in ("depth", "rgb", "depth_lr"))
    elif path.name == "weights.safetensors":
        content = b"".join(key.encode() + value.tobytes() for key, value in sorted(load_file(path).items()))
    elif path.name == "info.json":
        entries = {key: value for key, value in json.loads(path.read_text()).items() if key not in UNTIMED}
        content = json.dumps(entries, sort_keys=True).encode()
    elif path.suffix in (".npy", ".ply", ".glb", ".png") and path.parent.name != "pictures":
        content = path.read_bytes()
    return None if content is None else hashlib.sha256(content).hexdigest()[:16]


if __name__ == "__main__":
    sys.exit(main())

# Frozen: this measured once what the documentation says of it. It is not maintained.
"""How near the fused mesh of a sequence comes to the surface: F-score, accuracy and completeness, by what is fused.

    python docs/measurements/scripts/fusion.py [--size 192] [--scale 4] [--noise kinect] [--solids 4]
                                                [--procedural 0] [--step 0.1] [--points DIR]

On SimGeo's solids and on procedural scenes, rendered from the seven places of ``sequences.py`` with the noise of a
simulated sensor and exact poses. The ground truth is the points of all true depth maps at twice the size. Accuracy is the mean distance
from points on the mesh to the ground truth, completeness the one from the ground truth to points on the mesh; the
F-score is the harmonic mean of the shares within a limit (Knapitsch et al., Tanks and Temples, 2017).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import mean

import cv2
import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
import sequences
from sequences import NOISES, SOLIDS, Frame, rendered, solids, window


from dsr.app.upsample.stored import find_results, read_frame
from dsr.cli import main as dsr
from dsr.degradation.noise import Noise
from dsr.geometry.mesh import fuse_maps, suggest_voxel
from dsr.geometry.poses import PosedMap
from dsr.inference import upsample_surface
from dsr.inference.sequences import fuse_views
from dsr.io.posed_frames import _sample, sample_points
from dsr.methods.base import Surface

LIMITS = (0.05, 0.01, 0.005)
POINTS = 200_000


def posed(frame: Frame, surface: Surface, *, weighted: bool, certain: bool = True) -> PosedMap:
    """Return a result as ``dsr fuse`` reads it; not ``weighted`` or not ``certain``: without weights or that limit."""
    depth, error = (each[0].double().numpy() for each in (surface.depth, surface.depth_error))
    if certain:
        depth = np.where(error <= 0.02 * depth, depth, np.nan)
    return PosedMap(depth, frame.camera, frame.pose, error.clip(min=1e-4) if weighted else None)


def truth_of(frames: list[Frame]) -> np.ndarray:
    """Return points of all true depth maps in the world, (N, 3)."""
    found = []
    for frame in frames:
        points = (frame.truth[0].numpy() * frame.camera.rays().numpy()).reshape(3, -1).T
        found.append(points[np.isfinite(points).all(1)] @ frame.pose[:3, :3].T + frame.pose[:3, 3])
    every = np.concatenate(found)
    return every[np.random.default_rng(0).permutation(len(every))[:POINTS]]


def score(maps: list[PosedMap], voxel: float, truth: np.ndarray) -> list[float]:
    """Return the F-scores within the limits in percent, accuracy and completeness in millimetres."""
    mesh = fuse_maps(lambda: maps, voxel)
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points = trimesh.sample.sample_surface(shape, POINTS, seed=0)[0]
    near, far = cKDTree(truth).query(points)[0], cKDTree(points).query(truth)[0]
    shares = [((near < limit).mean(), (far < limit).mean()) for limit in LIMITS]
    return [*(200 * p * r / (p + r) for p, r in shares), 1e3 * near.mean(), 1e3 * far.mean()]


def measure(make: Callable[..., list[Frame]], scene: str | int, size: int, *more: object) -> dict[str, list[float]]:
    """Return the scores by what is fused."""
    frames, plain, alone, voted = make(scene, size, *more), [], [], []
    for number, frame in enumerate(frames):
        plain.append(upsample_surface(frame.rgb, frame.depth_lr, frame.camera, method="bicubic"))
        alone.append(upsample_surface(frame.rgb, frame.depth_lr, frame.camera, method="facets"))
        first, *others = window(frames, number, 5)
        depth_lr = fuse_views(first.view, [each.view for each in others]).depth
        voted.append(upsample_surface(frame.rgb, depth_lr, frame.camera, method="facets"))
    ways: dict[str, Callable[[Frame, int], PosedMap]] = {
        "bicubic, alike": lambda frame, at: posed(frame, plain[at], weighted=False, certain=False),
        "bicubic, certain, weighted": lambda frame, at: posed(frame, plain[at], weighted=True),
        "Facets, alike": lambda frame, at: posed(frame, alone[at], weighted=False, certain=False),
        "Facets, certain": lambda frame, at: posed(frame, alone[at], weighted=False),
        "Facets, weighted": lambda frame, at: posed(frame, alone[at], weighted=True, certain=False),
        "Facets, certain, weighted": lambda frame, at: posed(frame, alone[at], weighted=True),
        "of 5 frames, certain": lambda frame, at: posed(frame, voted[at], weighted=False),
        "of 5 frames, certain, weighted": lambda frame, at: posed(frame, voted[at], weighted=True),
        "true maps": lambda frame, _: PosedMap(frame.truth[0].double().numpy(), frame.camera, frame.pose),
    }
    truth, found = truth_of(make(scene, 2 * size, *more)), {}
    for name, made in ways.items():
        maps = [made(frame, at) for at, frame in enumerate(frames)]
        found[name] = score(maps, suggest_voxel(maps), truth)
    return found


def measure_points(folder: Path, noise: Noise) -> None:
    """Write a sequence and its export into a folder, and print how far points of the export are from the surface."""
    frames, rows = solids("cube_high_freq", 256, 4, noise), []
    camera = frames[0].camera
    for number, frame in enumerate(frames):
        depth = frame.depth_lr[0].numpy().copy()
        depth[20:34, 40:56] = np.nan
        pictures = {"rgb": 255 * frame.rgb.permute(1, 2, 0).numpy()[..., ::-1], "depth": np.nan_to_num(1000 * depth)}
        for kind, values in pictures.items():
            (folder / kind).mkdir(parents=True, exist_ok=True)
            values = values.round().astype(np.uint8 if kind == "rgb" else np.uint16)
            cv2.imwrite(str(folder / kind / f"{number:03}.png"), values)
        turn = Rotation.from_matrix(frame.pose[:3, :3]).as_quat()
        rows.append(" ".join(map(str, (number, *frame.pose[:3, 3], *turn))))
    (folder / "poses.txt").write_text("\n".join(rows) + "\n")
    lens = map(str, (camera.fx, camera.fy, camera.cx, camera.cy))
    out = folder / "out"
    dsr(["upsample", str(folder), "--poses", str(folder / "poses.txt"), "--intrinsics", *lens, "-o", str(out),
         "--only", "confidence,gaussian,nerfstudio"])  # fmt: skip
    tree = cKDTree(truth_of(solids("cube_high_freq", 512, 4, noise)))
    exported = [read_frame(each.name, each) for each in find_results(out)]
    for name, given in {"all": [replace(each, errors=None) for each in exported], "certain": exported}.items():
        alone = np.concatenate([_sample(each, len(given)).places for each in given])
        for way, places in {name: alone, f"{name}, frames agree": sample_points(given)[0].places}.items():
            far = tree.query(places)[0]
            shares = (f"{100 * float((far > limit).mean()):.2f} % beyond {limit} m" for limit in (0.02, 0.05))
            print(f"{way:22s} {len(places)} points, mean {1e3 * far.mean():.2f} mm,", *shares)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=192)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--noise", choices=NOISES, default="kinect")
    parser.add_argument("--solids", type=int, default=4, help="number of SimGeo's solids")
    parser.add_argument("--procedural", type=int, default=0, help="number of procedural scenes")
    parser.add_argument("--step", type=float, default=0.1, help="between places, see sequences.py")
    parser.add_argument("--points", type=Path, help="a folder for an export whose points are measured, and nothing else")
    arguments = parser.parse_args()
    sequences.STEP = arguments.step
    torch.set_num_threads(1)
    if arguments.points:
        sequences.STEP = 0.03
        measure_points(arguments.points, NOISES[arguments.noise]())
        return
    given = arguments.size, arguments.scale, NOISES[arguments.noise]()
    groups = {
        "SimGeo's solids": [measure(solids, name, *given) for name in SOLIDS[: arguments.solids]],
        "procedural scenes": [measure(rendered, index, *given) for index in range(arguments.procedural)],
    }
    for group, found in groups.items():
        print(f"{group}, {len(found)}, x{arguments.scale}, noise={arguments.noise}: F 5 cm, 1 cm, 5 mm; accuracy, mm")
        for name in found[0] if found else ():
            print(f"  {name:31s}", *(f"{mean(each[name][at] for each in found):8.2f}" for at in range(5)))


if __name__ == "__main__":
    main()

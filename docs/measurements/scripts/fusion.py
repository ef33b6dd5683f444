# Frozen: this measured once what the documentation says of it. It is not maintained.
"""How near the fused mesh of a sequence comes to the surface: F-score, accuracy and completeness, by what is fused.

    python docs/measurements/scripts/fusion.py [--size 192] [--scale 4] [--noise kinect] [--procedural 3]
                                   [--step 0.03]

On SimGeo's solids and on procedural scenes, rendered from the seven places of ``sequences.py`` with the noise of a
simulated sensor and exact poses. The ground truth is the points of all true depth maps at twice the size. Accuracy is the mean distance
from points on the mesh to the ground truth, completeness the one from the ground truth to points on the mesh; the
F-score is the harmonic mean of the shares within a limit (Knapitsch et al., Tanks and Temples, 2017).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from statistics import mean

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
import sequences
from sequences import NOISES, SOLIDS, Frame, rendered, solids, window

from dsr.geometry.mesh import fuse_maps, suggest_voxel
from dsr.geometry.poses import PosedMap
from dsr.inference import upsample_surface
from dsr.inference.sequences import fuse_views
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


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=192)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--noise", choices=NOISES, default="kinect")
    parser.add_argument("--procedural", type=int, default=3, help="number of procedural scenes")
    parser.add_argument("--step", type=float, default=sequences.STEP, help="between places, see sequences.py")
    arguments = parser.parse_args()
    sequences.STEP = arguments.step
    torch.set_num_threads(1)
    given = arguments.size, arguments.scale, NOISES[arguments.noise]()
    groups = {
        "SimGeo's solids": [measure(solids, name, *given) for name in SOLIDS],
        "procedural scenes": [measure(rendered, index, *given) for index in range(arguments.procedural)],
    }
    for group, found in groups.items():
        print(f"{group}, {len(found)}, x{arguments.scale}, noise={arguments.noise}: F 5 cm, 1 cm, 5 mm; accuracy, mm")
        for name in found[0] if found else ():
            print(f"  {name:31s}", *(f"{mean(each[name][at] for each in found):8.2f}" for at in range(5)))


if __name__ == "__main__":
    main()

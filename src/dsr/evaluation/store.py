"""What the directory of an evaluation holds of each scene: the prediction, and the problem that it answers.

``predictions/SCENE.npz`` has ``depth`` (H, W) in metres, NaN in holes, and where it came from. ``scenes/SCENE.npz`` has
the photo, the low-resolution input, the truth and their cameras, so that whatever is drawn from a run later, on any
machine, needs nothing but its directory. ``iterations/SCENE.csv`` says how the iteration went, of a method that
iterates.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.sample import DepthSample
from dsr.utils.files import read_arrays, replacing


@dataclass(frozen=True)
class StoredScene:
    """The problem that a prediction answers, as a run keeps it.

    Args:
        dataset, name: together they identify the scene.
        scale: the upsampling factor.
        rgb: (3, H, W) float32 in [0, 1], to 8 bits.
        camera: of the photo and the high-resolution depth.
        coarse: (1, h, w) float32 the input, orthogonal depth in metres, NaN in holes.
        camera_lr: of the input.
        depth: (1, H, W) float32 the truth, likewise; None where it is not known.
        notes: what somebody who reads the scores should know.

    """

    dataset: str
    name: str
    scale: int
    rgb: Tensor
    camera: Camera
    coarse: Tensor
    camera_lr: Camera
    depth: Tensor | None = None
    notes: tuple[str, ...] = field(default=())


def prediction_path(folder: Path, scene: str) -> Path:
    """Return where a run keeps a scene's prediction."""
    return folder / "predictions" / f"{scene}.npz"


def scene_path(folder: Path, scene: str) -> Path:
    """Return where a run keeps the problem that a scene apply_dihedral."""
    return folder / "scenes" / f"{scene}.npz"


def iterations_path(folder: Path, scene: str) -> Path:
    """Return where a run keeps how a scene's iteration went."""
    return folder / "iterations" / f"{scene}.csv"


def load_prediction(path: Path) -> Tensor:
    """Return a predicted depth map, (1, H, W) in metres.

    Raises:
        ValueError: the file is missing or damaged.

    """
    try:
        return torch.from_numpy(read_arrays(path)["depth"])[None]
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise ValueError(f"{path}: expected a prediction, got a missing or damaged file") from error


def save_scene(path: Path, sample: DepthSample) -> None:
    """Write the problem that a scene poses, atomically."""
    about = {
        "dataset": sample.dataset,
        "name": sample.scene,
        "scale": sample.scale,
        "notes": list(sample.notes),
        "camera": asdict(sample.camera),
        "camera_lr": asdict(sample.camera_lr),
    }
    arrays: dict[str, Any] = {
        "rgb": (sample.rgb.permute(1, 2, 0) * 255).round().byte().cpu().numpy(),
        "coarse": sample.depth_lr[0].float().cpu().numpy(),
    }
    if sample.depth is not None:
        arrays["depth"] = sample.depth[0].float().cpu().numpy()
    with replacing(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, about=json.dumps(about), **arrays)


def load_scene(path: Path) -> StoredScene:
    """Return what :func:`save_scene` wrote.

    Raises:
        ValueError: the file is missing or damaged.

    """
    try:
        arrays = read_arrays(path)
        about: dict[str, Any] = json.loads(str(arrays["about"]))
        return StoredScene(
            str(about["dataset"]),
            str(about["name"]),
            int(about["scale"]),
            torch.from_numpy(arrays["rgb"]).permute(2, 0, 1).float() / 255,
            Camera(**about["camera"]),
            torch.from_numpy(arrays["coarse"])[None],
            Camera(**about["camera_lr"]),
            torch.from_numpy(arrays["depth"])[None] if "depth" in arrays else None,
            tuple(about["notes"]),
        )
    except FileNotFoundError:
        raise ValueError(f"{path}: expected a run's scene, there is none; the run's command writes it anew") from None
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise ValueError(f"{path}: expected a run's scene, got a damaged or foreign file") from error

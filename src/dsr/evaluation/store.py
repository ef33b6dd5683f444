"""The files of each scene in the directory of an evaluation: the sample, the prediction and the iterations.

``scenes/SCENE.npz`` is the sample that the method was given. ``predictions/SCENE.npz``, see
:mod:`dsr.evaluation.scenes`, is written with it, so that scoring and drawing need only the directory.
``iterations/SCENE.csv`` is the history of a method that iterates. A name that leads out of the run is an OutsideError.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from dsr.utils.arrays import read_arrays
from dsr.utils.guards import TooLargeError, path_within

_ERRORS = ("depth_error", "angle_error")
_DAMAGED = "{}: expected a prediction, got a missing or damaged file"
_PREDICTION, _SAMPLE = "predictions/{}.npz", "scenes/{}.npz"


def expect_scene(folder: Path, scene: str, source: str) -> None:
    """Check that the files of a scene that a file of a run names lie in the run."""
    for form in (_PREDICTION, _SAMPLE):
        path_within(folder, scene, source, form)


def prediction_path(folder: Path, scene: str) -> Path:
    """Return where a run keeps a scene's prediction."""
    return path_within(folder, scene, f"{folder}: scene", _PREDICTION)


def sample_path(folder: Path, scene: str) -> Path:
    """Return where a run keeps the sample of a scene."""
    return path_within(folder, scene, f"{folder}: scene", _SAMPLE)


def iterations_path(folder: Path, scene: str) -> Path:
    """Return where a run keeps the history of a scene's iteration."""
    return path_within(folder, scene, f"{folder}: scene", "iterations/{}.csv")


def load_errors(path: Path) -> tuple[Tensor, Tensor] | None:
    """Return the expected errors of a prediction, (1, H, W): depth in metres, normal in degrees; None without them."""
    maps = _read_maps(path, _ERRORS)
    if "depth_error" not in maps:
        return None
    if len(maps) < len(_ERRORS):
        raise ValueError(_DAMAGED.format(path))
    depth, angle = (maps[name].float() for name in _ERRORS)
    return depth, angle


def load_prediction(path: Path) -> Tensor:
    """Return a predicted depth map, (1, H, W) in metres."""
    maps = _read_maps(path, ("depth",))
    if not maps:
        raise ValueError(_DAMAGED.format(path))
    return maps["depth"]


def _read_maps(path: Path, names: tuple[str, ...]) -> dict[str, Tensor]:
    """Return those of some maps of a prediction that there are, (1, H, W)."""
    try:
        arrays = read_arrays(path, names)
        if any(array.ndim != 2 or array.dtype.kind != "f" for array in arrays.values()):
            raise TypeError
        return {name: torch.from_numpy(array)[None] for name, array in arrays.items()}
    except TooLargeError:
        raise
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(_DAMAGED.format(path)) from error

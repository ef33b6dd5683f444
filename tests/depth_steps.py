"""A made pair of depth maps with steps, on which other projects' code was run once for the figures that tests have."""

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from dsr.geometry.camera import Camera
from dsr.metrics.functional import SurfacePair

Array = npt.NDArray[Any]
CAMERA = Camera(width=160, height=120, fx=150.0, fy=151.0, cx=79.5, cy=59.5)
UNKNOWN = np.s_[50:62, 40:70]  # A rectangle of unknown truth


def steps(seed: int = 0) -> tuple[Array, Array]:
    """Return a blurred, noisy prediction and the truth, a bent board of squares, (120, 160) float32 metres each."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[:120, :160]
    truth = 2 + 0.004 * u + 0.05 * np.sin(v / 7) + 0.7 * ((u // 24 + v // 18) % 2)
    prediction = 1.02 * (0.8 * truth + 0.2 * np.roll(truth, 1, axis=1)) + 0.02 * random.standard_normal(truth.shape)
    return prediction.astype(np.float32), truth.astype(np.float32)


def holed() -> tuple[Array, Array]:
    """Return :func:`steps` with a rectangle of unknown truth."""
    prediction, truth = steps()
    truth[UNKNOWN] = np.nan
    return prediction, truth


def pair_of(prediction: Array, truth: Array, camera: Camera = CAMERA) -> SurfacePair:
    """Return the pair of two maps (H, W), or two batches of them (B, H, W)."""
    maps = (torch.from_numpy(np.asarray(each)).view(-1, 1, *truth.shape[-2:]) for each in (prediction, truth))
    return SurfacePair(*maps, camera.rays()[None])

"""Super-resolution from shading, without training (SRfS).

Haefner, Quéau, Möllenhoff and Cremers, *Fight Ill-Posedness with Ill-Posedness: Single-shot Variational Depth
Super-Resolution from Shading*, CVPR 2018: the depth z whose block means are the low-resolution map, the piecewise
constant albedo and the light that explain the image, with minimal surface area. It minimises, by alternating
directions with a growing penalty over albedo, lighting, theta = (z, grad z), z and the multipliers
(:mod:`dsr.methods.classical.srfs_admm`, :mod:`dsr.methods.classical.potts`), the energy per pixel

    1/2 |albedo * shading - rgb|^2 + area_weight * z |m| + boundary_weight * boundaries
    + data_weight / (2 scale^2) * (mean z - lr)^2,

with intensities in [0, 1] and z in pixels (times the focal length f, by the median depth). What differs:

- Weights. Its code has, in these units at x4 with f = 500: data_weight 0.0015, area_weight 1e-7 and boundary_weight
  0.5. With so weak a data term the result follows the low-resolution map only over hundreds of pixels, and texture that
  the albedo does not explain becomes relief. Ours were chosen on procedural scenes and on a bumpy surface.
- Each channel has a light of its own. Albedos are between 0 and 2.
- The penalty of the copy of z is weighted by 1 / scale^2: with 1 a step spreads over a pixel, and blocks have several.
- theta by Levenberg and Marquardt's method, its 3 x 3 systems solved in closed form, instead of BFGS; z by plain
  conjugate gradients; it starts from the bicubic map, not smoothed first.
- Outside the foreground the initial map stays unchanged, including in blocks that cross its border.

The steps of albedo, lighting, theta and z each lower the augmented Lagrangian. The energy itself, logged for z without
the copy, may rise while the copy still differs. Holes have no data term, and start from inpainted values.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import RangeType
from dsr.methods.base import Abilities, Cost, Method, expect_limits, whole_scale
from dsr.methods.classical.srfs_admm import ShadingProblem, ShadingSolver, Weights
from dsr.methods.images import inpaint, upsample_linear_border
from dsr.sample import DepthSample
from dsr.utils.decoding import decode_pixels
from dsr.utils.guards import MOST_FILE, pixels_beside, read_limited
from dsr.utils.progress import Steps

_RENEW = 10  # iterations between two searches for the regions of the albedo
_NEARER = 4.0  # factor by which a result may be nearer than the nearest valid low-resolution pixel
_WHITE = 127  # value of a mask above which a pixel is white


class ShapeFromShading(Method):
    """Variational super-resolution from shading.

    Holes of the input are inpainted. Memory: about 130 float64 maps of the image's size. The low-resolution map is
    assumed to hold block means of depth.

    Args:
        iterations: maximum number of iterations.
        tolerance: relative change of the energy in an iteration, and RMS difference of theta and the slopes, below
            which it stops.
        data_weight: weight of the low-resolution map (mu).
        area_weight: weight of the surface's area (nu).
        boundary_weight: weight of the albedo's boundaries (lambda).
        penalty: initial penalty of the difference of theta and the slopes (kappa).
        growth: factor of the penalty in each iteration.
        foreground: folder of masks SCENE.png of the image's size, white at the object; None for the whole image.

    Attributes:
        history: of the last call, each iteration's ``objective``, its terms ``shading``, ``data``, ``area`` and
            ``boundaries``, the ``residual`` (RMS difference of theta and the slopes) and the movement of z, ``moved``
            (RMS, relative to the median depth).

    """

    abilities = Abilities(fast_on="cpu", cost=Cost(1300, 60))
    range_type: RangeType = "orthogonal"

    def __init__(
        self,
        iterations: int = 40,
        tolerance: float = 1e-4,
        data_weight: float = 100.0,
        area_weight: float = 0.2,
        boundary_weight: float = 0.1,
        penalty: float = 0.02,
        growth: float = 1.3,
        foreground: str | None = None,
    ) -> None:
        expect_limits(tolerance, iterations=iterations)
        if not area_weight >= 0:
            raise ValueError(f"area_weight: expected 0 or more, got {area_weight}")
        if not 1 <= growth < float("inf"):
            raise ValueError(f"growth: expected at least 1, got {growth}")
        positive = {"data_weight": data_weight, "boundary_weight": boundary_weight, "penalty": penalty}
        for name, value in positive.items():
            if not 0 < value < float("inf"):
                raise ValueError(f"{name}: expected more than 0, got {value}")
        if foreground is not None and not Path(foreground).is_dir():
            raise ValueError(f"foreground: expected a folder of masks, there is none at {foreground}")
        self.iterations, self.tolerance = iterations, tolerance
        self.weights = Weights(data_weight, area_weight, boundary_weight)
        self.penalty, self.growth = penalty, growth
        self.foreground = None if foreground is None else Path(foreground)
        self.history: list[dict[str, float]] = []

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return high-resolution depth without holes, (1, H, W) in metres on the sample's device."""
        self.history = []
        solver, metres = self.prepare(sample)
        objective = float("nan")  # of the iteration before
        for done in range(1, self.iterations + 1):
            before = solver.z
            solver.update_albedo(anew=done % _RENEW == 1)
            solver.update_lighting()
            solver.update_theta()
            solver.update_depth()
            solver.update_missed(self.growth)
            terms = solver.terms()
            objective_now = sum(terms.values())
            missed = (solver.slopes(solver.z) - solver.theta)[:, :2]
            residual = float(missed.square().mean().sqrt())
            moved = float((solver.z - before).square().mean().sqrt()) / solver.problem.unit
            entry = {"iteration": done, "objective": objective_now, **terms, "residual": residual, "moved": moved}
            self.history.append(entry)
            if progress is not None:
                progress(done, self.iterations)
            change = abs(objective_now - objective)
            if change < self.tolerance * abs(objective) and residual < self.tolerance:
                break
            objective = objective_now
        if progress is not None:
            progress(self.iterations, self.iterations)
        nearest = float(sample.depth_lr[sample.mask_lr].min()) / _NEARER
        return (solver.z[0] * metres).clamp(min=nearest).to(sample.depth_lr.dtype)

    def prepare(self, sample: DepthSample) -> tuple[ShadingSolver, float]:
        """Return the solver of a sample before its first step, and its unit of depth in metres."""
        lr = sample.depth_lr[None].double()
        camera = sample.camera
        inside = torch.ones(1, 1, camera.height, camera.width, dtype=torch.bool, device=lr.device)  # that may change
        if self.foreground is not None:
            mask = read_foreground(self.foreground / f"{sample.scene}.png", (camera.height, camera.width))
            inside = torch.from_numpy(mask)[None, None].to(lr.device)
        unit = (camera.fx * camera.fy) ** 0.5
        metres = float(lr[lr.isfinite()].median()) / unit
        problem = ShadingProblem(
            rgb=sample.rgb[None].to(lr),
            lr=lr / metres,
            rays=camera.rays(device=lr.device)[None],
            focal=(camera.fx, camera.fy),
            unit=unit,
            inside=inside,
        )
        first = upsample_linear_border(inpaint(problem.lr), whole_scale(sample))
        return ShadingSolver(problem, self.weights, first, self.penalty), metres


def read_foreground(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Return a mask, (H, W) bool of the given size, True where the picture is white."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a mask of the foreground, there is no such file")
    content = read_limited(path, MOST_FILE)
    levels = decode_pixels(path, content, cv2.IMREAD_GRAYSCALE, pixels_beside(*size))
    if levels is None:
        raise ValueError(f"{path}: expected a mask of the foreground, it is no picture or damaged")
    if levels.shape != size:
        raise ValueError(
            f"{path}: expected {size[0]} x {size[1]}, as the photo is, got {' x '.join(map(str, levels.shape))}"
        )
    if not (levels > _WHITE).any():
        raise ValueError(f"{path}: expected a foreground in white, got a black mask")
    return levels > _WHITE

"""Metrics of depth maps of real sensors: against a ground truth that is also measured, and of a board.

- ``metrics=sensor``: neither map is perfect. The scored pixels are those at least four pixels away from unknown truth,
  whose borders are ragged, and two away from unknown predictions and from those more than 0.1 m off, along rows and
  columns. Their median difference, a bias of the sensor, is subtracted, and normals and renderings are compared as in
  the paper's metrics, with unknown pixels replaced by the truth's median depth.
- ``metrics=plane``: the plane of a board is the ground truth, known within its outline alone. The median difference is
  subtracted, and pixels more than 60 mm off belong to another surface.

``Sensor_covered`` and ``Plane_covered``, the fractions of scored pixels, belong to every score.
"""

from functools import partial

import torch
from torch import Tensor

from dsr.metrics import functional
from dsr.metrics.formats import Metric, column, depth_mask, of_parts, target_mask
from dsr.metrics.functional import SSIM_WINDOW, SurfacePair, angle, masked_mean, masked_median, once_per_pair
from dsr.utils.compute_device import in_own_precision

TRUTH_EROSION = 3
PREDICTION_EROSION = 1
LARGEST_ERROR = 0.1  # metres; a prediction further off is another surface, not a shape of this one
NEAR = 0.06  # the same of a board


class SensorComparison:
    """What the metrics derive from a pair of the refined map and the truth.

    ``inner`` are the pixels that a prediction should cover and ``scored`` those that it covers, (B, 1, H, W) bool;
    ``offset`` is the median of prediction - truth over the scored pixels in metres, (B, 1, 1, 1); ``surfaces`` are the
    prediction less the offset, and the truth, without unknown pixels.
    """

    def __init__(self, pair: SurfacePair) -> None:
        prediction, target = pair.given
        known = prediction.isfinite() & (prediction > 0)
        near = pair.target_mask & known & ((prediction - target).abs() < LARGEST_ERROR)
        self.inner = erode(pair.target_mask, TRUTH_EROSION)
        self.scored = self.inner & erode(near, PREDICTION_EROSION)
        self.offset = masked_median(prediction - target, self.scored)
        filler = masked_median(target, pair.target_mask)
        self.surfaces = SurfacePair(
            torch.where(known, prediction - self.offset, filler),
            torch.where(pair.target_mask, target, filler),
            pair.rays,
            image_dtype=pair.image_dtype,
        )


compare = once_per_pair(SensorComparison)


def erode(mask: Tensor, steps: int) -> Tensor:
    """Return a mask (B, 1, H, W) without the pixels within ``steps`` of an unset one, or of the border."""
    for _ in range(steps):
        padded = torch.nn.functional.pad(mask, (1, 1, 1, 1))
        along_u = padded[..., 1:-1, 2:] & padded[..., 1:-1, :-2]
        mask = mask & along_u & padded[..., 2:, 1:-1] & padded[..., :-2, 1:-1]
    return mask


@once_per_pair
def sensor_errors(pair: SurfacePair) -> dict[str, Tensor]:
    """Return the scores without lights by name, (B,) each, over the scored pixels: metres and degrees."""
    comparison = compare(pair)
    surfaces, scored = comparison.surfaces, comparison.scored
    first, second = surfaces.normals
    angles = angle(surfaces)
    found = {
        "RMSE_v": masked_mean((first - second).square().mean(dim=1, keepdim=True), scored).sqrt(),
        "angle_mean": masked_mean(angles, scored),
        "angle_median": masked_median(angles, scored),
        "covered": masked_mean(scored, comparison.inner),
        "offset": comparison.offset.abs(),
        "RMSE_d": masked_mean((surfaces.prediction - surfaces.target).square(), scored).sqrt(),
    }
    return {name: value.flatten() for name, value in found.items()}


def dssim_v(pair: SurfacePair) -> Tensor:
    """Return DSSIM_v over the scored pixels per light, (B, 4), see :func:`dsr.metrics.functional.dssim_v`."""
    border = SSIM_WINDOW // 2  # no scored pixel is so close to it
    return functional.dssim_v(compare(pair).surfaces, compare(pair).scored[..., border:-border, border:-border])


def _inner(pair: SurfacePair) -> Tensor:
    return compare(pair).inner


def _scored(pair: SurfacePair) -> Tensor:
    return compare(pair).scored


@once_per_pair
def compare_board(pair: SurfacePair) -> tuple[Tensor, Tensor]:
    """Return the pixels of the board, and prediction - truth less its median in metres, 0 elsewhere; (B, 1, H, W)."""
    difference = pair.prediction - pair.target
    off = difference - masked_median(difference, pair.depth_mask)
    scored = pair.depth_mask & (off.abs() < NEAR)
    return scored, torch.where(scored, off, 0)


@once_per_pair
@in_own_precision
def board_errors(pair: SurfacePair) -> dict[str, Tensor]:
    """Return the scores of a board by name, (B,) each.

    ``std`` is of depth about the plane in metres, ``angle`` the mean angle between its normal and those by differences
    over two pixels in degrees, ``covered`` the fraction of pixels of the board.
    """
    scored, off = compare_board(pair)
    mean = masked_mean(off, scored)[..., None, None]
    points, board = pair.given[0] * pair.rays, pair.given[1] * pair.rays
    along_u, along_v = torch.full_like(points, torch.nan), torch.full_like(points, torch.nan)
    along_u[..., 1:-1] = points[..., 2:] - points[..., :-2]
    along_v[..., 1:-1, :] = points[..., 2:, :] - points[..., :-2, :]
    normals = torch.linalg.cross(along_u, along_v, dim=1)
    normals = normals / normals.norm(dim=1, keepdim=True)
    true = torch.stack([plane_normal(each[:, mask[0]].T) for each, mask in zip(board, pair.target_mask, strict=True)])
    cosine = torch.einsum("bchw,bc->bhw", normals, true.to(normals))[:, None].abs().clamp(max=1)
    angles = torch.rad2deg(cosine.acos())
    found = {
        "std": masked_mean((off - mean).square(), scored).sqrt(),
        "angle": masked_mean(angles, scored & angles.isfinite()),
        "covered": masked_mean(scored, pair.target_mask),
    }
    return {name: value.squeeze(1) for name, value in found.items()}


def plane_normal(points: Tensor) -> Tensor:
    """Return the normal, (3,), of the least-squares plane through points (N, 3), NaN for points in a line."""
    centred = points - points.mean(dim=0)
    moments = centred.T @ centred
    others = torch.tensor([[1, 2], [0, 2], [0, 1]], device=points.device)
    minors = torch.stack([moments[each][:, each] for each in others])
    sizes = torch.linalg.det(minors)
    axis = int(sizes.argmax())
    if len(points) < 3 or not sizes[axis] > 0:
        return points.new_full((3,), torch.nan)
    normal = points.new_ones(3)
    normal[others[axis]] = -torch.linalg.solve(minors[axis], moments[others[axis], axis])
    return normal / normal.norm()


_dssim = column("DSSIM_v", "sensor, 1/1000", 1e3, 0)
_errors = partial(of_parts, "Sensor_", sensor_errors, whole=True)
SENSOR: tuple[Metric, ...] = (
    *_errors(_scored, {"RMSE_v": column("RMSE_v", "sensor, 1/1000", 1e3, 0)}),
    Metric("Sensor_DSSIM_v", dssim_v, _scored, _dssim, per_light=True, min_size=SSIM_WINDOW, whole=True),
    *_errors(_scored, {"angle_mean": column("Angle", "mean, deg"), "angle_median": column("Angle", "median, deg")}),
    *_errors(_inner, {"covered": column("Covered", "%", 1e2, higher_is_better=True)}),
    *_errors(_scored, {"offset": column("Offset", "mm", 1e3, 2), "RMSE_d": column("RMSE_d", "sensor, mm", 1e3, 2)}),
)
_board_covered = {"covered": column("Covered", "plane, %", 1e2, higher_is_better=True)}
_board = partial(of_parts, "Plane_", board_errors)
PLANE: tuple[Metric, ...] = (
    *_board(depth_mask, {"std": column("Std", "plane, mm", 1e3, 2)}, unit="cm"),
    *_board(depth_mask, {"angle": column("Angle", "plane, central, deg")}, min_size=3),
    *_board(target_mask, _board_covered, unit="cm", regional=True, whole=True),
)

"""Alignment of a prediction to the truth, for predictions without a scale, such as those of a single photo.

The field's ways, of which an evaluation takes one (``metrics.alignment``):

- ``scale``: the prediction times the ratio of the medians of the two maps (Zhou et al., CVPR 2017).
- ``affine``: least squares of a z + b, clamped at 1e-4 m (``src/util/alignment.py`` of prs-eth/Marigold b1dffaa).
- ``affine_disparity``: least squares of a / z + b, clamped at 1e-4 / m (Ranftl et al., *MiDaS*, TPAMI 2022).
- ``robust``: the a z + b of the least sum of |a z + b - t| / t, clamped as ``affine`` is (Wang et al., *MoGe*, CVPR
  2025; microsoft/MoGe 0744441 solves it for 64 x 64 pixels, here all count, by reweighted least squares).
"""

import torch
from torch import Tensor

from dsr.metrics.functional import SurfacePair, masked_median

ALIGNMENTS = {
    "none": "",
    "scale": "by the ratio of medians",
    "affine": "by scale and shift of depth, least squares",
    "affine_disparity": "by scale and shift of inverse depth, least squares",
    "robust": "by scale and shift of depth, least absolute relative errors",
}  # what each alignment does, for notes
LEAST = 1e-4  # metres or 1 / metres: smallest value that a shift may leave
_ITERATIONS = 50  # of the reweighted least squares
_SMALLEST_ERROR = 1e-6  # relative, from which on their weights stay finite


def align(prediction: Tensor, target: Tensor, mask: Tensor | None, how: str) -> Tensor:
    """Return each image's prediction aligned to its truth, (B, 1, H, W); no gradients are meant to pass.

    Both are orthogonal depth, the prediction's up to the alignment; NaN, and a depth that is not positive, is a hole.
    Only pixels of the mask with both depths count. Holes stay; NaN for an image without a pixel to fit.
    """
    if how not in ALIGNMENTS:
        raise ValueError(f"alignment: expected one of {', '.join(ALIGNMENTS)}, got {how!r}")
    if prediction.shape != target.shape:
        came = f"{tuple(prediction.shape)} and {tuple(target.shape)}"
        raise ValueError(f"prediction, target: expected two depth maps of shape (B, 1, H, W), got {came}")
    if how == "none":
        return prediction
    known = prediction.isfinite() & (prediction > 0)
    valid = known & target.isfinite() & (target > 0)
    valid = valid if mask is None else valid & mask
    z = torch.where(known, prediction, 1).double()
    truth = torch.where(valid, target, 1).double()
    if how == "scale":
        aligned = z * (masked_median(truth, valid) / masked_median(z, valid))
    elif how == "affine":
        aligned = _least_squares(z, truth, valid.double()).clamp(min=LEAST)
    elif how == "affine_disparity":
        aligned = 1 / _least_squares(1 / z, 1 / truth, valid.double()).clamp(min=LEAST)
    else:
        weights = valid / truth
        aligned = _least_squares(z, truth, weights)
        for _ in range(_ITERATIONS):  # of the least absolute deviations
            apart = torch.maximum((aligned - truth).abs(), _SMALLEST_ERROR * truth)
            aligned = _least_squares(z, truth, weights / apart)
        aligned = aligned.clamp(min=LEAST)
    return torch.where(known, aligned.to(prediction.dtype), prediction)


def align_map(depth: Tensor, truth: Tensor | None, how: str) -> Tensor:
    """Return a prediction, (1, H, W), aligned to its truth, see :func:`align`; as it is where there is none."""
    return depth if truth is None else align(depth[None], truth[None], None, how)[0]


def align_errors(
    errors: tuple[Tensor, Tensor] | None, depth: Tensor, aligned: Tensor, how: str
) -> tuple[Tensor, Tensor] | None:
    """Return the expected errors of an aligned prediction: a scale multiplies those of depth, a shift loses them."""
    if errors is None or how == "none":
        return errors
    return (errors[0] * (aligned / depth), errors[1]) if how == "scale" else None


def align_pair(pair: SurfacePair, how: str) -> SurfacePair:
    """Return a pair with the prediction aligned to the truth, see :func:`align`."""
    if how == "none":
        return pair
    prediction, target = pair.given
    aligned = align(prediction, target, pair.target_mask, how)
    errors = None
    if pair.depth_error is not None and pair.angle_error is not None:
        errors = align_errors((pair.depth_error, pair.angle_error), prediction, aligned, how)
    depth_error, angle_error = errors or (None, None)
    return pair.replaced(prediction=aligned, depth_error=depth_error, angle_error=angle_error, measured=None)


def _least_squares(x: Tensor, y: Tensor, weights: Tensor) -> Tensor:
    """Return a x + b with the least weighted sum of squared differences from y; the mean of y if x is constant."""

    def mean(values: Tensor) -> Tensor:
        return (weights * values).sum(dim=(-3, -2, -1), keepdim=True) / total

    total = weights.sum(dim=(-3, -2, -1), keepdim=True)
    x, middle = x - mean(x), mean(y)
    variance = mean(x.square())
    return torch.where(variance > 0, mean(x * (y - middle)) / variance, 0) * x + middle

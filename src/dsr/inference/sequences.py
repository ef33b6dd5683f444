"""Depth maps of neighbouring frames with known poses, which vote on the depth of one of them.

The maps are warped into the reference frame. A neighbour's pixel counts where its surface is the reference's: where the
two inverse depths differ by less than their expected noise explains. What hides the surface, what it hides, and what
has moved is thereby left out. The votes are averaged in inverse depth with weights by expected noise and agreement. A
single reading on which no other frame agrees gives way to several that agree with each other, and a hole takes what
most of the frames that see something there agree on.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.poses import Matrix, as_rigid, relative
from dsr.geometry.resampling import source_pixels, warp_depth
from dsr.inference.working_size import find_noise
from dsr.methods.images import estimate_sensor_noise

# difference of two readings of a surface, in standard deviations of the difference, beyond which they disagree
_DEVIATIONS = 3.0
_SLACK = 0.01  # difference that counts as none, relative to inverse depth: poses and cameras are not exact
_LEAST_NOISE = 2e-4  # of inverse depth, relative to its median: depth maps are stored in whole millimetres
_PASSES = 2  # passes of the robust mean


@dataclass(frozen=True)
class View:
    """A depth map with its camera's place."""

    depth: Tensor  # (1, h, w) orthogonal depth in metres, NaN in holes
    camera: Camera
    pose: Matrix  # from the camera's frame (x right, y down, z forward) to the world's, 4 x 4, metres

    def __post_init__(self) -> None:
        shape = (1, self.camera.height, self.camera.width)
        if tuple(self.depth.shape) != shape:
            raise ValueError(f"depth: expected shape {shape}, the camera's, got {tuple(self.depth.shape)}")
        object.__setattr__(self, "pose", as_rigid(self.pose, "pose"))

    @functools.cached_property
    def noise(self) -> float:
        """Standard deviation of inverse depth in 1/m, estimated from the map; one frame votes on several."""
        found = find_noise(self.depth)  # differs little between neighbouring pixels, where the other estimate looks
        correlated = 0.0 if found is None else found.deviation / found.distance**2
        return max(correlated, estimate_sensor_noise(self.depth.double().reciprocal()[None]))


class Fused(NamedTuple):
    """Depth on which frames voted, (1, h, w) each."""

    depth: Tensor  # in metres, NaN in holes
    votes: Tensor  # the number of frames that agree
    others: Tensor  # the number of neighbours that agree
    seeing: Tensor  # the number of neighbours that see something there


def fuse_views(reference: View, neighbours: Sequence[View]) -> Fused:
    """Fuse the depth of neighbouring frames, which see the same surfaces, into that of a reference frame."""
    noise = float(np.median([view.noise for view in (reference, *neighbours)]))  # they are of one sensor
    own = reference.depth[0].double().reciprocal()
    readings = [(own, torch.full_like(own, _deviation(own, noise)))]
    readings += [_seen_from(reference, view, noise) for view in neighbours]
    inverse, deviation = (torch.stack(each) for each in zip(*readings, strict=True))  # (N + 1, h, w)
    centre = _most_voted(inverse, deviation)
    for _ in range(_PASSES):
        weight = _weights(inverse, deviation, centre)
        total = weight.sum(0)
        mean = (weight * inverse.nan_to_num(0)).sum(0) / total
        centre = torch.where(total > 0, mean, centre)
    agreeing = _weights(inverse, deviation, centre) > 0
    counts = agreeing.sum(0), agreeing[1:].sum(0), inverse[1:].isfinite().sum(0)
    return Fused(*(each[None].to(reference.depth) for each in (centre.reciprocal(), *counts)))


def _deviation(inverse: Tensor, noise: float) -> float:
    """Return the standard deviation of a map of inverse depth, NaN in holes, whose estimated noise may be none."""
    return max(noise, _LEAST_NOISE * float(inverse.nanmedian().nan_to_num(1.0)))


def _seen_from(reference: View, view: View, noise: float) -> tuple[Tensor, Tensor]:
    """Return another view's inverse depth and its standard deviation as the reference sees it, (h, w) each."""
    move = torch.from_numpy(relative(view.pose, reference.pose))[None]
    own = view.depth[0].double().cpu()
    depth = warp_depth(own[None, None], view.camera, move, reference.camera)
    u, v = source_pixels(depth, view.camera, move, reference.camera)
    rows = v[0].nan_to_num(0).round().long().clamp(0, view.camera.height - 1)
    columns = u[0].nan_to_num(0).round().long().clamp(0, view.camera.width - 1)
    seen = depth[0, 0].reciprocal()
    ratio = (seen * own[rows, columns]).square().nan_to_num(1.0)  # inverse depth's deviation scales with its square
    deviation = _deviation(own.reciprocal(), noise) * ratio
    device = reference.depth.device
    return seen.to(device), torch.where(deviation.isfinite(), deviation, torch.inf).to(device)


def _tolerance(inverse: Tensor, deviation: Tensor, centre: Tensor, own: Tensor | float) -> Tensor:
    """Return the difference from a centre, itself a reading of deviation ``own``, up to which readings agree."""
    return _DEVIATIONS * (deviation.square() + own**2).sqrt() + _SLACK * centre.abs().nan_to_num(0)


def _most_voted(inverse: Tensor, deviation: Tensor) -> Tensor:
    """Return the reading with which most others agree, the reference's own if any does, (h, w); NaN in holes."""
    support = torch.stack(
        [
            ((inverse - each).abs() <= _tolerance(inverse, deviation, each, own)).sum(0)
            for each, own in zip(inverse, deviation, strict=True)
        ]
    )
    most, winner = support.max(0)
    chosen = inverse.gather(0, winner[None])[0]
    own = inverse[0]
    keep = own.isfinite() & ((support[0] >= 2) | (most < 3))
    return torch.where(keep, own, torch.where(most >= 1, chosen, torch.nan))


def _weights(inverse: Tensor, deviation: Tensor, centre: Tensor) -> Tensor:
    """Return the weights of the readings, (N, h, w): Tukey's biweight of the difference, over the variance."""
    tolerance = _tolerance(inverse, deviation, centre, deviation[0].nan_to_num(0))
    ratio = ((inverse - centre).abs() / tolerance).nan_to_num(1.0).clamp(max=1)
    return (1 - ratio.square()).square() / deviation.square()

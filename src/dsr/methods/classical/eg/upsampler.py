"""Edge-guided upsampling of a depth map alone: a bilateral filter whose means do not cross predicted edges.

Xie, Feris, Sun, *Edge-Guided Single Depth Image Super Resolution*, IEEE TIP 25(1), 2016 (first at ICIP 2014), in its
self-similar mode. :mod:`dsr.methods.classical.eg.edge_map` predicts the high-resolution edges; the modified joint
bilateral filter then is

    S_p = 1 / k_p * sum over low-resolution pixels q of S_q f(|p - q|) r(p, q),

with f a Gaussian of the distance in low-resolution pixels, r = 1 if a path from p to q crosses no edge and 0 otherwise,
and k_p the sum of the weights. The colour image is not used.

What differs from the original, besides the edge map:

- It works on disparity, and each low-resolution pixel stands for a plane, as in
  :mod:`dsr.methods.classical.photo_guided`: planes are reproduced exactly, where constants would give stairs.
- A low-resolution pixel is a mean over its block, not a sample. A pixel with an edge through it mixes both sides, so
  its weight is multiplied by ``mixed``: it counts only if there is no other pixel on the side of p.
- A path is 4-connected, within the neighbourhood of the low-resolution pixel, and does not touch edges. In the original
  it is the shortest path with a high cost of edges, one pixel wider.
- Pixels on edges get the value that makes the mean of their block equal to the low-resolution value, starting from the
  bicubic map and staying between the two sides: so an edge is placed with subpixel accuracy. Then each takes the
  reachable pixels of its most similar neighbour off the edge. In the original, they reach both sides.
- Where no pixel is reachable, the result is the bicubic map, not the nearest sample.
- The scale is split into prime factors, x8 into three stages of x2, each with an edge map of its own, because more
  patches recur between neighbouring scales; the original has one stage, up to x4. Pixels on edges take sides only in
  the last stage; after the other stages they count as ``mixed`` and have no slope.

There is no solution for a map with edges that do not recur at half its size, such as one too small for patches: see
:class:`dsr.methods.base.NoSolutionError`. A map without edges needs none. Block means are expected; with
``downsampling=nearest`` the result is half a pixel off.

Depth is computed in float64. Time grows with the number of pixels, and with edge patches times example patches. Memory:
about 27 float64 maps of the image's size, at most 2^24 distances of 4 bytes, and a part that grows with the edge
pixels; for a statue before a wall at 512 x 512, 165 maps in total.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dsr.geometry.camera import from_range
from dsr.methods.base import Abilities, Cost, Method, whole_scale
from dsr.methods.classical.eg.bilateral import bilateral_filter
from dsr.methods.classical.eg.edge_map import predict_edge_map
from dsr.methods.classical.photo_guided import expect_positive
from dsr.methods.inpainting import inpaint
from dsr.sample import DepthSample
from dsr.utils.progress import Steps, part_of

_BEYOND = 4.0
"""Factor by which a result may be farther than the farthest valid low-resolution pixel, or nearer than the nearest."""


class EdgeGuided(Method):
    """Edge-guided upsampling of the low-resolution disparity.

    Args:
        step: minimum step of disparity at an edge, as a fraction of the map's range.
        candidates: number of candidates for each patch of edges.
        sharp_weight: weight of the edges relative to that of their distance transform, in the similarity of patches.
        smoothness: weight of the disagreement of overlapping patches.
        iterations: maximum number of iterations of belief propagation in each stage.
        radius: radius of the filter's neighbourhood in low-resolution pixels of the stage.
        sigma_space: standard deviation of the distance's Gaussian, in low-resolution pixels of the stage.
        mixed: weight of a low-resolution pixel with an edge through it, relative to others.
        fill_holes: whether holes of the low-resolution map are inpainted; otherwise they stay.

    Attributes:
        history: of the last call: iterations (over all stages), energy of the labels, largest change of a message.

    Raises:
        ValueError: a value is out of range.

    """

    abilities = Abilities(cost=Cost(1500, 12))

    def __init__(
        self,
        step: float = 0.05,
        candidates: int = 5,
        sharp_weight: float = 3.0,
        smoothness: float = 1.0,
        iterations: int = 100,
        radius: int = 1,
        sigma_space: float = 0.5,
        mixed: float = 0.01,
        *,
        fill_holes: bool = False,
    ) -> None:
        expect_positive("edge-guided upsampling", step=step, sharp_weight=sharp_weight, smoothness=smoothness)
        expect_positive("edge-guided upsampling", sigma_space=sigma_space, mixed=mixed)
        for name, value in (("candidates", candidates), ("iterations", iterations), ("radius", radius)):
            if value < 1:
                raise ValueError(f"{name}: expected at least 1 for edge-guided upsampling, got {value}")
        self._step, self._candidates, self._sharp_weight, self._smoothness = step, candidates, sharp_weight, smoothness
        self._iterations, self._radius, self._sigma_space, self._mixed = iterations, radius, sigma_space, mixed
        self._fill_holes = fill_holes
        self.history: list[dict[str, float]] = []

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres in the precision of the low-resolution depth.

        Raises:
            NoSolutionError: edges do not recur across scales, see the module.

        """
        disparity_lr = sample.disparity_lr(torch.float64)[0]
        valid = disparity_lr.isfinite()
        lowest, highest = (float(bound) for bound in disparity_lr[valid].aminmax())
        self.history = []
        disparity = disparity_lr
        stages = prime_factors(whole_scale(sample))
        barrier: Tensor | None = None
        for number, scale in enumerate(stages):
            report = part_of(progress, number * self._iterations, len(stages) * self._iterations)
            doubtful = barrier
            barrier = self._predict_edges(disparity, scale, self._step * (highest - lowest), report)
            disparity = bilateral_filter(
                disparity,
                barrier,
                scale,
                self._radius,
                self._sigma_space,
                self._mixed,
                doubtful=doubtful,
                sharp=number == len(stages) - 1,
            )
        doffs = sample.camera.doffs  # disparity + doffs is inverse depth
        disparity = disparity.clamp((lowest + doffs) / _BEYOND - doffs, (highest + doffs) * _BEYOND - doffs)
        if self._fill_holes:
            disparity = inpaint(disparity[None, None])[0, 0]
        return from_range(disparity[None], sample.camera, "disparity").to(sample.depth_lr)

    def _predict_edges(self, disparity_lr: Tensor, scale: int, step: float, report: Steps | None) -> Tensor:
        """Return the high-resolution edge map of a map (h, w), and append its labelling to the history."""
        barrier, answer = predict_edge_map(
            disparity_lr, scale, step, self._candidates, self._sharp_weight, self._smoothness, self._iterations, report
        )
        if report is not None:
            report(self._iterations, self._iterations)
        done = self.history[-1]["iteration"] if self.history else 0.0
        if answer is not None:
            self.history += [{**entry, "iteration": entry["iteration"] + done} for entry in answer.history]
        return barrier


def prime_factors(scale: int) -> list[int]:
    """Return the prime factors of a scale, the smallest first; none of 1."""
    factors = []
    while scale > 1:
        factors.append(next(n for n in range(2, scale + 1) if scale % n == 0))
        scale //= factors[-1]
    return factors

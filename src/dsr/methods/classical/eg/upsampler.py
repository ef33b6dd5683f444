"""Edge-guided upsampling of a depth map alone: a bilateral filter whose means do not cross predicted edges.

Xie, Feris, Sun, *Edge-Guided Single Depth Image Super Resolution*, IEEE TIP 25(1), 2016 (first at ICIP 2014), in its
self-similar mode. :mod:`dsr.methods.classical.eg.edge_map` predicts the high-resolution edges; the modified joint
bilateral filter then is

    S_p = 1 / k_p * sum over low-resolution pixels q of S_q f(|p - q|) r(p, q),

f being a Gaussian of the distance in low-resolution pixels, r = 1 where a way leads from p to q that crosses no edge
and 0 elsewhere, and k_p the weights' sum. The photo is not looked at.

What differs from the original, besides the edge map:

- It works on disparity, and each low-resolution pixel stands for a plane, as in
  :mod:`dsr.methods.classical.photo_guided`: planes come out exactly, where constants would make stairs of every slope.
- A low-resolution pixel is a mean over its block, not a sample. One that an edge cuts through mixes both sides, so it
  counts ``mixed`` times what others count: where there is another pixel on the side of p, next to nothing.
- A way is 4-connected, within the neighbourhood of the low-resolution pixel, and does not tread on edges. There, it is
  the shortest path with edges made costly, widened by a pixel.
- Pixels on edges get what is missing to the coarse value in their block's mean, starting from the bicubic map and
  staying between the sides: so an edge keeps its place to a part of a pixel. Then each sees what its neighbour off the
  edge sees whose answer is the most like that. There, they see both sides.
- Where nothing is to be seen, the bicubic map stands rather than the nearest sample.
- The scale is taken in its prime factors, x8 as x2 three times, each stage with an edge map of its own; the original
  has one stage and stops at x4. Between neighbouring scales more patches recur. Only in the last stage pixels on edges
  take sides; in the next after another they count as ``mixed`` and have no slope.

It has no answer for a map with edges that do not recur at half its size, such as one too small for patches: see
:class:`dsr.methods.base.NoSolutionError`. A map without an edge needs none. Box means are expected; with
``downsampling=nearest`` it is half a pixel off.

Everything that is a depth is computed in float64. Time grows with the pixels, and with edge patches times those known.
Memory: about 27 float64 maps of the photo's size, at most 2^24 distances of 4 bytes, and what grows with the edge
pixels; for a statue before a wall at 512 x 512 165 maps in all.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dsr.geometry.camera import RangeType, from_range, to_range
from dsr.methods.classical.eg.bilateral import bilateral_filter
from dsr.methods.classical.eg.edge_map import predict_edge_map
from dsr.methods.classical.photo_guided import expect_positive
from dsr.methods.networks.inpainting import inpaint
from dsr.sample import DepthSample
from dsr.utils.progress import Steps, part_of

_BEYOND = 4.0
"""How many times farther than the farthest known low-resolution pixel an answer may be, and how many times nearer."""


class EdgeGuided:
    """Edge-guided upsampling of the low-resolution disparity.

    Args:
        step: how high a step of disparity is an edge, as a share of the map's range.
        candidates: pairs of patches that each patch of edges chooses from.
        sharp_weight: weight of the sharp edges against the distances of the edges, in patches' likeness.
        smoothness: weight of neighbouring patches' disagreement.
        iterations: of belief propagation, at most so many in each stage.
        radius: of the filter's neighbourhood, in low-resolution pixels of the stage.
        sigma_space: standard deviation of the distance's Gaussian, in low-resolution pixels of the stage.
        mixed: what a low-resolution pixel with an edge through it counts.
        fill_holes: whether holes of the low-resolution map are filled, from around; otherwise they stay.

    Attributes:
        history: of the last call: iterations (through all stages), the field's energy, the largest change of a message.

    Raises:
        ValueError: a value is out of range.

    """

    range_type: RangeType = "disparity"

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
        disparity_lr = to_range(sample.depth_lr.double(), sample.camera_lr, "disparity")[0] * sample.scale
        valid = disparity_lr.isfinite()
        lowest, highest = (float(bound) for bound in disparity_lr[valid].aminmax())
        self.history = []
        disparity = disparity_lr
        stages = prime_factors(sample.scale)
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
        """Return the high-resolution edge map of a map (h, w), and add to the history how it was found."""
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

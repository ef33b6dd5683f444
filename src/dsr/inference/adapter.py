"""Run methods of fixed factors on samples at any other scale, as :func:`dsr.inference.upsample_depth` does.

A network for x2, x4 and x8 has no weights for a sensor's map at 2.667 times fewer pixels than the photo, or at as many.
An evaluation then resizes photo and result as ``dsr upsample`` does, and says so beside the scores.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dsr.degradation.scales import SCALES
from dsr.geometry.camera import RangeType
from dsr.inference.engine import DECIDED, MethodChoice, upsample_depth
from dsr.inference.options import Fill
from dsr.inference.planning import read_ability
from dsr.methods.registry import find_weights, read_method
from dsr.sample import DepthSample
from dsr.utils.builder import takes, trait
from dsr.utils.progress import Steps

_NOT_SETTINGS = ("name", "label", "target", *DECIDED)
"""Keys of a method's node that are no settings, or that the inference sets."""


def takes_scale(node: Mapping[str, Any], scale: float) -> bool:
    """Return whether a method takes samples of a scale itself.

    Args:
        node: of :func:`dsr.methods.registry.read_method`.
        scale: ratio of the photo's width to the depth map's.

    """
    ratios = trait("method", node, "ratios")
    return scale in SCALES or ratios == "any" or (ratios == "whole" and isinstance(scale, int))


class AnyScale:
    """A method of fixed factors as an :class:`~dsr.methods.base.Upsampler` of samples at any scale.

    Args:
        node: of the method, see :func:`dsr.methods.registry.read_method`.
        directories: the user's configuration directories.
        device: where to compute.
        weights: a file of weights, or a directory with the published files; None for those that the node names.

    Raises:
        ValueError: the method rejects a setting, or has no weights for any factor.

    """

    range_type: RangeType = "disparity"

    def __init__(
        self,
        node: Mapping[str, Any],
        directories: Sequence[Path] = (),
        device: torch.device | None = None,
        weights: Path | None = None,
    ) -> None:
        settings = {k: v for k, v in node.items() if k not in _NOT_SETTINGS and not k.startswith("weights_")}
        if weights is not None and takes("method", node, "weights"):
            settings["weights"] = str(weights)
        self._choice = MethodChoice(str(node["name"]), settings, tuple(directories), device or torch.device("cpu"))
        self._fill: Fill = "none" if node.get("fill_holes") is False else "all"
        self.flag = getattr(self._choice.build(self._steps()[0]), "flag", "")

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres, NaN where missing."""
        return upsample_depth(
            sample.rgb,
            sample.depth_lr,
            sample.camera,
            method=self._choice.name,
            settings=self._choice.settings,
            directories=self._choice.directories,
            device=str(self._choice.device),
            fill=self._fill,
            progress=progress,
        ).to(sample.depth_lr)

    def describe(self, sample: DepthSample) -> str:
        """Return in one line how the method is run, for a note beside the scores."""
        size, size_lr = sample.rgb.shape[-2:], sample.depth_lr.shape[-2:]
        return self._choice.plan((size[0], size[1]), (size_lr[0], size_lr[1]), None).way

    def weights(self) -> list[Path]:
        """Return the files of weights that it may choose from; none for a method without weights."""
        choice = self._choice
        nodes = {step: read_method(choice.name, step, choice.settings, choice.directories) for step in self._steps()}
        return [find_weights(node, step) for step, node in nodes.items() if takes("method", node, "weights")]

    def _steps(self) -> list[int]:
        """Return the factors that the method is made for."""
        return read_ability(self._choice.name, self._choice.directories, self._choice.settings).single_steps

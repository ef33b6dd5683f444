"""Choose how an evaluation runs its method: directly, or as ``dsr upsample`` does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from dsr.inference.any_ratio import AnyRatio, finds_noise
from dsr.inference.defaults import Fill
from dsr.inference.plans import steps_of
from dsr.methods.base import Method
from dsr.methods.networks.weight_files import has_weights
from dsr.methods.recipe import Recipe, Run
from dsr.utils.configuration import ConfigError


@dataclass(frozen=True)
class Selection:
    """A method for one scale."""

    recipe: Recipe  # with its weights
    scale: float  # ratio of the photo's width to the depth map's
    direct: bool  # run at this scale itself; else as in ``dsr upsample``, which may resize photo and map

    def files(self) -> list[Path]:
        """Return the files of weights that it may use; a ConfigError if one is missing."""
        factors: set[float] = {self.scale}
        if not self.direct:
            steps = steps_of(self.recipe).values()
            factors = {step for each in steps for step in each} or set(self.recipe.computed_at)
        found = (self.recipe.weights(factor) for factor in sorted(factors))
        return list(dict.fromkeys(file for file in found if file is not None))

    def build(self, run: Run) -> Method:
        """Build the method; a ConfigError if it rejects a setting, or has no weights."""
        if self.direct:
            return self.recipe.build(self.scale, run)
        try:
            fill: Fill = "none" if self.recipe.at().get("fill_holes") is False else "all"
            device = torch.device(run.device)
            method = AnyRatio(self.recipe, device, fill=fill, precision=run.precision, seed=run.seed)
            method.first()
        except ConfigError:
            raise
        except ValueError as error:
            raise ConfigError(str(error.__cause__ or error)) from error  # with the key as the run names it
        return method


def select(recipe: Recipe, scale: float, weights: Path | None = None, *, measured: bool = False) -> Selection:
    """Select how to run a method at a scale, the ratio of the photo's width to the depth map's.

    ``weights`` are a file of weights, or a directory with published ones; None for those that the method names. With
    ``measured`` maps, a sensor's own, a method that can choose its working size by the map's noise does so; of one
    without packaged weights for their ratio, those for another one are taken. Of a model of downsampling, the error
    says that it needs weights.
    """
    node = recipe.at().get("weights")  # with the scale as the run names it
    packaged = node.get("packaged") if isinstance(node, Mapping) else None
    lacking = weights is None and packaged is not None and not has_weights(node, scale)
    as_upsample = measured and (lacking or finds_noise(recipe))
    direct = recipe.abilities.takes(scale) and not as_upsample
    return Selection(recipe.with_weights(weights), scale, direct)

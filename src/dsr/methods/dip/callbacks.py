"""Checkpoints of the optimisation of one image, and its cost."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from dsr.methods.dip.optimisation import PriorOptimisation

_TEMPORARY = 1.6
"""Measured ratio of the peak memory of a step to the memory that the forward pass saves for the backward pass."""


class Provenance(Callback):
    """Stores a digest of the problem and the settings in each checkpoint."""

    def __init__(self, origin: str) -> None:
        self._origin = origin

    def on_save_checkpoint(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Store the digest."""
        checkpoint["origin"] = self._origin


def cost_of_step(module: PriorOptimisation) -> tuple[float, float]:
    """Measure the seconds of a step and the bytes that it and the optimiser need; the module stays unchanged."""
    state, taken = module.generator.get_state(), 0.0
    kept: dict[int, int] = {}

    def pack(x: Tensor) -> Tensor:
        kept[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    for _ in range(2):  # the first one warms up
        kept.clear()
        start = time.perf_counter()
        with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
            loss = module.objective(*module.answer(), module.problem)["loss"]
        loss.backward()
        loss.item()
        taken = time.perf_counter() - start
    module.zero_grad(set_to_none=True)
    module.generator.set_state(state)
    parameters = sum(each.numel() * each.element_size() for each in module.parameters())
    return taken, int(_TEMPORARY * sum(kept.values())) + 3 * parameters


def checkpoint_of(path: Path, origin: str) -> Path | None:
    """Return the path if it holds a checkpoint of the same problem and settings, else None."""
    if not path.is_file():
        return None
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True).get("origin")
    except Exception:
        return None
    return path if stored == origin else None

"""The settings of a training's patches, without torch: a configuration is checked before torch is imported."""

import math
from dataclasses import dataclass
from typing import Literal

from dsr.utils.guards import expect_memory

_MAX_DEPTH_SCALE = 3.0  # depth changes by a factor of exp(3) = 20 at most
_MIN_SIZE = 16
_BYTES, _BYTES_OF_WORKER = 256, 1 << 26  # least memory of a pixel with a layer of a network, and of a worker


@dataclass(frozen=True)
class PatchSettings:
    """How patches are cropped and augmented; ``conf/trainer/default.yaml`` describes the settings."""

    patch: int = 96
    batch: int = 6
    validation_scenes: int = 4
    scenes: int | None = None
    workers: int | Literal["auto"] = "auto"
    on_device: bool | Literal["auto"] = "auto"
    flip: bool = True
    rotate: bool = True
    depth_scale: float = 0.3
    colour: float = 0.1
    photo: float = 0.5

    def __post_init__(self) -> None:
        ranges = {"depth_scale": (0, _MAX_DEPTH_SCALE), "colour": (0, math.inf), "photo": (0, 1),
                  "patch": (_MIN_SIZE, math.inf), "batch": (1, math.inf), "workers": (0, math.inf),
                  "validation_scenes": (0, math.inf)}  # fmt: skip
        workers = 0 if self.workers == "auto" else self.workers
        for name, (least, most) in ranges.items():
            value = workers if name == "workers" else getattr(self, name)
            if not least <= value <= most or value == math.inf:
                expected = f"{least} or more" if most == math.inf else f"{least} to {most:g}"
                raise ValueError(f"{name}: expected {expected}, got {value}")
        if self.scenes is not None and self.scenes < 1:
            raise ValueError(f"scenes: expected a positive number, or null for all, got {self.scenes}")
        expect_memory("patch", self.patch, _BYTES * self.patch**2)
        expect_memory("batch", self.batch, _BYTES * self.batch * self.patch**2)
        if self.on_device != "auto" and not isinstance(self.on_device, bool):
            raise ValueError(f"on_device: expected true, false or auto, got {self.on_device}")
        expect_memory("workers", workers, _BYTES_OF_WORKER * workers)

"""The central records: a scene, as a data set provides it, and a sample, the input of a method.

Depth is orthogonal depth (distance to the image plane) in metres. A hole is NaN, never 0.
"""

from __future__ import annotations

import json
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera, to_range
from dsr.utils.arrays import read_arrays
from dsr.utils.files import replacing
from dsr.utils.guards import TooLargeError, derived, parse_json
from dsr.utils.ratios import as_ratio, fits_ratio, round_ratio

# Limits of depth in metres: a micrometre, and beyond the Moon. Within them, the inverse and the cube of a depth are
# ordinary float32 numbers; what lies outside has a wrong unit, or marks a hole or the sky.
NEAREST, FARTHEST = 1e-6, 1e9


class AllHolesError(ValueError):
    """A depth map without a known pixel."""


@dataclass(frozen=True)
class Unit:
    """The quantity and the unit that a benchmark prints its errors in, of depth in metres."""

    name: str  # such as ``cm``
    inverse: bool = False  # whether the quantity is ``factor / depth - offset`` (disparity), else ``factor * depth``
    factor: float = 100.0
    offset: float = 0.0
    limits: tuple[float, float] | None = None  # to which the benchmark clamps predictions

    def __post_init__(self) -> None:
        if not 0 < self.factor < math.inf:
            raise ValueError(f"unit {self.name}: factor: expected a positive number, got {self.factor}")
        if self.offset and not self.inverse:
            raise ValueError(f"unit {self.name}: offset: expected 0 for depth, got {self.offset}")

    def convert(self, depth: Tensor) -> Tensor:
        """Return depth in metres, of any shape, in this unit; the limits are not applied."""
        return self.factor / depth - self.offset if self.inverse else self.factor * depth


CENTIMETRES = Unit("cm")


@dataclass(frozen=True)
class Scene:
    """A photo and its high-resolution depth, before any downsampling.

    At a whole ratio, a measured map has H // ratio x W // ratio pixels and leaves out what remains of the photo at the
    bottom and the right; at any other it covers the whole photo, and their aspect ratios may differ by 2 %.
    """

    dataset: str
    name: str  # that identifies the scene in its data set
    rgb: Tensor  # (3, H, W) floating point, in [0, 1]
    camera: Camera  # of photo and depth
    depth: Tensor | None = None  # (1, H, W), None where it is not known
    measured: Mapping[float, Tensor] = field(default_factory=dict)  # a sensor's maps, (1, h, w), by the ratio W / w
    notes: tuple[str, ...] = ()  # for readers of the scores, such as "depth is not metric"
    unit: Unit = CENTIMETRES  # in which the data set's benchmark prints errors
    regions: Mapping[str, Tensor] = field(default_factory=dict)  # parts with own tables: (1, H, W) uint8, 0 outside

    def __post_init__(self) -> None:
        _expect_photo_and_regions(self.name, self.rgb, self.regions, self.camera)
        if self.depth is None and not self.measured:
            raise ValueError(f"{self.name}: expected a depth map, high-resolution or measured, got none")
        if self.depth is not None:
            _expect_depth(self.name, "depth", self.depth, (self.camera.height, self.camera.width))
        object.__setattr__(self, "measured", {as_ratio(ratio): depth for ratio, depth in self.measured.items()})
        for ratio, depth in self.measured.items():
            if not 1 <= ratio < math.inf:
                raise ValueError(f"{self.name}: measured: expected a ratio of 1 or more, got {ratio}")
            what, size = f"measured depth at x{round_ratio(ratio)}", (self.camera.height, self.camera.width)
            _expect_depth(self.name, what, depth, _reduced_size(size, ratio, depth.shape[-2:]))

    @property
    def true_depth(self) -> Tensor:
        """``depth``, where a scene without it is an error."""
        if self.depth is None:
            raise ValueError(f"{self.name}: expected a true depth, there is none")
        return self.depth

    def crop(self, top: int, left: int, height: int, width: int) -> Scene:
        """Return a window of the scene: ``height`` x ``width`` pixels from row ``top`` and column ``left`` on.

        A measured map is left out if the window does not consist of whole pixels of the map.
        """
        top, left, height, width = map(operator.index, (top, left, height, width))
        window = (slice(None), slice(top, top + height), slice(left, left + width))
        measured = {}
        for ratio, depth_lr in self.measured.items():
            if isinstance(ratio, int):
                down = across = Fraction(ratio)
            else:
                rows, columns = depth_lr.shape[-2:]
                down, across = Fraction(self.camera.height, rows), Fraction(self.camera.width, columns)
            ends = top / down, (top + height) / down, left / across, (left + width) / across
            if all(end.denominator == 1 for end in ends):
                first_row, end_row, first_column, end_column = map(int, ends)
                measured[ratio] = depth_lr[:, first_row:end_row, first_column:end_column]
        depth = None if self.depth is None else self.depth[window]
        if depth is None and not measured:
            raise ValueError(f"{self.name}: expected a window with a depth map, high-resolution or measured, got none")
        camera = self.camera.crop(top, left, height, width)
        regions = {name: region[window] for name, region in self.regions.items()}
        return derived(self, rgb=self.rgb[window], depth=depth, camera=camera, measured=measured, regions=regions)


@dataclass(frozen=True)
class DepthSample:
    """A photo, a low-resolution depth map, and the high-resolution one where it is known.

    Where the scale is not whole, H = h * scale and W = w * scale to within a low-resolution pixel or 2 %.
    """

    dataset: str
    scene: str  # that identifies the sample in its data set
    rgb: Tensor  # (3, H, W) floating point, in [0, 1]
    depth_lr: Tensor  # (1, h, w)
    camera: Camera  # of photo and ``depth``
    camera_lr: Camera  # of ``depth_lr``
    scale: float  # the upsampling factor W / w: 1, 2.667, 4
    depth: Tensor | None = None  # (1, H, W), None where it is not known
    notes: tuple[str, ...] = ()  # for readers of the scores, such as "cropped from 513 x 512"
    unit: Unit = CENTIMETRES
    regions: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _expect_photo_and_regions(self.scene, self.rgb, self.regions, self.camera)
        object.__setattr__(self, "scale", as_ratio(self.scale))
        if not 1 <= self.scale < math.inf:
            raise ValueError(f"{self.scene}: scale: expected a number of 1 or more, got {self.scale}")
        size, size_lr = (self.camera.height, self.camera.width), (self.camera_lr.height, self.camera_lr.width)
        expected = _reduced_size(size, self.scale, size_lr)
        whole = isinstance(self.scale, int)
        if size_lr != expected or (whole and (size_lr[0] * self.scale, size_lr[1] * self.scale) != size):
            raise ValueError(
                f"{self.scene}: depth_lr: expected {expected[0]} x {expected[1]} (the photo's "
                f"{size[0]} x {size[1]} at scale {round_ratio(self.scale)}), got {size_lr[0]} x {size_lr[1]}"
            )
        _expect_depth(self.scene, "depth_lr", self.depth_lr, size_lr)
        if self.depth is not None:
            _expect_depth(self.scene, "depth", self.depth, size)

    def save(self, path: Path) -> None:
        """Write the sample to an ``.npz`` file, atomically and without loss; see :meth:`load`."""
        about = {
            "dataset": self.dataset,
            "name": self.scene,
            "scale": self.scale,
            "notes": list(self.notes),
            "camera": asdict(self.camera),
            "camera_lr": asdict(self.camera_lr),
            "rgb": str(self.rgb.dtype).removeprefix("torch."),
            "unit": asdict(self.unit),
        }
        rgb = stored = self.rgb.permute(1, 2, 0).cpu().numpy()
        for kind, largest in _BITS.items():  # as integers where these give back the same values
            packed = np.rint(rgb * largest).astype(kind)
            if np.array_equal(packed.astype(rgb.dtype) / rgb.dtype.type(largest), rgb):
                stored = packed
                break
        arrays: dict[str, Any] = {"rgb": stored, "depth_lr": self.depth_lr[0].cpu().numpy()}
        if self.depth is not None:
            arrays["depth"] = self.depth[0].cpu().numpy()
        arrays |= {f"{_REGION}{name}": region[0].cpu().numpy() for name, region in self.regions.items()}
        with replacing(path) as temporary:
            np.savez_compressed(temporary, allow_pickle=False, about=json.dumps(about), **arrays)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Return the sample that :meth:`save` wrote."""
        try:
            arrays = read_arrays(path)
            about: dict[str, Any] = parse_json(str(arrays["about"]))
            limits, rgb, dtype = about["unit"]["limits"], arrays["rgb"], np.dtype(about["rgb"])
            if (largest := _BITS.get(str(rgb.dtype))) is not None:
                rgb = rgb.astype(dtype) / dtype.type(largest)
            return cls(
                str(about["dataset"]),
                str(about["name"]),
                torch.from_numpy(rgb).permute(2, 0, 1).contiguous(),
                torch.from_numpy(arrays["depth_lr"])[None],
                Camera(**about["camera"]),
                Camera(**about["camera_lr"]),
                float(about["scale"]),
                torch.from_numpy(arrays["depth"])[None] if "depth" in arrays else None,
                tuple(about["notes"]),
                Unit(**{**about["unit"], "limits": None if limits is None else tuple(limits)}),
                {
                    name.removeprefix(_REGION): torch.from_numpy(values)[None]
                    for name, values in arrays.items()
                    if name.startswith(_REGION)
                },
            )
        except FileNotFoundError:
            raise ValueError(f"{path}: expected the sample of a scene, there is none") from None
        except TooLargeError:
            raise
        except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError) as error:
            raise ValueError(f"{path}: expected the sample of a scene, got a damaged or foreign file") from error

    @property
    def mask_lr(self) -> Tensor:
        """(1, h, w) bool: where the low-resolution depth is known."""
        return self.depth_lr.isfinite()

    def disparity_lr(self, dtype: torch.dtype | None = None) -> Tensor:
        """Return the low-resolution disparity in pixels of the high-resolution camera, (1, h, w), NaN where missing."""
        pixels = self.camera.width / self.camera_lr.width  # of the high-resolution camera in a low-resolution one
        return to_range(self.depth_lr.to(dtype or self.depth_lr.dtype), self.camera_lr, "disparity") * pixels


_REGION = "region_"  # beginning of the names of arrays that are regions
_BITS = {"uint8": 255, "uint16": 65535}  # the largest values of the integers that photos are stored as


def _reduced_size(size: tuple[int, int], ratio: float, size_lr: Sequence[int]) -> tuple[int, int]:
    """Return the height and width that a map at a ratio has to have; ``size_lr`` itself where it is near enough."""
    if isinstance(ratio, int):
        return size[0] // ratio, size[1] // ratio
    height, width = size_lr if fits_ratio(size, size_lr, ratio) else (round(n / ratio) for n in size)
    return height, width


def _expect_shape(scene: str, name: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape:
        raise ValueError(f"{scene}: {name}: expected shape {shape}, got {tuple(value.shape)}")


def _expect_photo_and_regions(scene: str, rgb: Tensor, regions: Mapping[str, Tensor], camera: Camera) -> None:
    _expect_shape(scene, "rgb", rgb, (3, camera.height, camera.width))
    if not rgb.is_floating_point() or not bool(((rgb >= 0) & (rgb <= 1)).all()):
        raise ValueError(f"{scene}: rgb: expected floating point values in [0, 1]")
    for name, region in regions.items():
        _expect_shape(scene, f"region {name}", region, (1, camera.height, camera.width))
        if region.dtype != torch.uint8 or not name.isidentifier():
            raise ValueError(f"{scene}: region {name}: expected uint8, and a name of letters; got {region.dtype}")


def expect_distances(place: str, depth: Tensor) -> None:
    """Check that depth of any shape is within :data:`NEAREST` and :data:`FARTHEST`; ``place`` is for the message."""
    beyond = depth[(depth < NEAREST) | (depth > FARTHEST)]
    if beyond.numel():
        share = beyond.numel() / depth.numel()
        raise ValueError(
            f"{place}: expected depths of {NEAREST:g} to {FARTHEST:g} m, got {float(beyond[0]):g} m in {share:.2%} of "
            "the pixels; another unit, or sky that should be a hole (NaN)?"
        )


def _expect_depth(scene: str, name: str, depth: Tensor, size: tuple[int, int]) -> None:
    _expect_shape(scene, name, depth, (1, *size))
    if not depth.is_floating_point():
        raise ValueError(f"{scene}: {name}: expected floating point metres, got {depth.dtype}")
    if bool((depth.isinf() | (depth <= 0)).any()):
        came = "inf" if bool(depth.isinf().any()) else f"{depth.nan_to_num(nan=torch.inf).min().item():g}"
        raise ValueError(f"{scene}: {name}: expected positive depth, and NaN where a pixel is a hole; got {came}")
    expect_distances(f"{scene}: {name}", depth)
    if not bool(depth.isfinite().any()):
        raise AllHolesError(f"{scene}: {name}: expected at least one known pixel, all are holes")

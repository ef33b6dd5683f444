"""Depth maps predicted by another program, one file per scene, evaluated and shown like the results of a method.

A monocular network's map has no scale, and often no shift. Such a map is fitted to the low-resolution one, robustly and
without the truth, in its own quantity: relative inverse depth, as of MiDaS and Depth Anything, in inverse depth.
"""

import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, cast, get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate

from dsr.geometry.camera import RANGE_TYPES, Camera, RangeType, from_range, to_range
from dsr.io.depth_files import DEPTH_SUFFIXES, expect_known, find_holes, read_depth_file
from dsr.io.reading import parse_unit
from dsr.methods.base import Abilities, Cost, Method
from dsr.sample import FARTHEST, NEAREST, DepthSample
from dsr.utils.guards import expect_one_of, natural_key, pixels_beside
from dsr.utils.progress import Steps
from dsr.utils.ratios import round_ratio
from dsr.utils.versions import hash_once

INVERSE = "inverse"
QUANTITIES = (*RANGE_TYPES, INVERSE)  # what values measure; inverse depth in 1/m, or in any unit if it is fitted
Resize = Literal["nearest", "bilinear"]
Fit = Literal["scale", "affine"]
_FIELD = re.compile(r"\{(\w*)\}")
_FIELDS = ("scene", "dataset", "scale")
_NAMED = 5  # largest number of files that a message names
_STEPS = 50  # largest number of iterations of a robust fit
_CONTRAST = 0.05  # relative deviation of a scene's inverse depth from which on agreement with it is looked at
_LEAST_AGREEMENT = 0.2  # correlation with the low-resolution map below which a map is of something else
_MOST_OFF = 3.0  # factor between the medians from which on the unit is another one


class External(Method):
    """A method that reads its results from files, of any median if they are aligned to the truths (``alignment``)."""

    abilities = Abilities(ratios="any", own_size=True, cost=Cost(60))
    range_type = "orthogonal"

    def __init__(
        self,
        path: str,
        file: str = "{scene}",
        range_type: str = "orthogonal",
        unit: str | float | None = None,
        hole_value: float | None = None,
        fit: str | None = None,
        resize: str | None = None,
        *,
        check: bool = True,
        alignment: str = "none",
    ) -> None:
        expect_one_of("range_type", range_type, QUANTITIES)
        expect_one_of("fit", fit, (None, *get_args(Fit)))
        expect_one_of("resize", resize, (None, *get_args(Resize)))
        if not file or set(_FIELD.findall(file)) - set(_FIELDS):
            raise ValueError(f"file: expected a name with {', '.join(f'{{{each}}}' for each in _FIELDS)}, got {file!r}")
        self.folder = Path(path).expanduser()
        if not self.folder.is_dir():
            raise ValueError(f"path: expected a directory of predictions, got {path} (no such directory)")
        whole = self.folder.resolve()
        self.name = (whole.parent if whole.name == "predictions" else whole).name  # those of a run of dsr
        self._file, self._quantity, self._hole_value = file, range_type, hole_value
        try:
            self._unit = None if unit is None else parse_unit(str(unit))
        except ValueError as error:
            raise ValueError(f"unit: {error}") from None
        self._fit, self._resize, self._check, self._metric = fit, resize, check, alignment == "none"

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the map of the sample's scene, (1, H, W) orthogonal depth in metres, NaN in holes."""
        name, found = self._find(sample.dataset, sample.scene, sample.scale)
        if not found:
            raise ValueError(f"{self.folder / name}: expected a map as {', '.join(DEPTH_SUFFIXES)}, there is none")
        if len(found) > 1:
            raise ValueError(f"{self.folder}: expected one map of {name}, got {', '.join(path.name for path in found)}")
        path = found[0]
        values = self._read(path, sample.camera)
        if self._fit is not None:
            values = fit_to_map(values, sample, self._quantity, self._fit, path)
        depth = within_limits(to_depth(values, sample.camera, self._quantity))
        if not bool(depth.isfinite().any()):
            raise ValueError(f"{path}: expected a depth, no value is one between {NEAREST:g} and {FARTHEST:g} m")
        if self._check:
            _expect_likeness(path, depth, sample, metric=self._metric)
        return depth.to(sample.depth_lr.device)

    def describe(self, sample: DepthSample) -> str:
        """Return a note on the scene's map if its format costs precision, or if it was changed."""
        notes = [describe_fit(self._fit)] if self._fit else []
        _, found = self._find(sample.dataset, sample.scene, sample.scale)
        if len(found) == 1:
            stored = read_depth_file(found[0], pixels_beside(sample.camera.height, sample.camera.width))
            if stored.dtype.kind in "iu":
                metres = " m" if self._quantity in ("orthogonal", "perspective") else ""
                notes.insert(0, f"predictions come as whole numbers of {self._unit or 1:g}{metres}")
        return "; ".join(notes)

    def remarks(self, dataset: str, scenes: Sequence[str], scale: float) -> list[str]:
        """Return lines on files that are of no scene."""
        used = {path for scene in scenes for path in self._find(dataset, scene, scale)[1]}
        files = {path for path in self.folder.rglob("*") if path.suffix.lower() in DEPTH_SUFFIXES and path.is_file()}
        others = sorted((os.fspath(path.relative_to(self.folder)) for path in files - used), key=natural_key)
        if not others:
            return []
        more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
        return [f"{self.folder}: {len(others)} files are of no scene: {', '.join(others[:_NAMED])}{more}"]

    def content(self, dataset: str, scene: str, scale: float) -> str | None:
        """Return the SHA-256 of a scene's file; None without one."""
        return ", ".join(map(hash_once, self._find(dataset, scene, scale)[1])) or None

    def _find(self, dataset: str, scene: str, scale: float) -> tuple[str, list[Path]]:
        """Return the name of a scene's file, and the files of this name."""
        values = {"dataset": dataset, "scene": scene, "scale": str(round_ratio(scale))}
        name = _FIELD.sub(lambda match: values[match[1]], self._file)
        suffixes = ("",) if name.lower().endswith(DEPTH_SUFFIXES) else DEPTH_SUFFIXES
        return name, [path for suffix in suffixes if (path := self.folder / f"{name}{suffix}").is_file()]

    def _read(self, path: Path, camera: Camera) -> Tensor:
        """Return the values of a file, (1, H, W) float64 in their quantity's unit, NaN in holes."""
        stored = read_depth_file(path, pixels_beside(camera.height, camera.width))
        if stored.dtype.kind in "iu" and self._unit is None and self._fit is None and self._metric:
            raise ValueError(f"{path}: expected method.unit=mm, or another one, for {stored.dtype} values, got none")
        if self._fit is not None and self._quantity in (INVERSE, "disparity"):  # 0 may be the farthest point
            holes = ~np.isfinite(stored)
            if self._hole_value is not None:
                holes |= stored == self._hole_value
        else:
            holes = find_holes(stored, self._hole_value, above=math.inf)[0]
        expect_known(path, stored, holes)
        values = torch.from_numpy(np.where(holes, np.nan, stored.astype(np.float64)))[None] * (self._unit or 1.0)
        size = (camera.height, camera.width)
        if tuple(values.shape[-2:]) == size:
            return values
        if self._resize is None:
            came = " x ".join(map(str, stored.shape))
            raise ValueError(
                f"{path}: expected {size[0]} x {size[1]} pixels (height x width), got {came}; "
                "method.resize=nearest or bilinear resizes it"
            )
        factor = size[1] / values.shape[-1] if self._quantity == "disparity" else 1.0  # in pixels of the photo
        mode = "nearest-exact" if self._resize == "nearest" else self._resize
        return interpolate(values[None], size, mode=mode)[0] * factor


def describe_fit(fit: str | None) -> str:
    """Return the note on a fitted map that is shown beside its scores; empty without a fit."""
    return f"{fit} fitted to the low-resolution map" if fit else ""


def fit_to_map(values: Tensor, sample: DepthSample, quantity: str, fit: str, place: Path) -> Tensor:
    """Return values of a quantity, (1, H, W) on the CPU in any unit, NaN in holes, fitted to the low-resolution map."""
    values = values.to(torch.float64)
    own, theirs = _both_known(values, from_depth(sample.depth_lr.to("cpu", torch.float64), sample, quantity))
    if own.numel() < 2:
        raise ValueError(f"{place}: expected pixels that the low-resolution map knows, too; there are none")
    gain, shift = fit_line(own, theirs, shift=fit == "affine")
    if not gain > 0:
        what = quantity if quantity == "disparity" else f"{quantity} depth"
        raise ValueError(f"{place}: expected values that rise with the low-resolution map's {what}, they do not")
    return gain * values + shift


def fit_line(values: Tensor, target: Tensor, *, shift: bool = True) -> tuple[float, float]:
    """Return gain and shift, or 0, of the least sum of absolute errors, by reweighted least squares."""
    weight, line = torch.ones_like(values), torch.zeros(2, dtype=values.dtype)
    floor = 1e-6 * float(target.abs().median()) + torch.finfo(values.dtype).tiny
    mean = middle = values.new_zeros(())
    for _ in range(_STEPS):
        if shift:
            mean, middle = (weight * values).sum() / weight.sum(), (weight * target).sum() / weight.sum()
        centred = values - mean
        gain = (weight * centred * (target - middle)).sum() / (weight * centred.square()).sum()
        before, line = line, torch.stack((gain, middle - gain * mean))
        if torch.allclose(before, line, rtol=1e-9, atol=0):
            break
        weight = 1 / (target - line[0] * values - line[1]).abs().clamp(min=floor)
    return float(line[0]), float(line[1])


def to_depth(values: Tensor, camera: Camera, quantity: str) -> Tensor:
    """Return values of a quantity as orthogonal depth; NaN where there is none."""
    if quantity == INVERSE:
        return torch.where(values > 0, 1 / values, torch.nan)
    depth = from_range(values, camera, cast(RangeType, quantity))
    return torch.where(depth > 0, depth, torch.nan)


def within_limits(depth: Tensor) -> Tensor:
    """Return depth in metres with NaN where it is nearer or farther than depth maps of dsr hold."""
    return depth.masked_fill((depth < NEAREST) | (depth > FARTHEST), torch.nan)


def from_depth(depth_lr: Tensor, sample: DepthSample, quantity: str) -> Tensor:
    """Return the low-resolution map in a quantity, of disparity in pixels of the photo's camera."""
    if quantity == INVERSE:
        return 1 / depth_lr
    if quantity == "disparity":
        return sample.disparity_lr(torch.float64).cpu()
    return to_range(depth_lr, sample.camera_lr, cast(RangeType, quantity))


def _both_known(values: Tensor, smaller: Tensor) -> tuple[Tensor, Tensor]:
    """Return means of values within the pixels of a smaller map, if half of one are known, and its values there."""
    known, size = values.isfinite(), (smaller.shape[-2], smaller.shape[-1])
    share = adaptive_avg_pool2d(known.to(values.dtype), size)
    reduced = adaptive_avg_pool2d(torch.where(known, values, 0), size) / share
    both = (share >= 0.5) & reduced.isfinite() & smaller.isfinite()
    return reduced[both], smaller[both]


def _expect_likeness(path: Path, depth: Tensor, sample: DepthSample, *, metric: bool) -> None:
    """Raise a ValueError if a map, perhaps metric, cannot be of the sample's scene."""
    own, theirs = _both_known(1 / depth, 1 / sample.depth_lr.to("cpu", torch.float64))
    if own.numel() < 2:
        return
    off = float(theirs.median() / own.median())
    if metric and not 1 / _MOST_OFF < off < _MOST_OFF:
        raise ValueError(
            f"{path}: expected depths like the low-resolution map's, the median is {off:.3g} times theirs: another "
            "unit, or method.fit=affine for a map without a scale? method.check=false takes it"
        )
    if float(theirs.std() / theirs.mean()) < _CONTRAST:
        return
    agreement = float(torch.corrcoef(torch.stack((own, theirs)))[0, 1].nan_to_num())
    if agreement < _LEAST_AGREEMENT:
        what = "disparity read as depth" if agreement < -_LEAST_AGREEMENT else "another scene"
        raise ValueError(
            f"{path}: expected a map like the low-resolution one, their correlation is {agreement:.2f}: {what}? "
            "method.check=false takes it"
        )

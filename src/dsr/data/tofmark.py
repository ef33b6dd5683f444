"""``dataset=tofmark``: samples of a time-of-flight sensor and a photo (Ferstl et al., ICCV 2013).

Voynov et al. 2019 use Books, Devil and Shark with the maps of the real sensor as the input.

    benchmarking_dataset_NAME.mat     intensity, true depth, and the sensor's samples projected into the intensity image
    NAME.bmp, NAME_depth.bmp          intensity and samples in 8 bits; 0 = no sample, which 97.5 % of the pixels are

all of 610 x 810 pixels. No names of variables are published for the ``.mat`` files, so variables are recognised by
their names and sizes, or named by the caller. Depths are orthogonal, in millimetres where their median exceeds 50, else
in metres. In ``*_depth.bmp`` 255 is the farthest sample, and levels are linear in depth; what depth a level stands for
is the caller's to give. No file holds a camera: :data:`ESTIMATED` fits 72 correspondences with the scene Books, which
the paper's authors published with a camera, to a root mean square error of 0.95 pixels.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dsr.data.frame_files import expect_size, given_camera, in_natural_order, name_of, read_picture, to_depth, walk
from dsr.data.matlab import read_variables
from dsr.data.scene_source import PreparedDataset, SceneSelection, make_records
from dsr.io.images import read_levels
from dsr.sample import Scene

FACTORS = (4, 8)  # of the measured maps: about 40 % of the 4 x 4 blocks have a sample, and nearly all of 8 x 8
_MILLIMETRES = 50.0
_SMALLEST = 16
_SPARSE = 0.2
# What the names of variables hold, in small letters and digits alone, by what they are; the first counts most
_ROLES: Mapping[str, tuple[str, ...]] = {
    "intensity": ("intensity", "gr[ae]y", "rgb|colou?r", "im(g|age)?$", "^i$"),
    "depth": ("truth|gt", "hr|highres", "depth"),
    "samples": ("tof", "sparse|projected", "lr|mr|lowres", "depth"),
}
_OTHER = "weight|mask|conf|amplitude"  # in the names of variables that are none of these
_NO_INTENSITY = f"{_OTHER}|depth|tof|disp"


def find_frames(root: Path) -> dict[str, tuple[Path, Path | None]]:
    """Return the first arguments of :func:`load_frame` by name ("books"), in order: a .mat file, else the pictures."""
    found: dict[str, tuple[Path, Path | None]] = {}
    for folder, _, files in walk(root):
        for file in files:
            depth = re.fullmatch(r"(.+)_depth\.bmp", file)
            if depth and f"{depth[1]}.bmp" in files:
                found.setdefault(name_of(root, folder, depth[1]), (folder / f"{depth[1]}.bmp", folder / file))
            elif matrix := re.fullmatch(r"benchmarking_dataset_(.+)\.mat", file):
                found[name_of(root, folder, matrix[1])] = (folder / file, None)
    return in_natural_order(found)


def load_frame(
    path: Path,
    samples_path: Path | None,
    dataset: str,
    name: str,
    *,
    intrinsics: tuple[float, float, float, float] | None = None,
    depth_range: tuple[float, float] | None = None,
    variables: Mapping[str, str] | None = None,
) -> Scene:
    """Return one scene, with the samples as measured low-resolution maps.

    ``path`` is a ``.mat`` file, whose ``variables`` are found if they are not named, or the intensity picture beside
    ``samples_path``, which needs ``depth_range``, metres of levels 1 and 255, and has no true depth.
    """
    if intrinsics is None:
        raise ValueError(f"{path}: expected intrinsics=(fx, fy, cx, cy) beside it, as the files hold no camera")
    depth = None
    if samples_path is None:
        rgb, depth, samples = read_matrices(path, variables)
    else:
        rgb = read_picture(path)
        levels, known = read_samples(samples_path)
        if depth_range is None:
            ends = "depth_range=(metres of 1, metres of 255)"
            raise ValueError(f"{samples_path}: expected {ends}, as 8 bits have lost the metric scale")
        near, far = depth_range
        if not 0 < near < far < np.inf:
            raise ValueError(f"depth_range: expected 0 < metres of 1 < metres of 255, got {near:g} and {far:g}")
        samples = torch.where(known, near + (levels * 255 - 1) / 254 * (far - near), torch.nan)
        expect_size(samples_path, samples, tuple(rgb.shape[1:]))
    camera = given_camera(intrinsics, (rgb.shape[1], rgb.shape[2]))
    measured: dict[float, Tensor] = {}
    if samples is not None:
        measured = {factor: block_means(samples, factor) for factor in FACTORS}
    return Scene(dataset, name, rgb, camera, depth, measured)


def read_samples(path: Path) -> tuple[Tensor, Tensor]:
    """Return the levels of a ``*_depth.bmp`` over 255, (1, H, W) float64, and where there is a sample, bool."""
    levels = torch.from_numpy(read_levels(path))[None]
    if not levels.any():
        raise ValueError(f"{path}: expected at least one sample, all pixels are 0")
    return levels.double() / 255, levels > 0


def read_matrices(
    path: Path, variables: Mapping[str, str] | None = None
) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Return the picture, (3, H, W) float32 in [0, 1], and depth and samples, (1, H, W) float64 in metres, or None."""
    found = read_variables(path)
    listed = ", ".join(f"{name} {' x '.join(map(str, array.shape))}" for name, array in found.items()) or "no matrix"
    chosen = dict(variables or {})
    for role, name in chosen.items():
        if role not in _ROLES:
            raise ValueError(f"variables: expected {', '.join(_ROLES)}, got {role}")
        if name not in found:
            raise ValueError(f"{path}: expected the variable {name}, got {listed}")
    for role in _ROLES:
        fitting = chosen.get(role) or _fitting_variable(path, role, found, chosen)
        if fitting is not None:
            chosen[role] = fitting
    if "intensity" not in chosen or len(chosen) == 1:
        raise ValueError(f"{path}: expected an intensity image and depth or samples of its size, got {listed}")
    rgb = _picture(path, chosen["intensity"], found[chosen["intensity"]])
    maps = {role: _depth(path, chosen[role], found, rgb) for role in ("depth", "samples") if role in chosen}
    return rgb, maps.get("depth"), maps.get("samples")


def block_means(depth: Tensor, factor: int) -> Tensor:
    """Return the mean of 1/z in each ``factor`` x ``factor`` block of a depth map (1, H, W), as depth."""
    height, width = depth.shape[1] // factor, depth.shape[2] // factor
    inverse = depth[:, : height * factor, : width * factor].reciprocal().reshape(1, height, factor, width, factor)
    return inverse.nanmean(dim=(2, 4)).reciprocal()


def _fitting_variable(path: Path, role: str, found: Mapping[str, np.ndarray], chosen: Mapping[str, str]) -> str | None:
    """Return the variable that fits a role by its size and best by its name; None where none fits."""
    size = found[chosen["intensity"]].shape[:2] if "intensity" in chosen else None
    names = {name: re.sub(r"[^a-z0-9]", "", name.rpartition(".")[2].lower()) for name in found}
    fitting = []
    for name, array in found.items():
        if role == "intensity":
            fits = min(array.shape[:2]) >= _SMALLEST and (array.ndim == 2 or array.shape[2:] == (3,))
        else:
            fits = array.shape == size and ((array > 0).mean() < _SPARSE) == (role == "samples")
        other = re.search(_NO_INTENSITY if role == "intensity" else _OTHER, names[name])
        if fits and not other and name not in chosen.values():
            fitting.append(name)
    fitting.sort(key=lambda name: -found[name].size)
    for words in _ROLES[role]:
        for name in fitting:
            if re.search(words, names[name]):
                return name
    if len(fitting) > 1 and role != "intensity":
        raise ValueError(f"{path}: expected one variable for {role}, it may be any of {', '.join(fitting)}")
    return fitting[0] if fitting and role != "intensity" else None


def _picture(path: Path, name: str, array: np.ndarray) -> Tensor:
    """Return an intensity or colour image, (3, H, W) in [0, 1]; floats beyond 1 count up to 255."""
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3):
        raise ValueError(f"{path}: {name}: expected an image, got shape {array.shape}")
    top = np.iinfo(array.dtype).max if array.dtype.kind in "iu" else 255.0 if array.max(initial=0) > 1 else 1.0
    with np.errstate(over="ignore"):  # what is too large is no image
        values = np.atleast_3d(array).astype(np.float32) / top
    if not ((values >= 0) & (values <= 1)).all():
        raise ValueError(
            f"{path}: {name}: expected an image from 0 to 1 or 255, got {array.min():g} to {array.max():g}"
        )
    return torch.from_numpy(values).permute(2, 0, 1).expand(3, -1, -1).contiguous()


def _depth(path: Path, name: str, found: Mapping[str, np.ndarray], rgb: Tensor) -> Tensor:
    array = found[name]
    if array.shape != tuple(rgb.shape[1:]):
        raise ValueError(f"{path}: {name}: expected shape {tuple(rgb.shape[1:])} like the image's, got {array.shape}")
    values = np.where(np.isfinite(array), array, 0.0)
    known = values[values > 0]
    unit = 1e-3 if known.size and np.median(known) > _MILLIMETRES else 1.0
    return to_depth(path, values * unit)


SCENES = ("books", "devil", "shark")
ESTIMATED = (549.2, 549.2, 375.2, 334.3)  # fx, fy, cx, cy in pixels of the 610 x 810 photos
DETECTED = ((find_frames, load_frame, "tofmark"),)


class ToFMark(PreparedDataset):
    """Scenes of ToFMark at their original size, with the samples as measured maps at x4 and x8."""

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        intrinsics: Sequence[float] | None = None,
        depth_range: Sequence[float] | None = None,
        variables: Mapping[str, str] | None = None,
    ) -> None:
        for name, values, count in (("intrinsics", intrinsics, 4), ("depth_range", depth_range, 2)):
            if values is not None and len(values) != count:
                raise ValueError(f"{name}: expected {count} numbers, got {len(values)}")
        found = make_records(
            find_frames(Path(root).expanduser()),
            load_frame,
            "tofmark",
            "the benchmark has no camera: it is an estimate" if intrinsics is None else "",
            intrinsics=tuple(intrinsics or ESTIMATED),
            depth_range=depth_range and tuple(depth_range),
            variables=variables and dict(variables),
        )
        super().__init__("tofmark", root, found, scenes, SCENES)

"""``dataset=middlebury``, ``middlebury2001`` .. ``middlebury2006``, ``middlebury_train``: stereo benchmarks.

``middlebury`` has the seven scenes of the 2014 data set on which Voynov et al. 2019 evaluate, the others have all
scenes of their year. ``middlebury_train`` has scenes to train on, none of which is an evaluation scene: Hui et al. 2016
trained MSG on 34 images of Middlebury (6 of 2001, 10 of 2006, 18 of 2014), and Voynov et al. 2019 MSG-V on patches of
them. They do not say which. It has all scenes of 2001 and 2006, and those of 2014 without the seven evaluation scenes.

Formats as on vision.middlebury.edu/stereo/data: disparity d in pixels of the left view, z = baseline f / (d + doffs).

- 2014 (Scharstein et al., GCPR 2014): ``im0.png``, ``calib.txt``, ``disp0.pfm`` (``disp0GT.pfm`` in the smaller sizes
  of the evaluation kit); inf = unknown.
- 2005, 2006 (Scharstein and Pal, Hirschmueller and Scharstein, CVPR 2007): ``view1.png``, ``disp1.png``, 0 = unknown.
  f = 3740 pixels at full size, baseline 160 mm. A level is a pixel of the full size, be the map full size, half or a
  third; ``dmin.txt`` has the disparity, in such pixels, by which the views were shifted. Where it is missing 200 are
  assumed: those of Art, by the evaluation kit's calibration of it. Depth is not metric then, though planes stay planes.
- 2003 (Scharstein and Szeliski, CVPR 2003): ``im2.png``, ``disp2.png``, 4 levels a pixel, 0 = unknown. The camera is
  the one that the evaluation kit has for Teddy.
- 2001 (Scharstein and Szeliski, IJCV 2002): ``im2.ppm``, ``disp2.pgm``, 8 levels a pixel. No camera was published; it
  is assumed to be the one of 2003.
"""

import functools
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from torch import Tensor

from dsr.data.download import CATALOGUE
from dsr.data.frame_files import expect_size, read_picture
from dsr.data.reference_depth import smooth_levels
from dsr.data.scene_source import WITHOUT_OFFSET, Preparation, PreparedDataset, SceneRecord, SceneSelection
from dsr.geometry.camera import Camera, from_range
from dsr.io.images import read_levels, read_map
from dsr.sample import Scene
from dsr.utils.guards import expect_one_of, naming, natural_key, numbers_in, read_text

_MATRIX = re.compile(r"\[\s*(\S+)\s+0\s+(\S+)\s*;\s*0\s+(\S+)\s+(\S+)\s*;\s*0\s+0\s+1\s*\]")
_FULL_HEIGHT, _FULL_FOCAL, _BASELINE = 1110, 3740.0, 0.16
_ASSUMED_SHIFT = 200.0
_NOISY = MappingProxyType({4: "_depth_2_n.png", 8: "_depth_3_n.png"})


@dataclass(frozen=True)
class Files:
    """The files of a scene of 2001 to 2006."""

    photo: Path
    disparity: Path
    shift: Path | None  # dmin.txt
    measured: Mapping[int, Path]  # noisy low-resolution disparities by factor


def find_2014(root: Path) -> dict[str, Path]:
    """Return the folders of the scenes of 2014 below ``root``, by name in lower case, without ``-perfect``."""
    found: dict[str, Path] = {}
    for folder in sorted((path.parent for path in root.glob("*/calib.txt")), key=natural_key):
        found.setdefault(re.sub(r"-(im)?perfect$", "", folder.name).casefold(), folder)  # imperfect sorts first
        if folder.name.endswith("-perfect"):
            found[folder.name.removesuffix("-perfect").casefold()] = folder
    return found


def find_levels(root: Path) -> dict[str, Files]:
    """Return the files of the scenes of 2001 to 2006 below ``root``, by name in lower case.

    ``NAME/view1.png``, ``NAME/im2.png`` or ``.ppm`` with their disparity, or ``NAME_color.png`` and ``NAME_big.png``.
    """
    found: dict[str, Files] = {}
    for photo, disparity in (("view1.png", "disp1.png"), ("im2.png", "disp2.png"), ("im2.ppm", "disp2.pgm")):
        for path in sorted(root.glob(f"*/{photo}"), key=natural_key):
            shift = path.with_name("dmin.txt")
            files = Files(path, path.with_name(disparity), shift if shift.is_file() else None, {})
            found[path.parent.name.casefold()] = files
    for path in sorted(root.glob("*_color.png"), key=natural_key):
        name = path.name.removesuffix("_color.png")
        level_path = root / f"{name}_big.png"
        if not level_path.is_file():  # other benchmarks' photos are called so, too
            continue
        measured = {factor: root / (name + end) for factor, end in _NOISY.items() if (root / (name + end)).is_file()}
        found[name.casefold()] = Files(path, level_path, None, measured)
    return found


def load_2014(folder: Path, dataset: str, name: str, *, offset: bool = True) -> Scene:
    """Return the scene of 2014 in ``folder``; without ``offset``, doffs of ``calib.txt`` is taken for 0."""
    camera = read_calibration(folder / "calib.txt")
    path = folder / "disp0.pfm"
    if not path.is_file() and (folder / "disp0GT.pfm").is_file():
        path = folder / "disp0GT.pfm"
    values, size = read_map(path), (camera.height, camera.width)
    expect_size(path, values, size)
    values[~np.isfinite(values)] = np.nan
    low = -camera.doffs if offset else 0.0
    if np.nanmin(values, initial=np.inf) <= low:
        raise ValueError(f"{path}: expected disparities above {low:g} pixels, got {np.nanmin(values):g}")
    if not offset:
        camera = replace(camera, doffs=0.0)
    rgb = read_picture(folder / "im0.png", size)
    return Scene(dataset, name, rgb, camera, _depth(path, values, camera))


def load_levels(files: Files, dataset: str, name: str, year: int, *, smooth: bool = True) -> Scene:
    """Return a scene of 2001 to 2006; ``smooth`` removes the steps of the rounding to levels."""
    levels = read_levels(files.disparity).astype(np.float64)
    height, width = levels.shape
    cx, cy = (width - 1) / 2, (height - 1) / 2
    if year in (2001, 2003):  # the camera is Teddy's
        camera, per_pixel = Camera(width, height, 1500.0, 1500.0, 199.0, 187.0, 0.08, 52.0), 4
        if year == 2001:
            camera, per_pixel = replace(camera, cx=cx, cy=cy), 8
    else:
        per_pixel = round(_FULL_HEIGHT / height)
        if per_pixel not in (1, 2, 3):
            raise ValueError(f"{files.disparity}: expected a height near {_FULL_HEIGHT}, 1/2 or 1/3, got {height}")
        shift = _ASSUMED_SHIFT
        if files.shift is not None:
            shift = _number(files.shift, "dmin", read_text(files.shift).strip())
        focal = _FULL_FOCAL / per_pixel
        camera = Camera(width, height, focal, focal, cx, cy, _BASELINE, shift / per_pixel)
    levels[levels == 0] = np.nan
    depth = _depth(files.disparity, (smooth_levels(levels) if smooth else levels) / per_pixel, camera)
    measured: dict[float, Tensor] = {}
    for factor, path in files.measured.items():
        camera_lr = camera.downscale(factor)
        values = read_levels(path).astype(np.float64)
        expect_size(path, values, (camera_lr.height, camera_lr.width))
        values[values == 0] = np.nan
        measured[factor] = _depth(path, values / (per_pixel * factor), camera_lr)
    return Scene(dataset, name, read_picture(files.photo, (height, width)), camera, depth, measured)


def read_calibration(path: Path) -> Camera:
    """Return the left camera of a ``calib.txt``: lines ``key=value``, baseline in millimetres, the rest in pixels."""
    lines = read_text(path).splitlines()
    entries = {key.strip(): value.strip() for key, equals, value in (line.partition("=") for line in lines) if equals}
    matrix = _MATRIX.fullmatch(entries.get("cam0", ""))
    if matrix is None:
        raise ValueError(f"{path}: cam0: expected [f 0 cx; 0 f cy; 0 0 1], got {entries.get('cam0', 'nothing'):.60}")
    fx, cx, fy, cy = (_number(path, "cam0", text) for text in matrix.groups())
    keys = ("doffs", "baseline", "width", "height")
    doffs, baseline, width, height = (_number(path, key, entries.get(key, "nothing")) for key in keys)
    with naming(path):
        return Camera(int(width), int(height), fx, fy, cx, cy, baseline / 1000, doffs)


def _number(path: Path, key: str, text: str) -> float:
    value = next(iter(numbers_in([text])), np.nan)
    if not np.isfinite(value) or (key in ("width", "height") and not value.is_integer()):
        came = "".join(letter for letter in text if letter.isprintable())
        raise ValueError(f"{path}: {key}: expected a number, got {came:.40}")
    return value


def _depth(path: Path, disparity: np.ndarray, camera: Camera) -> Tensor:
    if np.isnan(disparity).all():
        raise ValueError(f"{path}: expected at least one known disparity, all are unknown")
    return from_range(torch.from_numpy(disparity)[None], camera, "disparity")


def _scenes(dataset: str, folder: str) -> tuple[str, ...]:
    """Return the names of scenes in the catalogue: those of their folders in lower case."""
    places = (Path(item.path).parent for item in CATALOGUE[dataset].items)
    names = (place.name.removesuffix("-perfect").casefold() for place in places if place.parent.name == folder)
    return tuple(dict.fromkeys(names))


EVALUATION_2014 = _scenes("middlebury", "middlebury2014")
TRAINING_2014 = _scenes("middlebury_train", "middlebury2014")
SCENES = {year: _scenes(f"middlebury{year}", f"middlebury{year}") for year in (2001, 2003, 2005, 2006)}
TRAINING = {2001: SCENES[2001], 2006: SCENES[2006], 2014: TRAINING_2014}  # scenes to train on by year
_FILES_2014 = ("im0.png", "calib.txt", "disp0.pfm", "disp0GT.pfm")


class Middlebury(PreparedDataset):
    """Scenes of Middlebury 2014; the paper leaves the offset out of Vintage, but not of Recycle and Playroom."""

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        fill: Sequence[str] = ("vintage",),
        without_offset: Sequence[str] = ("vintage",),
    ) -> None:
        found = records_2014(Path(root).expanduser(), "middlebury", without_offset)
        super().__init__("middlebury", root, found, scenes, EVALUATION_2014, Preparation(size, crop, fill=tuple(fill)))


class MiddleburyLevels(PreparedDataset):
    """Scenes of Middlebury 2001, 2003, 2005 or 2006, with disparities in 8 bits, whose steps may be smoothed."""

    def __init__(
        self,
        root: str,
        year: int,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        fill: Sequence[str] = (),
        smooth: bool = True,
    ) -> None:
        expect_one_of("year", year, SCENES)
        name = f"middlebury{year}"
        found = records_levels(Path(root).expanduser(), name, year, smooth=smooth)
        super().__init__(name, root, found, scenes, SCENES[year], Preparation(size, crop, fill=tuple(fill)))


class MiddleburyTrain(PreparedDataset):
    """Scenes of Middlebury 2001, 2006 and 2014 without the evaluation scenes, a folder ``middlebury2001`` for each."""

    evaluation = False

    def __init__(
        self, root: str, scenes: SceneSelection = None, size: int | None = 720, years: Sequence[int] = tuple(TRAINING)
    ) -> None:
        name, folder = "middlebury_train", Path(root).expanduser()
        found: dict[str, SceneRecord] = {}
        for year in years:
            if year not in TRAINING:
                raise ValueError(f"years: expected some of {', '.join(map(str, TRAINING))}, got {year}")
            place = folder / f"middlebury{year}"
            found |= records_2014(place, name) if year == 2014 else records_levels(place, name, year)
        for scene in EVALUATION_2014:
            found.pop(scene, None)
        named = [scene for year in years for scene in TRAINING[year]]
        preparation = Preparation(size, crop=None, enlarge=False)
        super().__init__(name, root, found, scenes, named, preparation)


def records_2014(folder: Path, dataset: str, without_offset: Collection[str] = ()) -> dict[str, SceneRecord]:
    """Return the records of the scenes of 2014 on disk; the disparity offset of ``without_offset`` is replaced by 0."""
    return {
        name: SceneRecord(
            tuple(path for path in map(place.joinpath, _FILES_2014) if path.is_file()),
            functools.partial(load_2014, place, dataset, name, offset=name not in without_offset),
            settings="without offset" if name in without_offset else "",
            note=WITHOUT_OFFSET if name in without_offset else "",
        )
        for name, place in find_2014(folder).items()
    }


def records_levels(folder: Path, dataset: str, year: int, *, smooth: bool = True) -> dict[str, SceneRecord]:
    """Return the records of the scenes of 2001 to 2006 on disk, with notes of those whose depth is not metric."""
    records = {}
    for name, files in find_levels(folder).items():
        note = "" if files.shift else "depth is not metric: there is no dmin.txt, the shift of Art is assumed"
        if year in (2001, 2003):
            note = "depth is not metric: no camera was published, that of Teddy in the evaluation kit is assumed"
        paths = tuple(path for path in (files.photo, files.disparity, files.shift, *files.measured.values()) if path)
        load = functools.partial(load_levels, files, dataset, name, year, smooth=smooth)
        records[name] = SceneRecord(paths, load, settings="" if smooth else "terraces", note=note)
    return records

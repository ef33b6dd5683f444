"""The cameras of a photo, and of a depth map of another camera: from files, numbers or EXIF data, or assumed.

Warnings of implausible cameras, baselines and distances follow the rules of ``dsr doctor``.
"""

import math
import re
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AliasChoices, BaseModel, BeforeValidator, Field, model_validator
from torch import Tensor

from dsr.geometry.camera import ASSUMED_FOV, Camera, RangeType, expect_intrinsics
from dsr.geometry.plausible import implausible_distance, judge_camera, may_be_of, plausible_baseline
from dsr.io.images import Pixels, Size, pixels_in_header
from dsr.io.photos import read_exif, same_aspect
from dsr.io.reading import CameraChoice
from dsr.io.trajectories import intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.guards import naming, numbers_in, parse_json, read_text, refusing, split_numbers
from dsr.utils.progress import show_length
from dsr.utils.validation import Number, parse_model

_FOCAL_OF_ONE = 20  # focal length in widths of the picture, which no lens of a photo with depth has
# Of 35 mm film in millimetres, which equivalent focal lengths refer to (CIPA DCG-001).
_FILM_DIAGONAL = math.hypot(36, 24)
_SAMPLE = 100_000  # depths that percentiles are taken of
_METRES = {"m": 1.0, "mm": 1e-3}


@dataclass(frozen=True)
class CameraFile:
    """The content of a camera file; None for what it does not state."""

    camera: Camera  # in pixels and metres
    range_type: RangeType | None = None  # how the maps beside it count
    depth_unit: float | None = None  # metres per value in depth files
    hole_value: float | None = None  # the value that stands for a hole in files that cannot hold NaN


def find_camera(choice: CameraChoice, photo: Path, size: Size, size_lr: Size) -> tuple[CameraFile, list[Assumption]]:
    """Return the camera of a photo's pixels, with the depth encoding from its file, and the assumptions."""
    height, width = size
    if choice.file is not None:
        return _fit_to_photo(choice.file, read_any_camera(choice.file), size, size_lr, photo)
    if choice.intrinsics is not None:
        return CameraFile(Camera(width, height, *choice.intrinsics)), []
    if choice.fov is not None:
        return CameraFile(Camera.from_fov(choice.fov, width, height)), []
    equivalent = read_exif(photo).focal
    if equivalent is not None:
        focal = equivalent / _FILM_DIAGONAL * math.hypot(width, height)
        assumption = Assumption(
            "camera: focal length from the photo's EXIF data, principal point in the middle",
            f"{equivalent:g} mm for 35 mm film = {focal:.5g} pixels",
        )
        return CameraFile(Camera.centred(width, height, focal)), [assumption]
    camera = Camera.from_fov(ASSUMED_FOV, width, height)
    text = f"camera: none given, {ASSUMED_FOV:g} degrees of horizontal view assumed (--camera, --fov or --intrinsics)"
    return CameraFile(camera), [Assumption(text, f"{camera.fx:.5g} pixels")]


def read_any_camera(path: Path) -> CameraFile | np.ndarray:
    """Return the content of a camera file; for a matrix without an image size the matrix, (3, 3).

    The formats are ``camera.json`` of dsr, ``cam_params.json`` as NICE-SLAM's data sets have it, Open3D's JSON, YAML of
    OpenCV, ROS and RTAB-Map; and, without an image size, MoGe's JSON (``fov_x`` and ``fov_y`` in degrees), and text of
    3 x 3 or 4 x 4 numbers, as SUN RGB-D and ScanNet have it, or of fx fy cx cy, as ETH3D has it.
    """
    text = read_text(path)
    if "camera_matrix:" in text:
        return _of_yaml(path, text)
    if path.suffix.lower() != ".json" and not text.lstrip().startswith("{"):
        numbers = numbers_in(split_numbers(text))
        if len(numbers) == 4:
            numbers = [numbers[0], 0, numbers[2], 0, *numbers[1::2], 0, 0, 1]
        if len(numbers) not in (9, 16):
            raise ValueError(f"{path}: expected JSON or a matrix of 3 x 3 or 4 x 4 numbers, got something else")
        side = math.isqrt(len(numbers))
        with naming(path):
            return expect_intrinsics(np.array(numbers).reshape(side, side))
    if '"fov_x"' in text:
        with refusing(f"{path}: expected fov_x and fov_y in degrees", ValueError, TypeError, KeyError, ArithmeticError):
            fx, fy = (0.5 / math.tan(math.radians(parse_json(text)[name]) / 2) for name in ("fov_x", "fov_y"))
            return expect_intrinsics(np.array([[fx, 0, 0.5], [0, fy, 0.5], [0, 0, 1]]))
    if '"intrinsic_matrix"' in text:
        stored = parse_model(_Open3d, text, path)
        with naming(path):
            matrix = expect_intrinsics(np.array(stored.intrinsic_matrix).reshape(3, 3).T)
            intrinsics = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
            return CameraFile(Camera(stored.width, stored.height, *intrinsics))
    return _of_json(path, text)


def read_camera(path: Path) -> CameraFile:
    """Return the content of a camera file that states the size of its image; see :func:`read_any_camera`."""
    content = read_any_camera(path)
    if isinstance(content, np.ndarray):
        raise ValueError(f"{path}: expected a camera with the size of its image, got a matrix: see Camera.from_matrix")
    return content


def _of_json(path: Path, text: str) -> CameraFile:
    if '"camera"' in text or any(f'"{name}"' in text for name in _SCALES):
        params = parse_model(_Params, text, path)
        with naming(path):
            camera = Camera(params.w, params.h, params.fx, params.fy, params.cx, params.cy)
        return CameraFile(camera, depth_unit=None if params.scale is None else 1 / params.scale)
    entries = parse_model(_CameraJson, text, path).model_dump(exclude_unset=True, exclude_none=True)
    if "baseline" in entries:
        entries["baseline"] *= _METRES[entries.get("baseline_unit", "m")]
    with naming(path):
        camera = Camera(**{each.name: entries[each.name] for each in fields(Camera) if each.name in entries})
    return CameraFile(camera, *map(entries.get, ("range_type", "depth_unit", "hole_value")))


def _metres(unit: Any) -> Any:
    if not isinstance(unit, str):
        return unit
    if unit not in _METRES:
        raise ValueError("m, mm or a positive number of metres per value")
    return _METRES[unit]


_Number = Annotated[Number, Field(ge=-1e12, le=1e12)]
_SCALES = ("png_depth_scale", "scale")


class _CameraJson(BaseModel, strict=True, extra="forbid"):
    """A ``camera.json`` as it is stored; keys that it lacks do not get the defaults."""

    width: Pixels
    height: Pixels
    fx: _Number
    fy: _Number
    cx: _Number
    cy: _Number
    range_type: RangeType | None = None
    baseline: _Number | None = None
    baseline_unit: Literal["m", "mm"] = "m"
    doffs: _Number = 0.0
    depth_unit: Annotated[_Number, Field(gt=0), BeforeValidator(_metres)] = 1.0
    hole_value: _Number = 0.0


class _Params(BaseModel, strict=True):
    """NICE-SLAM's ``cam_params.json``; the scale is the number of values in a metre."""

    w: Pixels = Field(validation_alias=AliasChoices("w", "W", "width"))
    h: Pixels = Field(validation_alias=AliasChoices("h", "H", "height"))
    fx: _Number
    fy: _Number
    cx: _Number
    cy: _Number
    scale: Annotated[_Number, Field(ge=1)] | None = Field(None, validation_alias=AliasChoices(*_SCALES))

    _unwrap = model_validator(mode="before")(
        lambda entries: entries.get("camera", entries) if isinstance(entries, dict) else entries
    )


class _Open3d(BaseModel, strict=True):
    """https://www.open3d.org/docs/release/python_api/open3d.camera.PinholeCameraIntrinsic.html."""

    width: Pixels
    height: Pixels
    intrinsic_matrix: Annotated[list[float], Field(min_length=9, max_length=9)]


def _fit_to_photo(
    path: Path, content: CameraFile | np.ndarray, size: Size, size_lr: Size, photo: Path
) -> tuple[CameraFile, list[Assumption]]:
    assumptions: list[Assumption] = []
    if isinstance(content, np.ndarray):
        content, assumptions = _camera_of_matrix(path, content, size, size_lr)
    camera, orientation = content.camera, 1
    across = not same_aspect((camera.height, camera.width), size) and same_aspect((camera.width, camera.height), size)
    if across and pixels_in_header(photo) != size:
        orientation = read_exif(photo).orientation
    if orientation >= 5:  # the photo is turned, the camera is that of the sensor
        content = replace(content, camera=turn_camera(camera, orientation))
        assumptions.append(Assumption("camera: turned as the photo is by its EXIF data"))
    content, scaled = scale_to_photo(path, content, size)
    return content, [*assumptions, *scaled]


def turn_camera(camera: Camera, orientation: int) -> Camera:
    """Return the camera of a picture that is turned as an EXIF orientation says."""
    cx = camera.width - 1 - camera.cx if orientation in (2, 3, 7, 8) else camera.cx
    cy = camera.height - 1 - camera.cy if orientation in (3, 4, 6, 7) else camera.cy
    if orientation < 5:
        return replace(camera, cx=cx, cy=cy)
    return replace(camera, width=camera.height, height=camera.width, fx=camera.fy, fy=camera.fx, cx=cy, cy=cx)


def scale_to_photo(path: Path, content: CameraFile, size: Size) -> tuple[CameraFile, list[Assumption]]:
    """Return a camera scaled to the photo's (height, width), and the assumptions; ``path`` is for the message."""
    camera = content.camera
    if (camera.height, camera.width) == size:
        return content, []
    text = f"camera: that of {camera.width} x {camera.height} pixels is scaled to the photo's {size[1]} x {size[0]}"
    return replace(content, camera=scale_camera(path, camera, size, "photo")), [Assumption(text)]


def scale_camera(place: object, camera: Camera, size: Size, whose: str = "depth map") -> Camera:
    """Return a camera scaled to a picture's (height, width); a message begins with ``place``."""
    height, width = size
    if not same_aspect((camera.height, camera.width), size):
        got = f"{camera.width} x {camera.height} (width x height)"
        raise ValueError(f"{place}: expected a camera of the {whose}'s aspect, {width} x {height}, got {got}")
    return camera.rescale(width, height)


def _camera_of_matrix(path: Path, matrix: np.ndarray, size: Size, size_lr: Size) -> tuple[CameraFile, list[Assumption]]:
    """Return the camera of a matrix: of the photo's pixels, or else of the depth map's, by its principal point."""
    cx, cy = matrix[0, 2], matrix[1, 2]
    if min(cx, cy) > 0 and max(cx, cy) < 1 and max(matrix[0, 0], matrix[1, 1]) < _FOCAL_OF_ONE:  # of a 1 x 1 picture
        camera = Camera(1, 1, matrix[0, 0], matrix[1, 1], cx - 0.5, cy - 0.5)
        return CameraFile(camera.rescale(size[1], size[0])), []
    for name, (height, width) in (("photo", size), ("depth map", size_lr)):
        if may_be_of(cx, cy, width, height):
            camera = Camera(width, height, matrix[0, 0], matrix[1, 1], cx, cy)
            return CameraFile(camera), [Assumption(f"camera: the matrix is read in pixels of the {name}")]
    text = f"the photo, {size[1]} x {size[0]} (width x height), or of the depth map, {size_lr[1]} x {size_lr[0]}"
    raise ValueError(f"{path}: expected a principal point near the middle of {text}; got {cx:g}, {cy:g}")


def _of_yaml(path: Path, text: str) -> CameraFile:
    """Return the camera of OpenCV's YAML, whose header and tags other readers refuse."""
    found = re.findall(r"^(\w+):.*(?:\n[ \t]+(?!data:).*)*\n[ \t]+data:\s*\[([^\]]*)\]", text, re.MULTILINE)
    lists = {key: numbers_in(split_numbers(values)) for key, values in found}
    sizes = dict(re.findall(r"^image_(width|height):\s*(\d{1,6})\b", text, re.MULTILINE))
    if len(lists.get("camera_matrix", ())) != 9 or len(sizes) < 2:
        raise ValueError(f"{path}: expected image_width, image_height and 9 numbers of camera_matrix, got others")
    if any(lists.get("distortion_coefficients", ())):
        raise ValueError(f"{path}: expected a camera without lens distortion, got distortion_coefficients")
    fx, _, cx, _, fy, cy, *_ = lists["camera_matrix"]
    size = int(sizes["height"]), int(sizes["width"])
    return CameraFile(intrinsics_camera(str(path), size, (fx, fy, cx, cy)))


def doubt_camera(camera: Camera, whose: str, size_lr: tuple[int, int] | None = None) -> list[Assumption]:
    """Return warnings of a camera, of the depth map's (height, width) if its intrinsics may have been given for it."""
    return [
        Assumption(f"{whose}: {each.kind}", f"{each.message}; {each.advice}", each.code, each.value)
        for each in judge_camera(camera, size_lr)
        if each.level != "note"
    ]


def doubt_depth(depth_lr: Tensor, camera: Camera, range_type: RangeType) -> list[Assumption]:
    """Return warnings of distances that no room or table has, and of a baseline that no two cameras have.

    ``range_type``: what the map, (1, h, w) in metres, was read as. A strange baseline is right if disparities become
    plausible depth with it.
    """
    known = depth_lr[depth_lr.isfinite()]
    known = known[:: -(-known.numel() // _SAMPLE)]
    low, high = np.percentile(known.numpy(), (1, 99)).tolist()
    code, doubts = implausible_distance(low, high), []
    baseline = camera.baseline
    if baseline is not None and not plausible_baseline(baseline) and (range_type != "disparity" or code is not None):
        text = f"the baseline is {show_length(baseline)}: --baseline is in metres, between the two cameras of a pair"
        doubts.append(Assumption(text, "", "baseline-short" if baseline < 1 else "baseline-long", baseline))
    if code is not None:
        cure = "--baseline, --depth-unit and the camera set it" if range_type == "disparity" else "--depth-unit sets it"
        text = f"the depth is {'nearer' if code == 'depth-near' else 'farther'} than any depth camera measures; {cure}"
        doubts.append(
            Assumption(text, f"{show_length(low)} to {show_length(high)}", code, high if code == "depth-near" else low)
        )
    return doubts

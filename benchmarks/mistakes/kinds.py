"""The mistakes: each writes what a person would have given, in a folder, and returns the arguments of the command."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mistakes.frames import Frame

RIGHT = "right"
ANSWERS = ("read rightly", "warned", "refused", "silent")  # What may be said of a case
CENTIMETRES, SHIFT, MILLIMETRES = 1e2, 0.05, 1e3
"""Values of a metre; and the shift of a photo as a fraction of its width."""


class Case(NamedTuple):
    """A case: the arguments, and how the values are to be read if they can be: metres per value and range type."""

    arguments: list[str]
    reading: tuple[float, str] | None = None


def judged(case: Case, warnings: Sequence[str], unit: float, range_type: str) -> str:
    """Return which of :data:`ANSWERS` a case that is not refused was given, by how its values were read."""
    wanted, of_type = case.reading or (np.nan, "")
    rightly = abs(unit / wanted - 1) < 1e-3 and range_type == of_type
    return "warned" if warnings else "read rightly" if rightly else "silent"


class Material(NamedTuple):
    """What a case is made of: frames of scenes that differ, its own first; a sequence; a folder for files."""

    frames: Sequence[Frame]
    sequence: Sequence[Frame]
    folder: Path
    rng: np.random.Generator

    @property
    def frame(self) -> Frame:
        """The case's own frame."""
        return self.frames[0]


Maker = Callable[[Material], Case]


def write_photo(path: Path, photo: np.ndarray) -> str:
    """Write a photo, and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), cv2.cvtColor(np.ascontiguousarray(photo), cv2.COLOR_RGB2BGR))
    return str(path)


def write_values(path: Path, values: np.ndarray) -> str:
    """Write a depth map: whole numbers as PNG, where NaN is 0, floats as NumPy has them; and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if values.dtype.kind == "f":
        np.save(path.with_suffix(".npy"), values)
        return str(path.with_suffix(".npy"))
    assert cv2.imwrite(str(path), values)
    return str(path)


def whole(values: np.ndarray, kind: type = np.uint16) -> np.ndarray:
    """Return values as whole numbers, 0 in holes and beyond their range."""
    values = np.nan_to_num(values, nan=0.0)
    return np.where(values <= np.iinfo(kind).max, values, 0).round().astype(kind)


def intrinsics(*numbers: float) -> list[str]:
    """Return the option."""
    return ["--intrinsics", *(f"{number:.6g}" for number in numbers)]


def pair(of: Material, photo: np.ndarray, values: np.ndarray, camera: Sequence[float] | None = None) -> list[str]:
    """Write a pair, and return the arguments for it."""
    own = of.frame.camera
    files = write_photo(of.folder / "photo.png", photo), write_values(of.folder / "depth.png", values)
    numbers = (own.fx, own.fy, own.cx, own.cy) if camera is None else camera
    return ["--rgb", files[0], "--depth", files[1], *intrinsics(*numbers)]


def pictured(change: Callable[[np.ndarray, Material], np.ndarray]) -> Maker:
    """Return what gives a photo that was changed."""

    def make(of: Material) -> Case:
        return Case(pair(of, change(of.frame.photo, of), whole(MILLIMETRES * of.frame.depth)))

    return make


def valued(change: Callable[[np.ndarray, Frame], np.ndarray], reading: tuple[float, str] | None = None) -> Maker:
    """Return what gives a depth map that is stored otherwise."""

    def make(of: Material) -> Case:
        return Case(pair(of, of.frame.photo, change(of.frame.depth, of.frame)), reading)

    return make


def seen(change: Callable[[Frame], tuple[float, float, float, float]]) -> Maker:
    """Return what gives another camera."""

    def make(of: Material) -> Case:
        return Case(pair(of, of.frame.photo, whole(MILLIMETRES * of.frame.depth), change(of.frame)))

    return make


def posed(change: Callable[[np.ndarray], np.ndarray], fewer: int = 0) -> Maker:
    """Return what gives the frames of a sequence with poses that were changed, the last ones left out."""

    def make(of: Material) -> Case:
        for frame in of.sequence:
            name = frame.name.rpartition("-")[2]
            write_photo(of.folder / "rgb" / f"{name}.png", frame.photo)
            write_values(of.folder / "depth" / f"{name}.png", whole(MILLIMETRES * frame.depth))
        kept = of.sequence[: len(of.sequence) - fewer] if fewer >= 0 else [*of.sequence, of.sequence[-1]]
        rows = [change(frame.pose)[:3].ravel() for frame in kept if frame.pose is not None]
        np.savetxt(of.folder / "poses.txt", [[*row, 0, 0, 0, 1] for row in rows])
        camera = of.sequence[0].camera
        arguments = ["--rgb", str(of.folder / "rgb"), "--depth", str(of.folder / "depth")]
        arguments += [
            *("--poses", str(of.folder / "poses.txt")),
            *intrinsics(camera.fx, camera.fy, camera.cx, camera.cy),
        ]
        return Case(arguments)

    return make


def listed(order: Callable[[list[int], np.random.Generator], list[int]]) -> Maker:
    """Return what gives lists of photos and depth maps, the latter in another order."""

    def make(of: Material) -> Case:
        size = of.frame.photo.shape[:2]
        photos, maps = [], []
        for number, frame in enumerate(of.frames):
            resized = cv2.resize(frame.photo, size[::-1], interpolation=cv2.INTER_AREA)
            depth = cv2.resize(frame.depth, of.frame.depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
            photos.append(write_photo(of.folder / f"photo{number}.png", resized))
            maps.append(write_values(of.folder / f"depth{number}.png", whole(MILLIMETRES * depth)))
        maps = [maps[number] for number in order(list(range(len(maps))), of.rng)]
        return Case(["--rgb", *photos, "--depth", *maps])

    return make


def _other(photo: np.ndarray, of: Material) -> np.ndarray:
    """Return the photo of another scene at the size of this one."""
    return cv2.resize(of.frames[1].photo, photo.shape[1::-1], interpolation=cv2.INTER_AREA)


def _shifted(photo: np.ndarray, of: Material) -> np.ndarray:
    """Return a photo of the same size that was moved to the side, with the border repeated."""
    pixels = round(SHIFT * photo.shape[1]) * int(of.rng.choice((-1, 1)))
    return cv2.warpAffine(
        photo, np.float32([[1, 0, pixels], [0, 1, 0]]), photo.shape[1::-1], borderMode=cv2.BORDER_REFLECT
    )


def _disparity(depth: np.ndarray, frame: Frame) -> np.ndarray:
    """Return disparities in pixels of the map, before a stereo camera whose nearest thing has 1/8 of the width."""
    return (depth.shape[1] / 8 * np.nanmin(depth) / depth).astype(np.float32)


def _stretched(depth: np.ndarray) -> np.ndarray:
    """Return depth from 0 to 1 over a picture."""
    low, high = np.nanpercentile(depth, (0.5, 99.5))
    return ((depth - low) / (high - low)).clip(0, 1)


def _coloured(depth: np.ndarray, _: Frame) -> np.ndarray:
    """Return depth as a picture in false colours."""
    return cv2.applyColorMap(whole(255 * _stretched(depth), np.uint8), cv2.COLORMAP_JET)


def _turned(depth: np.ndarray, _: Frame) -> np.ndarray:
    """Return millimetres whose bits are turned as SUN RGB-D turns them."""
    values = whole(MILLIMETRES * depth)
    return (values << 3) | (values >> 13)


def _along_rays(depth: np.ndarray, frame: Frame) -> np.ndarray:
    """Return distances along the rays in millimetres."""
    camera = frame.camera.rescale(depth.shape[1], depth.shape[0])
    return whole(MILLIMETRES * depth * camera.ray_lengths().numpy())


def _quaternion(pose: np.ndarray) -> np.ndarray:
    """Return a pose whose quaternion, w x y z, was read as x y z w."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    turned = np.eye(4)
    turned[:3, :3], turned[:3, 3] = Rotation.from_quat((w, x, y, z)).as_matrix(), pose[:3, 3]
    return turned


def _columns(pose: np.ndarray) -> np.ndarray:
    """Return a pose whose rotation was written by columns."""
    turned = pose.copy()
    turned[:3, :3] = pose[:3, :3].T
    return turned


def _moved_in(pose: np.ndarray, unit: float) -> np.ndarray:
    """Return a pose whose place is in another unit."""
    moved = pose.copy()
    moved[:3, 3] *= unit
    return moved


def _of_camera(frame: Frame, *factors: float) -> tuple[float, float, float, float]:
    """Return the photo's intrinsics, each times a factor."""
    own = (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy)
    fx, fy, cx, cy = (number * factor for number, factor in zip(own, factors, strict=True))
    return fx, fy, cx, cy


def _with_view(frame: Frame, degrees: float) -> tuple[float, float, float, float]:
    """Return the intrinsics of a camera with another field of view."""
    focal = frame.camera.width / 2 / np.tan(np.radians(degrees / 2))
    return focal, focal, frame.camera.cx, frame.camera.cy


def _depth_cameras(frame: Frame) -> tuple[float, float, float, float]:
    """Return the intrinsics of the depth map's pixels."""
    camera = frame.camera.rescale(frame.depth.shape[1], frame.depth.shape[0])
    return camera.fx, camera.fy, camera.cx, camera.cy


def _baseline(of: Material) -> Case:
    """Give disparities with a baseline in millimetres."""
    arguments = pair(of, of.frame.photo, _disparity(of.frame.depth, of.frame))
    return Case([*arguments, "--range-type", "disparity", "--baseline", "100"])


_FLIPPED = np.diag((1.0, -1.0, -1.0, 1.0))
KINDS: Mapping[str, Mapping[str, Maker]] = {
    "photo and depth": {
        "mirrored": pictured(lambda photo, _: photo[:, ::-1]),
        "upside down": pictured(lambda photo, _: photo[::-1]),
        "turned by 180 degrees": pictured(lambda photo, _: photo[::-1, ::-1]),
        "of another scene": pictured(_other),
        "shifted by 5 % of the width": pictured(_shifted),
        "lists in reverse order": listed(lambda numbers, _: numbers[::-1]),
        "lists in another order": listed(lambda numbers, rng: list(np.roll(numbers, rng.integers(1, len(numbers))))),
    },
    "units and encodings": {
        "float centimetres": valued(lambda depth, _: (CENTIMETRES * depth).astype(np.float32), (1e-2, "orthogonal")),
        "float millimetres": valued(lambda depth, _: (MILLIMETRES * depth).astype(np.float32), (1e-3, "orthogonal")),
        "1/5000 m": valued(lambda depth, _: whole(5000 * depth), (1 / 5000, "orthogonal")),
        "1/6553.5 m": valued(lambda depth, _: whole(6553.5 * depth), (1 / 6553.5, "orthogonal")),
        "SUN RGB-D's bits": valued(_turned, (1e-3, "orthogonal")),
        "disparity, floats": valued(_disparity),
        "disparity, 8 bits": valued(lambda depth, frame: whole(_disparity(depth, frame), np.uint8)),
        "inverse depth": valued(lambda depth, _: (np.nanmin(depth) / depth * 37.3).astype(np.float32)),
        "0 to 1": valued(lambda depth, _: _stretched(depth).astype(np.float32)),
        "8 bits for viewing": valued(lambda depth, _: whole(255 * _stretched(depth), np.uint8)),
        "false colours": valued(_coloured),
        "along the rays": valued(_along_rays, (1e-3, "perspective")),
    },
    "cameras": {
        "of twice the size": seen(lambda frame: _of_camera(frame, 2, 2, 2, 2)),
        "of half the size": seen(lambda frame: _of_camera(frame, 0.5, 0.5, 0.5, 0.5)),
        "fy of 5 pixels": seen(lambda frame: (frame.camera.fx, 5.0, frame.camera.cx, frame.camera.cy)),
        "4 degrees of view": seen(lambda frame: _with_view(frame, 4)),
        "172 degrees of view": seen(lambda frame: _with_view(frame, 172)),
        "cx of 1e9": seen(lambda frame: (frame.camera.fx, frame.camera.fy, 1e9, frame.camera.cy)),
        "the depth camera's": seen(_depth_cameras),
        "baseline in millimetres": _baseline,
    },
    "poses": {
        "in millimetres": posed(lambda pose: _moved_in(pose, MILLIMETRES)),
        "world to camera": posed(np.linalg.inv),
        "rotations by columns": posed(_columns),
        "y up, z back": posed(lambda pose: pose @ _FLIPPED),
        "order of the quaternion": posed(_quaternion),
        "one fewer than frames": posed(lambda pose: pose, 1),
        "one more than frames": posed(lambda pose: pose, -1),
    },
    RIGHT: {
        "millimetres, 16 bits": valued(lambda depth, _: whole(MILLIMETRES * depth), (1e-3, "orthogonal")),
        "float metres": valued(lambda depth, _: depth.astype(np.float32), (1.0, "orthogonal")),
        "lists": listed(lambda numbers, _: numbers),
        "a sequence with poses": posed(lambda pose: pose),
    },
}  # fmt: skip
"""By what is wrong: how to make each mistake; and what is right, which nothing may be said of."""

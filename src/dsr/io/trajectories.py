"""Poses of frames and transforms between cameras: from text and JSON files, and from captures."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dsr.geometry.camera import Camera
from dsr.geometry.plausible import may_be_of
from dsr.geometry.poses import Matrix, as_rigid, from_quaternion
from dsr.io.frames import CaptureFrame, Geometry, stated
from dsr.io.pairs import Pair, PairingResult
from dsr.notes import Assumption
from dsr.utils.guards import naming, numbers_in, parse_json, read_text, refusing, split_numbers

_LARGEST_FILE = 256 << 20
_MAX_GAP = 0.02  # seconds between a frame and its pose
_MOST_BETWEEN = 10.0  # metres between the two cameras of a rig; more is taken for millimetres
NO_POSE = Assumption("no pose: the capture has none of the frame")
USUAL_SIZE = (1440, 1920)  # height and width of iPhones' photos, for photos that were made smaller
_OPEN3D_FILES = ("scene/trajectory.log", "trajectory.log")
ARKIT_TO_DSR = np.diag([1.0, -1.0, -1.0, 1.0])  # ARKit's and OpenGL's camera looks along -z with y up; dsr's along z


@dataclass(frozen=True)
class Trajectory:
    """Poses in a file."""

    file: Path
    poses: tuple[Matrix | None, ...]  # camera to world, metres; None where tracking was lost: NaN, infinite or all 0
    times: tuple[float, ...] | None = None  # of each in seconds, or its frame's number; None where the file has none
    ids: tuple[float, ...] | None = None  # number of each frame, RTAB-Map's ninth column

    def assign(self, pairs: Sequence[Pair]) -> Mapping[str, Matrix]:
        """Return the poses of frames by their names, without those of frames that have none.

        Of a file with times, frames get the pose nearest to the time that their capture or a list of them states, or
        to that in their names, within 20 ms, or that of the number in which their names end: whichever suits more
        frames, the first of these if several do. Those of frames without times are else taken in order.
        """
        if self.times is not None:
            named = np.array([pair.named_time for pair in pairs], np.float64)  # None becomes NaN
            own = np.array([pair.time for pair in pairs], np.float64)
            numbers = np.full(len(pairs), np.nan)  # the last ones in the names, unless they are fractions of times
            for place, pair in enumerate(pairs):
                words = re.findall(r"\d+", pair.depth.stem)
                fraction = pair.named_time is not None and "." in pair.depth.stem
                if words and len(words[-1]) < 16 and not fraction:
                    numbers[place] = float(words[-1])
            ways = [(own, _MAX_GAP), *(way for way in ((named, _MAX_GAP), (numbers, 0.0)) if np.isfinite(way[0]).all())]
            nearest = [self.at(*way) for way in ways]
            if self.ids is not None:
                nearest.append(replace(self, times=self.ids).at(numbers, 0.0))
            found = [
                {pair.name: pose for pair, pose in zip(pairs, poses, strict=True) if pose is not None}
                for poses in nearest
            ]
            if best := max(found, key=len):
                return best
            for known, where in ((own, "those of the frames"), (named, "in the names of the frames")):
                if np.isfinite(known).all():
                    raise ValueError(
                        f"{self.file}: expected times as {where}, {known.min():.3f} to {known.max():.3f}, got "
                        f"{min(self.times):.3f} to {max(self.times):.3f}"
                    )
        if len(self.poses) != len(pairs):
            got = f"{len(self.poses)} poses for {len(pairs)} frames"
            raise ValueError(f"{self.file}: expected a pose for each frame, or their times, got {got}")
        return {pair.name: pose for pair, pose in zip(pairs, self.poses, strict=True) if pose is not None}

    def at(self, wanted: np.ndarray, gap: float = _MAX_GAP) -> list[Matrix | None]:
        """Return the pose nearest to each time, None for those without one within a gap in seconds, as for NaN."""
        times = np.array(self.times)
        order = np.argsort(times)
        after = np.searchsorted(times[order], wanted).clip(1, max(len(order) - 1, 1))
        candidates = order[np.stack((after - 1, np.minimum(after, len(order) - 1)))]  # (2, frames)
        gaps = np.abs(times[candidates] - wanted)
        best = candidates[gaps.argmin(0), np.arange(len(wanted))]
        return [self.poses[place] if near <= gap else None for place, near in zip(best, gaps.min(0), strict=True)]


def read_transform(path: Path) -> Matrix:
    """Read a rigid transform from one camera to another, in metres.

    The file is text of 3 x 4 or 4 x 4 numbers; or JSON, nested lists of these, alone or as an object's only matrix.
    """
    text = read_text(path, _LARGEST_FILE)
    if path.suffix.lower() == ".json" or text.lstrip().startswith(("{", "[")):
        matrix = as_rigid(_matrix_of_json(path, text), str(path))
    else:
        rows = _numbers(path, text)
        if len(rows) == 1 and len(rows[0]) in (12, 16):
            rows = np.reshape(rows[0], (-1, 4)).tolist()
        if len({len(row) for row in rows}) > 1:
            raise ValueError(f"{path}: expected a matrix of 3 x 4 or 4 x 4 numbers, got rows of different lengths")
        matrix = as_rigid(rows, str(path))
    distance = math.hypot(*matrix[:3, 3])  # of any finite numbers
    if distance > _MOST_BETWEEN:
        raise ValueError(f"{path}: expected a translation in metres, got one of {distance:g}; are these millimetres?")
    return matrix


def read_poses(path: Path) -> Trajectory:
    """Read poses from camera to world, in metres.

    The formats are that of TUM RGB-D (``timestamp tx ty tz qx qy qz qw`` in each line, and RTAB-Map's ``id``,
    https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats); matrices of 12 or 16 numbers in each line, as
    KITTI's odometry has them; and matrices of four lines each, as in Redwood's and Open3D's ``.log``, whose lines of
    three whole numbers before each matrix number the poses. Lines that begin with ``#`` are comments.

    Poses with times or numbers that differ are returned in the order of these, others in that of the file.
    """
    content = _numbers(path, read_text(path, _LARGEST_FILE))
    rows = [row for row in content if len(row) != 3]
    lengths = {len(row) for row in rows}
    timed = lengths in ({8}, {9})
    if lengths == {4} and len(rows) % 4 == 0:
        rows = np.reshape(rows, (-1, 16)).tolist()
    elif not timed and lengths not in ({12}, {16}):
        text = "lines of 8 numbers (time, translation, quaternion), 9 (and an id), 12, 16 or four times 4 (matrices)"
        raise ValueError(f"{path}: expected {text}, got lines of {', '.join(map(str, sorted(lengths))) or 'none'}")
    poses: list[Matrix | None] = []
    for number, row in enumerate(rows, 1):
        numbers, place = row[1:8] if timed else row[:12], f"{path}: pose {number}"
        if not np.isfinite(numbers).all() or not any(numbers):
            poses.append(None)
        elif timed:
            poses.append(from_quaternion(row[1:4], row[4:8], place))
        else:
            poses.append(as_rigid(np.reshape(row, (-1, 4)), place))
    if not any(pose is not None for pose in poses):
        raise ValueError(f"{path}: expected poses of finite numbers, got none")
    times = [row[0] for row in rows] if timed else [row[0] for row in content if len(row) == 3]
    if timed and not all(map(math.isfinite, times)):
        raise ValueError(f"{path}: expected finite times, got another")
    order = order_of(times) if len(times) == len(poses) else list(range(len(poses)))
    poses = [poses[place] for place in order]
    if not timed:
        return Trajectory(path, tuple(poses))
    ids = tuple(rows[place][8] for place in order) if lengths == {9} else None
    return Trajectory(path, tuple(poses), tuple(times[place] for place in order), ids)


def order_of(numbers: Sequence[float]) -> list[int]:
    """Return the places of poses in the order of their times or numbers; as they are if two are equal."""
    places = range(len(numbers))
    return sorted(places, key=numbers.__getitem__) if len(set(numbers)) == len(numbers) else list(places)


def _numbers(path: Path, text: str) -> list[list[float]]:
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        words = split_numbers(line.partition("#")[0])
        if not words:
            continue
        if not (values := numbers_in(words)):
            raise ValueError(f"{path}: line {number}: expected numbers, got {line!r:.60}")
        rows.append(values)
    return rows


def _matrix_of_json(path: Path, text: str) -> list[list[float]]:
    with refusing(f"{path}: expected JSON or rows of numbers, got something else", ValueError):
        content = parse_json(text)
    if isinstance(content, dict):
        lists = [value for value in content.values() if isinstance(value, list)]
        content = lists[0] if len(lists) == 1 else None
    if isinstance(content, list) and len(content) in (12, 16) and not any(isinstance(each, list) for each in content):
        content = [content[start : start + 4] for start in range(0, len(content), 4)]
    if not isinstance(content, list):
        raise ValueError(f"{path}: expected a matrix of 3 x 4 or 4 x 4 numbers, got something else")
    return content


def check_pose(source: str, matrix: np.ndarray, *, opengl: bool = False) -> np.ndarray:
    """Return a rigid transform (4, 4) from camera to world; ``opengl``: the camera's axes are x right, y up."""
    as_rigid(matrix, source)
    return matrix @ ARKIT_TO_DSR if opengl else matrix


def intrinsics_camera(source: str, size: tuple[int, int], numbers: Sequence[float]) -> Camera:
    """Return the camera of fx, fy, cx, cy in pixels of an image of (height, width); messages begin with ``source``."""
    fx, fy, cx, cy = numbers
    with naming(source):
        if fy <= 0:
            raise ValueError(f"camera fy: expected a positive number of pixels, got {fy!r}")
        return Camera(size[1], size[0], fx, fy, cx, cy)


def fitting_camera(source: str, sizes: Sequence[tuple[int, int]], numbers: Sequence[float]) -> Camera:
    """Return the camera of fx, fy, cx, cy, of the first (height, width) with its principal point near the middle."""
    cx, cy = numbers[2:]
    for height, width in sizes:
        if may_be_of(cx, cy, width, height):
            return intrinsics_camera(source, (height, width), numbers)
    intrinsics_camera(source, sizes[0], numbers)  # says what is wrong with numbers that are not finite
    text = f"near the middle of the {sizes[0][1]} x {sizes[0][0]} photo (width x height)"
    raise ValueError(f"{source}: expected a principal point {text}, got {cx:g}, {cy:g}")


def describe_capture(app: str, unit: str, pairs: Sequence[Pair], *, poses: bool) -> Assumption:
    """Return a line for the user about the metadata of a capture of an app, with depth in a unit."""
    parts = ["intrinsics", *(["poses"] if poses else [])]
    parts += ["confidence"] if any(pair.confidence is not None for pair in pairs) else []
    return Assumption(f"{app}: depth in {unit}; from the capture: {', '.join(parts)}")


def add_trajectory(folder: Path, found: PairingResult) -> PairingResult:
    """Return the pairs of a folder with the poses of Open3D's trajectory (redwood-data.org/indoor/fileformat.html)."""
    path = next((folder / name for name in _OPEN3D_FILES if (folder / name).is_file()), None)
    if path is None or not found.pairs:
        return found
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    try:
        if len(lines) % 5 or any(len(line.split()) != 3 for line in lines[::5]):
            raise ValueError
        order = order_of([int(line.split()[0]) for line in lines[::5]])
    except ValueError:
        expected = "a line of three whole numbers and four of a matrix for each pose"
        raise ValueError(f"{path}: expected {expected}, got {len(lines)} lines") from None
    if found.unpaired or len(order) != len(found.pairs):
        text = f"no poses: {path.name} has {len(order)}, for {len(found.pairs)} pairs"
        text += f" and {len(found.unpaired)} pictures without a partner" if found.unpaired else ""
        return replace(found, assumptions=(*found.assumptions, Assumption(text)))
    pairs: list[Pair] = []
    for rank, (pair, place) in enumerate(zip(found.pairs, order, strict=True)):
        rows = tuple(lines[5 * place + 1 : 5 * place + 5])
        geometry = stated(_geometry_of_log, f"{path}: pose {rank}", rows)
        pairs.append(replace(pair, capture=CaptureFrame("Open3D", geometry, path, "\n".join(rows).encode())))
    text = f"poses: {path.relative_to(folder).as_posix()} of Open3D, one for each photo"
    return replace(found, pairs=tuple(pairs), assumptions=(*found.assumptions, Assumption(text)))


def _geometry_of_log(place: str, rows: tuple[str, ...]) -> Geometry:
    values = [numbers_in(row.split()) for row in rows]
    if [len(row) for row in values] != [4] * 4:
        raise ValueError(f"{place}: expected a matrix of 4 x 4 numbers, got {' '.join(rows)!r:.80}")
    return Geometry(None, check_pose(place, np.array(values)))

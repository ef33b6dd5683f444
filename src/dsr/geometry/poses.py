"""Poses of cameras: rigid transforms, and whether those of frames fit their depth maps.

A pose is the transform from a camera's frame (x right, y down, z forward) to the world's, a 4 x 4 matrix in metres.
:func:`check_poses` moves the points of one depth map into the view of another, where depths should agree: under the
poses as given, under each of :data:`READINGS`, other conventions and units, and without any motion, which shows how
informative the frames are.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsr.geometry.camera import Camera
from dsr.notes import LIMITS, Assumption

Matrix = NDArray[np.float64]

# largest deviation of the product of a rotation with its transpose from the identity: matrices of few decimals
_TOLERANCE = 5e-3


def as_rigid(values: Sequence[Sequence[float]] | np.ndarray, name: str) -> Matrix:
    """Return a 3 x 4 or 4 x 4 transform as a 4 x 4 matrix with an orthonormal rotation; errors begin with ``name``."""
    expected = f"{name}: expected a matrix of 3 x 4 or 4 x 4 numbers, got"
    try:
        if not isinstance(values, np.ndarray) and any(isinstance(each, bool | str) for row in values for each in row):
            raise TypeError
        matrix = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{expected} something else") from None
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{expected} {' x '.join(map(str, matrix.shape))}")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name}: expected finite numbers, got {matrix[~np.isfinite(matrix)][0]}")
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        columns = np.allclose(matrix[:, 3], (0, 0, 0, 1), atol=1e-6)
        hint = "; are rows and columns exchanged?" if columns else ""
        row = " ".join(f"{value:.4g}" for value in matrix[3])
        raise ValueError(f"{name}: expected 0 0 0 1 as the last row, got {row}{hint}")
    turn = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers too large
        deviation = np.abs(turn @ turn.T - np.eye(3)).max()
    if not deviation <= _TOLERANCE:  # NaN is none either
        lengths = " ".join(f"{math.hypot(*row):.4g}" for row in turn)
        raise ValueError(f"{name}: expected a rigid transform, got rows of length {lengths} that do not form one")
    if np.linalg.det(turn) < 0:
        raise ValueError(f"{name}: expected a rigid transform, got one that mirrors")
    left, _, right = np.linalg.svd(turn)
    rigid = np.eye(4)
    rigid[:3, :3], rigid[:3, 3] = left @ right, matrix[:3, 3]
    return rigid


def from_quaternion(translation: Sequence[float], quaternion: Sequence[float], name: str) -> Matrix:
    """Return the transform of a translation in metres and a unit quaternion (x, y, z, w)."""
    length = math.hypot(*quaternion)
    if not abs(length - 1) <= 0.01:
        raise ValueError(f"{name}: expected a quaternion of length 1, got {length:g}")
    return as_rigid(np.column_stack((rotation_of_quaternion(quaternion), translation)), name)


def rotation_of_quaternion(quaternion: Sequence[float]) -> Matrix:
    """Return the 3 x 3 rotation of a quaternion (x, y, z, w) of any length but 0."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - a third of a second that frames without poses save

    turn: Matrix = Rotation.from_quat(quaternion).as_matrix()
    return turn


def quaternion_of(rotation: Matrix) -> np.ndarray:
    """Return the unit quaternion (x, y, z, w) with w >= 0 of a 3 x 3 rotation."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True))


def invert(transform: Matrix) -> Matrix:
    """Return the inverse of a rigid transform."""
    turn, shift = transform[:3, :3], transform[:3, 3]
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = turn.T, -turn.T @ shift
    return inverse


def relative(pose: Matrix, to: Matrix) -> Matrix:
    """Return the transform from the frame of the camera at ``pose`` to that of the camera at ``to``."""
    return invert(to) @ pose


def in_picture(camera: Camera, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return columns and rows of points in a camera's frame, of any shape, and which are in its picture."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return u, v, (z > 0) & (u > -0.5) & (v > -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)


def visible(points: np.ndarray, camera: Camera, pose: Matrix) -> tuple[np.ndarray, ...]:
    """Return which of some points in the world, (N, 3), are in a picture, their places in it, (M, 2), and depths."""
    x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
    u, v, inside = in_picture(camera, x, y, z)
    found = np.flatnonzero(inside)
    return found, np.stack((u[found], v[found]), axis=1), z[found]


class PosedMap(NamedTuple):
    """A depth map with its camera's place."""

    depth: np.ndarray  # (H, W) in metres, NaN in holes
    camera: Camera
    pose: Matrix  # camera to world
    deviation: np.ndarray | None = None  # (H, W) expected error in metres; None to weight all pixels alike


_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_FORWARD_DOWN = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_DIRECTIONS = ("", "from world to camera")
_ROTATIONS = ("", "with rotations by columns", "with quaternions w x y z")
_AXES: dict[str, Matrix] = {
    "": np.eye(4),
    "of cameras with y up and z backward": _OPENGL,
    "of cameras with x forward and z down": _FORWARD_DOWN,  # as TartanAir has it
    "of cameras with x forward and z up": _OPENGL @ _FORWARD_DOWN,  # y left, of robots (ROS)
}
_LENGTHS = {
    "": 1.0,
    "in millimetres": 1e-3,
    "in centimetres": 1e-2,
    "10 times too small": 10.0,
    "100 times too small": 100.0,
    "1000 times too small": 1000.0,
}


def _read(pose: Matrix, direction: str, turn: str, axes: str, length: str) -> Matrix:
    """Return a pose of a convention in that of this module."""
    rotation = pose[:3, :3]
    if turn == "with rotations by columns":
        rotation = rotation.T
    elif turn == "with quaternions w x y z":  # it was read as x y z w
        w, x, y, z = quaternion_of(rotation)
        rotation = rotation_of_quaternion((x, y, z, w))
    changed = np.block([[rotation, _LENGTHS[length] * pose[:3, 3:]], [pose[3:]]])
    return (invert(changed) if direction else changed) @ _AXES[axes]


# the arguments of all readings by name, those first that change less; "" is as given
READINGS = {
    ", ".join(filter(None, reading)): reading
    for reading in sorted(
        (
            (direction, turn, axes, length)
            for turn, direction, axes, length in itertools.product(_ROTATIONS, _DIRECTIONS, _AXES, _LENGTHS)
            if not turn or not (axes or (direction and turn == "with rotations by columns"))
        ),
        key=lambda reading: sum(map(bool, reading)),
    )
}
_WIDEST = 320  # maps are reduced to at most as many pixels across, by leaving out pixels
_ACROSS = 24  # points across a map that are moved
_GAPS = (0, 1, 3, 10, 30)  # places of the frames of a group that are compared with each other, from its first one
_GROUPS = 4  # groups of frames of a sequence
_TIE = 0.9  # readings whose evidence is at least this much of the best one's cannot be distinguished from it
_MOST_NAMES = 3  # readings that a message names
_AGREEING = 0.04  # difference of two depths over the farther one, up to which frames agree in a pixel
_OVERLAP = 0.3  # share of a frame's points in another one's view, below which the two are not compared
_EXPLAINED = 0.7  # share of the pixels in which frames have to agree under another reading
_LEAST = 0.5  # pairs of frames that disagree wholly without motion; fewer distinguish nothing
_ALIKE = 0.7  # share of the pixels in which frames that look alike agree without any motion
_STILL = 1.2  # times as many pixels have to disagree under the poses as without any motion


def sample(count: int) -> list[tuple[int, ...]]:
    """Return which frames of a sequence to compare with each other, as groups of their places."""
    last = max(count - 1, 0)
    starts = {round(number * max(last - _GAPS[-1], 0) / max(_GROUPS - 1, 1)) for number in range(_GROUPS)}
    groups = {tuple(sorted({min(start + gap, last) for gap in _GAPS})) for start in starts}
    return sorted(group for group in groups if len(group) > 1)


class _Reduced(NamedTuple):
    """A reduced map, its camera, some points with their median depth, and the poses by all readings."""

    depth: np.ndarray
    camera: Camera
    points: np.ndarray  # (3, N)
    middle: float
    poses: np.ndarray  # (readings + 1, 4, 4)


def _prepare(each: PosedMap) -> _Reduced:
    step = min(-(-each.camera.width // _WIDEST), each.camera.height)
    camera = each.camera.decimate(step, step // 2)
    depth = each.depth[step // 2 :: step, step // 2 :: step][: camera.height, : camera.width]
    apart = max(camera.width // _ACROSS, 1)
    part = (slice(None), *[slice(apart // 2, None, apart)] * 2)
    points = (depth * camera.rays().numpy())[part].reshape(3, -1)
    points = points[:, np.isfinite(points[2])]
    middle = float(np.median(points[2])) if points.size else np.nan
    with np.errstate(over="ignore", invalid="ignore"):  # of numbers that no pose has
        poses = np.stack([*(_read(each.pose, *reading) for reading in READINGS.values()), np.eye(4)])
    return _Reduced(depth, camera, points, middle, poses)


def _compare(frame: _Reduced, other: _Reduced) -> tuple[np.ndarray, np.ndarray]:
    """Return overlap and agreement of another frame's points with a frame, (readings + 1,) each."""
    camera, back = frame.camera, frame.poses[:, :3, :3].transpose(0, 2, 1)
    with np.errstate(invalid="ignore", over="ignore"):
        turn, shift = back @ other.poses[:, :3, :3], back @ (other.poses[:, :3, 3:] - frame.poses[:, :3, 3:])
        x, y, z = np.moveaxis(turn @ other.points + shift, 1, 0)  # (readings + 1, points) each
    u, v, inside = in_picture(camera, x, y, z)
    rows, columns = (np.rint(np.where(inside, each, 0)).astype(np.intp) for each in (v, u))
    seen = np.where(inside, frame.depth[rows, columns], np.nan)
    count = np.isfinite(seen).sum(1)
    agreeing = np.abs(seen - z) <= _AGREEING * np.maximum(seen, z)
    return count / max(z.shape[1], 1), agreeing.sum(1) / np.maximum(count, 1)


def check_poses(count: int, load: Callable[[int], PosedMap | None]) -> Assumption | None:
    """Return a warning if frames, which ``load`` returns, disagree under their poses; None if they show too little."""
    pairs: list[tuple[_Reduced, _Reduced]] = []
    for group in sample(count):
        pairs += itertools.combinations([_prepare(each) for each in map(load, group) if each is not None], 2)
    # (pairs, readings + 1) each: under all readings and, last, without motion
    overlap, agreed = np.reshape([_compare(*pair) for pair in pairs], (len(pairs), 2, len(READINGS) + 1)).swapaxes(0, 1)
    with np.errstate(over="ignore", invalid="ignore"):  # distances of the two places as given, over the median depth
        moved = [np.linalg.norm(one.poses[0, :3, 3] - other.poses[0, :3, 3]) / one.middle for one, other in pairs]
    seen = overlap >= _OVERLAP
    without = agreed[:, -1:]
    given = np.where(seen[:, :1], agreed[:, :1], without)
    weight = seen * (1 - without)  # (pairs, readings + 1): as much as a pair disagrees without motion
    total = weight.sum(0)
    means = [(weight * each).sum(0) / np.maximum(total, 1e-9) for each in (agreed, given, without)]
    gain = means[0] - np.maximum(means[1], means[2])
    evidence = np.where((means[0] >= _EXPLAINED) & (total >= _LEAST), total * gain, 0)[:-1]
    best = int(evidence.argmax())
    if evidence[best] > 0 and gain[best] >= LIMITS["poses"]:
        names = list(READINGS)
        tied = [names[place] for place in np.flatnonzero(evidence >= _TIE * evidence[best])]
        simplest = [name for name in tied if name.count(",") == min(other.count(",") for other in tied)]
        as_given = float((weight[:, best] * seen[:, 0] * agreed[:, 0]).sum() / total[best])
        return Assumption(
            f"the poses are probably {' or '.join(simplest[:_MOST_NAMES])}",
            f"as given, neighbouring frames agree in {as_given:.0%} of the pixels, so read in {means[0][best]:.0%}",
            "poses",
            round(float(gain[best]), 3),
        )
    nearest = float(np.min(moved, initial=np.inf))
    if pairs and float(np.median(without)) >= _ALIKE and nearest >= LIMITS["poses-far"]:
        return Assumption(
            "under the poses the camera is far away in the next frame, which looks similar: are they in millimetres?",
            f"{nearest:.3g} times as far as what it sees; {float(np.median(without)):.0%} of the pixels are unchanged",
            "poses-far",
            round(nearest, 1),
        )
    wrong, still = (float((seen[:, 0] * (1 - agreed[:, k])).sum() / max(seen[:, 0].sum(), 1)) for k in (0, -1))
    if wrong < LIMITS["poses-disagree"] or wrong < _STILL * still:
        return None
    return Assumption(
        "neighbouring frames do not agree under the poses",
        f"they do in {1 - wrong:.0%} of the pixels, without any motion in {1 - still:.0%}",
        "poses-disagree",
        round(wrong, 3),
    )

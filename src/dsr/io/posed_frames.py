"""Frames with poses, and points on their surfaces, where splatting starts: COLMAP's model, and initial Gaussians.

The model is binary, as :mod:`dsr.io.captures.colmap` reads it. A track lists the frames whose depth agrees with the
point. The Gaussians are the PLY file of Kerbl et al., *3D Gaussian Splatting*, SIGGRAPH 2023, as ``load_ply`` of
``scene/gaussian_model.py`` in https://github.com/graphdeco-inria/gaussian-splatting reads it.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from dsr.geometry.camera import Camera
from dsr.geometry.poses import Matrix, quaternion_of, visible
from dsr.io.depth_files import read_depth_file
from dsr.io.exports import whole_normals
from dsr.io.images import read_pixels
from dsr.utils.arrays import read_arrays
from dsr.utils.guards import expect_size, pixels_beside

_MOST = 100_000  # points of all frames together
_PINHOLE = 1  # the number of COLMAP's camera model
_LONGEST = 10.0  # times its width that a footprint on a surface seen from the side may be long
_THICKNESS = 0.1  # of a Gaussian along the normal, as a fraction of its width
_FAINTEST, _DENSEST = 0.1, 0.99  # opacities; graphdeco's program starts with the first
_BAND = 0.28209479177387814  # the spherical harmonic of degree 0
_PROPERTIES = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"), *(f"f_rest_{number}" for number in range(45)),
    *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)  # fmt: skip


@dataclass(frozen=True)
class Frame:
    """A photo and a depth map of one size."""

    name: str  # perhaps with folders: kitchen/000012
    camera: Camera
    pose: Matrix | None  # (4, 4) camera to world in metres; None if it is not known
    colour: Path  # an 8-bit PNG
    depth: Path  # a file of (H, W) orthogonal depth in metres, NaN in holes
    up: str = ""  # the axis of the world that points up, one of dsr.io.frames.UPS
    time: float | None = None  # in seconds
    errors: Path | None = None  # an NPZ file, see :func:`read_errors`; None if it is not known
    max_error: float = 0.02  # expected error, as a fraction of the depth, beyond which a pixel is not used as a point

    @property
    def stem(self) -> str:
        """The name as that of a file."""
        return self.name.replace("/", "_")

    @property
    def matrix(self) -> Matrix:
        """The pose, (4, 4); a frame without one stands at the origin."""
        return np.eye(4) if self.pose is None else self.pose

    def read_depth(self) -> np.ndarray:
        """Return the depth, (H, W) float32 in metres, NaN in holes."""
        values = read_depth_file(self.depth, pixels_beside(self.camera.height, self.camera.width))
        expect_size(f"{self.depth}: expected depth of", values, (self.camera.height, self.camera.width))
        return values.astype(np.float32)

    def read_certain(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the depth without pixels that are expected to be off by more than ``max_error``, and these errors."""
        depth = self.read_depth()
        if self.errors is None:
            return depth, np.full(depth.shape, np.nan)
        errors, _ = read_errors(self.errors, self.camera)
        return np.where(errors <= self.max_error * depth, depth, np.float32(np.nan)), errors

    def read_colour(self) -> np.ndarray:
        """Return the photo, (H, W, 3) uint8, red first."""
        most = pixels_beside(self.camera.height, self.camera.width)
        return read_pixels(self.colour, cv2.IMREAD_COLOR, most)[..., ::-1]


def read_errors(path: Path, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected errors of depth and normal, (H, W) float32 each, in metres and degrees, of a result."""
    arrays, size = read_arrays(path, ("depth_error", "angle_error")), (camera.height, camera.width)
    if len(arrays) < 2 or not all(each.shape == size and each.dtype.kind == "f" for each in arrays.values()):
        came = ", ".join(f"{name} {each.dtype} {each.shape}" for name, each in arrays.items()) or "neither"
        raise ValueError(f"{path}: expected depth_error and angle_error of shape {size}, the photo's, got {came}")
    return arrays["depth_error"].astype(np.float32), arrays["angle_error"].astype(np.float32)


class Points(NamedTuple):
    """Points on the surfaces, in the world's frame, each with the piece of surface that it stands for."""

    places: np.ndarray  # (N, 3) in metres
    colours: np.ndarray  # (N, 3) uint8
    axes: np.ndarray  # (N, 3, 3) rotations: columns along the piece, across it, and the normal towards the camera
    sizes: np.ndarray  # (N, 2) of the piece along the first two axes in metres
    errors: np.ndarray  # (N,) expected error of the depth in metres, NaN if it is not known


Observed = list[tuple[np.ndarray, np.ndarray]]  # of each frame: numbers of points, (M,), and their pixels, (M, 2)


def sample_points(frames: Sequence[Frame]) -> tuple[Points, Observed]:
    """Return certain pixels on a grid in each frame, except for those that other frames contradict, and who sees them.

    A frame agrees with a point if its depth there differs by at most ``max_error``, and contradicts it if it sees
    farther all around. A point needs as many frames that agree, its own included, as contradict.
    """
    points = Points(*map(np.concatenate, zip(*(_sample(frame, len(frames)) for frame in frames), strict=True)))
    agreeing, contradicting = np.zeros((2, len(points.places)), int)
    observed: Observed = []
    for frame in frames:
        depth, _ = frame.read_certain()
        found, pixels, z = visible(points.places, frame.camera, frame.matrix)
        columns, rows = np.rint(pixels).astype(np.intp).T
        limit, nearest = frame.max_error * z, cv2.erode(np.nan_to_num(depth), np.ones((3, 3)))  # 0 beside holes
        contradicting[found[nearest[rows, columns] - z > limit]] += 1
        agrees = np.abs(depth[rows, columns] - z) <= limit
        agreeing[found[agrees]] += 1
        observed.append((found[agrees], pixels[agrees]))
    kept = agreeing >= contradicting
    number = np.cumsum(kept) - 1
    observed = [(number[found[kept[found]]], pixels[kept[found]]) for found, pixels in observed]
    return Points(*(each[kept] for each in points)), observed


def _sample(frame: Frame, count: int) -> Points:
    camera, pose, (depth, errors) = frame.camera, frame.matrix, frame.read_certain()
    step = max(1, int(np.ceil(np.sqrt(depth.size * count / _MOST))))
    at = np.s_[::step, ::step]
    known = np.isfinite(depth[at])
    z = depth[at][known].astype(np.float64)
    rays = camera.rays().numpy()[:, *at][:, known].T
    normals = whole_normals(torch.from_numpy(depth)[None], camera).numpy()[:, *at][:, known].T.astype(np.float64)
    normals = np.where(np.isfinite(normals), normals, -rays)  # towards the camera where there are no neighbours
    facing = np.minimum((normals * rays).sum(1), -1e-6)
    # how the point moves with the column and the row of its pixel
    spans = np.eye(3)[None, :, :2] - rays[:, :, None] * (normals[:, None, :2] / facing[:, None, None])
    spans *= z[:, None, None] * (step / np.array([camera.fx, camera.fy]))
    axes, sizes, _ = np.linalg.svd(spans)
    axes[:, :, 2] *= -np.sign((axes[:, :, 2] * rays).sum(1))[:, None]
    axes[:, :, 0] = np.cross(axes[:, :, 1], axes[:, :, 2])
    sizes[:, 0] = np.minimum(sizes[:, 0], _LONGEST * sizes[:, 1])
    places = (rays * z[:, None]) @ pose[:3, :3].T + pose[:3, 3]
    return Points(places, frame.read_colour()[at][known], pose[:3, :3] @ axes, sizes, errors[at][known])


def colmap_model(frames: Sequence[Frame], points: Points, observed: Observed) -> dict[str, bytes]:
    """Return the files of COLMAP's binary model: a camera and an image for each frame, and points with tracks."""
    cameras, images = [struct.pack("<Q", len(frames))], [struct.pack("<Q", len(frames))]
    sights = []
    for number, (frame, (seen, pixels)) in enumerate(zip(frames, observed, strict=True), 1):
        camera, to_camera = frame.camera, frame.matrix[:3, :3].T
        lens = camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5
        cameras.append(struct.pack("<IiQQ4d", number, _PINHOLE, camera.width, camera.height, *lens))
        transform = *quaternion_of(to_camera)[[3, 0, 1, 2]], *(-to_camera @ frame.matrix[:3, 3])
        images += [struct.pack("<I7dI", number, *transform, number), f"{frame.stem}.png\0".encode()]
        rows = np.empty(len(seen), [("pixel", "<f8", 2), ("point", "<u8")])
        rows["pixel"], rows["point"] = pixels + 0.5, seen + 1
        images += [struct.pack("<Q", len(seen)), rows.tobytes()]
        sights.append(np.stack((seen, np.full(len(seen), number), np.arange(len(seen))), axis=1))
    every = np.concatenate(sights)
    tracks = every[np.argsort(every[:, 0], kind="stable"), 1:].astype("<u4").tobytes()
    ends = 8 * np.cumsum(np.bincount(every[:, 0], minlength=len(points.places)))
    content, start = [struct.pack("<Q", len(points.places))], 0
    for number, (place, colour, end) in enumerate(zip(points.places, points.colours, ends.tolist(), strict=True), 1):
        content += [struct.pack("<Q3d3BdQ", number, *place, *colour, 0.0, (end - start) // 8), tracks[start:end]]
        start = end
    files = {"cameras.bin": cameras, "images.bin": images, "points3D.bin": content}
    return {name: b"".join(each) for name, each in files.items()}


def initial_gaussians(points: Points) -> bytes:
    """Return a PLY file of a flat Gaussian for each point, in graphdeco's layout, with colours of degree 0 alone.

    Its standard deviations are the size of the point's piece of surface, and a tenth of its width along the normal.
    Its opacity is the probability that the surface passes within that width, if errors are normally distributed; it is
    graphdeco's 0.1 if no error is known.
    """
    from scipy.special import erf, logit  # noqa: PLC0415 - a third of a second that other parts save

    width = points.sizes[:, 1:]
    passing = np.nan_to_num(erf(width[:, 0] / (np.sqrt(np.pi) * points.errors.clip(min=1e-9))))
    columns = (
        points.places, points.axes[:, :, 2], (points.colours / 255 - 0.5) / _BAND, np.zeros((len(width), 45)),
        logit(passing.clip(_FAINTEST, _DENSEST))[:, None], np.log(np.hstack((points.sizes, _THICKNESS * width))),
        quaternion_of(points.axes)[:, [3, 0, 1, 2]],
    )  # fmt: skip
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(width)}"]
    header += [*(f"property float {name}" for name in _PROPERTIES), "end_header\n"]
    return "\n".join(header).encode() + np.hstack(columns).astype("<f4").tobytes()

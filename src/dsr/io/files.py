"""A photo and a depth map by their paths, as arrays: ``dsr.read`` and ``dsr.read_depth``."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np

from dsr.geometry.camera import Camera, RangeType
from dsr.io.inputs import read_map
from dsr.io.photos import read_photo
from dsr.io.reading import Reading, parse_unit
from dsr.notes import in_python, warn
from dsr.utils.guards import naming


def read(path: str | os.PathLike[str], depth: np.ndarray | None = None) -> np.ndarray:
    """Read a photo as ``dsr upsample`` does.

    Depth maps lie as the file of the photo does, whatever its EXIF data say, so it is not turned upright; unless it has
    the depth map's aspect only then.

    Args:
        path: JPEG, PNG, TIFF, BMP, WebP, PPM, or HEIC (``pip install -e '.[captures]'``).
        depth: (h, w) the depth map; None for one that lies as the file does, with a warning if the file is to be
            turned.

    Returns:
        (H, W, 3) uint8, RGB.

    Raises:
        ValueError: the file is missing, damaged, or of another format.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from PIL import Image
        >>> import dsr
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "photo.png"
        ...     Image.fromarray(np.full((24, 32, 3), 200, np.uint8)).save(path)
        ...     dsr.read(path).shape
        (24, 32, 3)

    """
    size_lr = (1, 1) if depth is None else (depth.shape[-2], depth.shape[-1])  # for a square no photo is turned
    pixels, notes = read_photo(Path(path), size_lr)
    if depth is None:
        warn(notes)
    return np.ascontiguousarray(pixels)


def read_depth(
    path: str | os.PathLike[str],
    unit: str | float | None = None,
    *,
    camera: Camera | None = None,
    range_type: RangeType | None = None,
    baseline: float | None = None,
    hole_value: float | None = None,
) -> np.ndarray:
    """Read a depth map as ``dsr upsample`` does, see docs/upsample.md.

    What is not given is read from a camera file beside the map, or inferred from the values, with a warning.

    Args:
        path: PNG, TIFF, NPY, NPZ, PFM, OpenEXR, or ICL-NUIM's text.
        unit: of the values: ``m``, ``cm``, ``mm``, metres per value such as 0.0002 or ``1/5000``, or ``sunrgbd``.
        camera: of the map's view, of any size; for values that are distances along the ray, or disparities.
        range_type: ``orthogonal``, depth along the axis; ``perspective``, along the ray; or ``disparity``.
        baseline: distance between the two cameras in metres, for disparities; None for the camera's.
        hole_value: a value that marks missing depth, beside 0, NaN, infinity and the largest whole number.

    Returns:
        (h, w) float32, distance to the image plane in metres, NaN in holes.

    Raises:
        ValueError: the file is missing, damaged or of another format, an argument is not as above, or the values may
            be read in two ways.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> import dsr
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "depth.npy"
        ...     np.save(path, np.array([[0, 1500], [1502, 1503]], np.uint16))
        ...     dsr.read_depth(path, unit="mm")
        array([[  nan, 1.5  ],
               [1.502, 1.503]], dtype=float32)

    """
    with python_messages():
        reading = Reading(unit=metres_in(unit), range_type=range_type, baseline=baseline, hole_value=hole_value)
        found, notes = read_map(Path(path), reading, camera)
    warn(notes)
    return found[0].numpy()


def metres_in(unit: str | float | None) -> float | Literal["sunrgbd"] | None:
    """Return metres per value, or ``sunrgbd``, for the unit that a user gives; see :func:`read_depth`."""
    if unit is None:
        return None
    if unit == "sunrgbd":
        return "sunrgbd"
    with naming("unit"):
        return parse_unit(str(unit))


@contextmanager
def python_messages() -> Iterator[None]:
    """Name arguments in place of a command's options in the message of a ValueError from within."""
    try:
        yield
    except ValueError as error:
        raise ValueError(in_python(str(error))) from error

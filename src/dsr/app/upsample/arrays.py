"""Photos and depth maps of notebooks and programs: arrays, tensors and pictures in memory, one or a batch."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.plausible import expect_possible
from dsr.geometry.poses import as_rigid
from dsr.inference.any_ratio import expect_picture
from dsr.io.depth_files import Encoding, decode, far_marks, find_holes, turn_back_bits
from dsr.io.files import metres_in
from dsr.io.images import used_bits
from dsr.io.inputs import Picture
from dsr.io.reading import SUNRGBD_BITS
from dsr.notes import Assumption, warn

_METRES = Encoding(".npy", "float32", 1.0, math.nan, "orthogonal")


def picture_of(
    rgb: Any, depth: Any, camera: Any, *, mask: Any = None, unit: str | float | None = None, pose: Any = None,
    empty: bool = False,
) -> Picture:  # fmt: skip
    """Convert the user's arguments to a picture on the CPU, see :func:`dsr.upsample`.

    The pose is from camera to world, (4, 4) or (3, 4), in metres; depth may be all holes if ``empty`` says so. An error
    begins with the argument's name.
    """
    if not isinstance(camera, Camera):
        raise ValueError(f"camera: expected a dsr.Camera, got {_kind(camera)}; see dsr.Camera.from_matrix")
    expect_possible(camera, "camera")
    if isinstance(depth, np.ma.MaskedArray):
        known = ~np.ma.getmaskarray(depth)
        depth, mask = depth.data, known if mask is None else known & (_as_array(_values(mask, "mask")) != 0)
    photo, given = _photo(rgb, camera), _values(depth, "depth")
    stored = _as_array(given)
    stored = stored[0] if stored.ndim == 3 and len(stored) == 1 else stored
    if stored.ndim != 2 or not stored.size:
        raise ValueError(f"depth: expected a map of shape (h, w), got {_kind(given)}")
    depth_lr, encoding = _metres(stored, unit, camera)
    if mask is not None:
        valid = torch.from_numpy(_as_array(_values(mask, "mask")) != 0)
        if valid.shape[-2:] != stored.shape or valid.numel() != stored.size:
            raise ValueError(f"mask: expected the depth's shape {stored.shape}, got {_kind(mask)}")
        depth_lr = depth_lr.masked_fill(~valid.reshape(1, *stored.shape), torch.nan)
    if not (empty and bool(depth_lr.isnan().all())):
        expect_picture(photo, depth_lr, camera)
    if pose is not None:
        pose = as_rigid(pose.detach().cpu().double().numpy() if isinstance(pose, Tensor) else pose, "pose")
    return Picture(photo, depth_lr, camera, encoding, (), pose)


def pictures_of(rgb: Any, depth: Any, camera: Any, mask: Any) -> Iterator[dict[str, Any]]:
    """Yield the arguments of each picture of a batch; one camera is that of all. Unequal numbers are a ValueError."""
    given = {"rgb": rgb, "depth": depth, "camera": camera, "mask": mask}
    several = {"rgb": rgb, "depth": depth}
    several |= {"camera": camera} if isinstance(camera, list | tuple) else {}
    several |= {} if mask is None else {"mask": mask}
    counts = {name: len(each) if hasattr(each, "__len__") else 1 for name, each in several.items()}
    if len(set(counts.values())) > 1:
        numbers = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise ValueError(f"{', '.join(counts)}: expected as many of each in a batch, got {numbers}")
    for number in range(counts["rgb"]):
        yield {**given, **{name: each[number] for name, each in several.items()}}


def _photo(rgb: Any, camera: Camera) -> Tensor:
    """Return a photo as (3, H, W) float32 in [0, 1]; the range of floats is not checked."""
    if hasattr(rgb, "convert") and hasattr(rgb, "mode"):  # a picture of PIL, which need not be imported for it
        if rgb.mode in ("I", "F"):
            raise ValueError(f"rgb: expected a picture of PIL of 8 bits, or of mode I;16, got mode {rgb.mode}")
        deep = rgb.mode.startswith("I;16")  # which Pillow itself would clip to 8 bits
        rgb = np.repeat(np.asarray(rgb)[..., None], 3, axis=-1) if deep else rgb.convert("RGB")
    given = _values(rgb, "rgb")
    own, axes = ("(3, H, W)", (0, 1, 2)) if isinstance(given, Tensor) else ("(H, W, 3)", (2, 0, 1))
    size = (camera.height, camera.width)
    shape = tuple(given.shape[axis] for axis in axes) if given.ndim == 3 else ()
    if shape != (3, *size):
        which = f"with H = {size[0]} and W = {size[1]}, the camera's" if shape[:1] == (3,) else "RGB"
        raise ValueError(f"rgb: expected a picture of shape {own}, {which}; got {_kind(given)}")
    pixels = torch.from_numpy(_as_array(given)) if not isinstance(given, Tensor) else given.detach().cpu()
    photo = pixels.permute(*axes).contiguous()
    if photo.dtype in (torch.uint8, torch.uint16):
        bits, notes = used_bits(photo.numpy())
        warn(notes)
        return photo.float().div_(2**bits - 1)
    if not photo.is_floating_point():
        raise ValueError(f"rgb: expected values of 8 or 16 bits, or floats from 0 to 1, got {_kind(given)}")
    return photo.float().clone()  # the caller may use its buffer again


def _metres(stored: np.ndarray, unit: str | float | None, camera: Camera) -> tuple[Tensor, Encoding]:
    """Return depth in metres, (1, h, w) float32, and how it was given, of values (h, w)."""
    factor = metres_in(unit)
    kind = f"{stored.dtype} of shape {stored.shape}"
    if stored.dtype.kind not in "fiu" or (stored.dtype.kind in "iu" and stored.dtype.itemsize == 1):
        raise ValueError(f"depth: expected floats, or whole numbers of 16 bits or more, got {kind}")
    if factor is None:
        if stored.dtype.kind != "f":
            raise ValueError(f"depth: expected floats in metres, or whole numbers with unit='mm' or such, got {kind}")
        holes, mark, usual = ~(np.isfinite(stored) & (stored > 0)), math.nan, "NaN"
    else:
        stored = turn_back_bits("depth", stored, SUNRGBD_BITS) if factor == "sunrgbd" else stored
        holes, mark, _ = find_holes(stored, None, above=math.inf)
        usual = "0"
    for value in far_marks(stored, ~holes):  # an array has others for holes
        warn([Assumption(f"depth: many pixels have {value:g}, far beyond all other values; a hole is {usual}")])
    if factor is None:
        return torch.from_numpy(stored.astype(np.float32))[None], _METRES
    suffix = ".png" if stored.dtype == np.uint16 else ".npy"
    encoding = Encoding(suffix, str(stored.dtype), 1e-3 if factor == "sunrgbd" else factor, mark, "orthogonal")
    return decode(stored, holes, encoding, camera.rescale(stored.shape[1], stored.shape[0])), encoding


def _values(given: Any, name: str) -> np.ndarray | Tensor:
    """Return what a user gives as a tensor if it is one, else as an array."""
    if isinstance(given, Tensor):
        return given
    if isinstance(given, np.ndarray) or hasattr(given, "__array__") or hasattr(given, "__array_interface__"):
        return np.asarray(given)
    raise ValueError(f"{name}: expected a NumPy array, a tensor or a picture of PIL, got {_kind(given)}")


def _as_array(given: np.ndarray | Tensor) -> np.ndarray:
    """Return values as an array that torch can share: of this machine's byte order, of positive strides, writeable."""
    if isinstance(given, Tensor):
        given = given.detach().cpu()
        return (given.float() if given.dtype == torch.bfloat16 else given).numpy()
    return np.require(given, given.dtype.newbyteorder("="), ("C", "W"))


def _kind(given: Any) -> str:
    """Return what a user gave, for a message."""
    shape, dtype = getattr(given, "shape", None), getattr(given, "dtype", None)
    if shape is None or dtype is None:
        return type(given).__name__
    return f"{'a tensor of ' if isinstance(given, Tensor) else ''}{dtype} of shape {tuple(shape)}"

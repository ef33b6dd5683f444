"""``dsr.upsample``: depth super-resolution for NumPy arrays and tensors."""

from __future__ import annotations

from typing import Any, Generic, NamedTuple, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.inference.any_ratio import upsampler
from dsr.inference.defaults import DEFAULT, WIDEST, Fill
from dsr.methods.base import MapNoise
from dsr.utils.progress import Steps

Array = TypeVar("Array", np.ndarray, Tensor)


def upsample(
    rgb: Array,
    depth: Array,
    camera: Camera,
    scale: int | None = None,
    *,
    method: str = DEFAULT,
    mask: Array | None = None,
    device: str = "auto",
    fill: Fill = "small",
    max_hole: float = WIDEST,
    progress: Steps | None = None,
    **settings: Any,
) -> Array:
    """Upsample a depth map to the photo's resolution.

    The depth map has to be registered to the photo: the same view and the same field of view, at any size up to the
    photo's, with holes or without. Weights come with the package.

    Args:
        rgb: the photo: a NumPy array (H, W, 3), 0..255 as uint8 or 0..1 as floats; or a tensor
            (3, H, W) with the same values.
        depth: distance to the image plane in metres, as floats, NaN in holes: (h, w), a tensor may be (1, h, w).
        camera: the photo's, ``dsr.Camera(width, height, fx, fy, cx, cy)``, all values in the photo's pixels.
        scale: the upsampling factor; None to choose it by the sizes. ``facets`` refines a depth map that already has
            the photo's size as it is; for a given scale, and for other networks, it is first averaged over blocks of
            scale x scale pixels, 4 x 4 for None.
        method: ``facets``; or any other method in ``conf/method``, such as ``msg_v``, ``tgv``, ``guided_filter``,
            ``bicubic``, and ``dip_v``, which takes minutes.
        mask: valid mask of the depth's shape, for maps whose holes are not NaN.
        device: ``auto`` for a GPU if there is one; or ``cpu``, ``cuda``, ``cuda:1``.
        fill: which holes are filled: ``all``, only ``small`` ones, or ``none``. The others stay NaN.
        max_hole: width of the widest hole that counts as small, in degrees of view; one of 5 pixels always does.
        progress: a function that is called with the number of parts done and their total.
        **settings: the method's arguments, by their names in its file in ``conf/method``, such as ``noise=0.002`` of
            ``facets``, the standard deviation of the map's noise in metres, if it is known.

    Returns:
        Depth in metres, float32: (H, W) for an array, (1, H, W) for a tensor.

    Raises:
        ValueError: a shape, value, method, setting or scale is not as above, or the method has no solution.

    Example:
        A disc in front of a wall, as a low-resolution sensor sees it:

        >>> import numpy as np
        >>> import dsr
        >>> rows, columns = np.mgrid[0:64, 0:96]
        >>> inside = (rows - 32) ** 2 + (columns - 48) ** 2 < 20**2
        >>> photo = np.where(inside[..., None], [200, 120, 80], [60, 70, 90]).astype(np.uint8)
        >>> depth_lr = np.where(inside, 1.0, 2.0).reshape(16, 4, 24, 4).mean(axis=(1, 3))
        >>> depth_lr[3, 5] = np.nan  # a hole
        >>> camera = dsr.Camera(width=96, height=64, fx=80.0, fy=80.0, cx=47.5, cy=31.5)
        >>> depth_hr = dsr.upsample(photo, depth_lr, camera, scale=4)
        >>> depth_hr.shape, bool(np.isfinite(depth_hr).all())
        ((64, 96), True)
        >>> float(depth_hr[32, 48].round(1)), float(depth_hr[2, 2].round(1))
        (1.0, 2.0)

    """
    return upsample_with_errors(
        rgb,
        depth,
        camera,
        scale,
        method=method,
        mask=mask,
        device=device,
        fill=fill,
        max_hole=max_hole,
        progress=progress,
        **settings,
    ).depth


class SurfaceArrays(NamedTuple, Generic[Array]):
    """A result with its expected errors, (H, W) as arrays or (1, H, W) as tensors.

    ``depth`` and ``depth_error`` are in metres, ``angle_error``, that of the normal, in degrees. ``noise``, the
    estimated noise of the input, is None for a method that does not say.
    """

    depth: Array
    depth_error: Array
    angle_error: Array
    noise: MapNoise | None


class Upsampler:
    """A method that loads its weights once, for many pictures or the frames of a camera.

    Args:
        method, scale, device, fill, max_hole, **settings: those of :func:`upsample`.

    Raises:
        ValueError: a method is not as there; settings and scale are checked with the first picture.

    Example:
        >>> import numpy as np
        >>> import dsr
        >>> upsampler = dsr.Upsampler("bicubic")
        >>> camera = dsr.Camera(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)
        >>> for metres in (1.0, 2.0):
        ...     surface = upsampler(np.zeros((24, 32, 3), np.uint8), np.full((12, 16), metres), camera)
        ...     print(f"{surface.depth.mean():.1f} m")
        1.0 m
        2.0 m

    """

    def __init__(
        self,
        method: str = DEFAULT,
        scale: int | None = None,
        *,
        device: str = "auto",
        fill: Fill = "small",
        max_hole: float = WIDEST,
        **settings: Any,
    ) -> None:
        self._run = upsampler(method, scale, settings=settings, device=device, fill=fill, max_hole=max_hole)

    def __call__(
        self, rgb: Array, depth: Array, camera: Camera, *, mask: Array | None = None, progress: Steps | None = None
    ) -> SurfaceArrays[Array]:
        """Upsample a depth map as :func:`upsample` does, and return its expected errors, too; see there."""
        arrays = isinstance(rgb, np.ndarray)
        if isinstance(depth, np.ndarray) != arrays:
            kinds = f"{type(rgb).__name__} and {type(depth).__name__}"
            raise ValueError(f"rgb, depth: expected two NumPy arrays or two tensors, got {kinds}")
        photo, depth_lr = _photo(rgb), _tensor(depth)
        if depth_lr.dim() == 2:
            depth_lr = depth_lr[None]
        if mask is not None:
            valid = _tensor(mask).bool()
            if valid.shape[-2:] != depth_lr.shape[-2:]:
                raise ValueError(
                    f"mask: expected the depth's shape {tuple(depth_lr.shape[-2:])}, got {tuple(valid.shape[-2:])}"
                )
            depth_lr = depth_lr.masked_fill(~valid, torch.nan) if depth_lr.is_floating_point() else depth_lr
        surface = self._run.upsample(photo, depth_lr, camera, progress)
        depth_hr, depth_error, angle_error = (
            cast("Array", each[0].cpu().numpy() if arrays and each is not None else each) for each in surface[:3]
        )
        return SurfaceArrays(depth_hr, depth_error, angle_error, surface.noise)


def upsample_with_errors(
    rgb: Array,
    depth: Array,
    camera: Camera,
    scale: int | None = None,
    *,
    method: str = DEFAULT,
    mask: Array | None = None,
    device: str = "auto",
    fill: Fill = "small",
    max_hole: float = WIDEST,
    progress: Steps | None = None,
    **settings: Any,
) -> SurfaceArrays[Array]:
    """Upsample a depth map as :func:`upsample` does, and return its expected errors, too; see there.

    They are the mean absolute errors of depth and normal that are to be expected at each pixel. ``facets`` says them;
    for other methods they are estimated, see :mod:`dsr.inference.plausibility`.
    """
    run = Upsampler(method, scale, device=device, fill=fill, max_hole=max_hole, **settings)
    return run(rgb, depth, camera, mask=mask, progress=progress)


def _tensor(values: np.ndarray | Tensor) -> Tensor:
    """Return an array as a tensor, also one that torch cannot share: flipped, read-only, or of another byte order."""
    if isinstance(values, np.ndarray):
        values = np.require(values, values.dtype.newbyteorder("="), ("C", "W"))
    return torch.as_tensor(values)


def _photo(rgb: np.ndarray | Tensor) -> Tensor:
    """Return a photo as (3, H, W) float32 in [0, 1]; an invalid one is left for :class:`AnyRatio` to reject."""
    photo = _tensor(rgb)
    if isinstance(rgb, np.ndarray):
        if rgb.ndim != 3 or rgb.shape[-1] != 3:
            raise ValueError(f"rgb: expected shape (H, W, 3), got {rgb.shape}")
        photo = photo.permute(2, 0, 1)
    if photo.dtype == torch.uint8:
        return photo.float().div_(255)
    return photo.float() if photo.is_floating_point() else photo

"""``dsr.upsample``: the same for NumPy arrays and for tensors."""

from __future__ import annotations

from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.inference.engine import upsample_depth
from dsr.inference.planning import AUTO
from dsr.utils.progress import Steps

Array = TypeVar("Array", np.ndarray, Tensor)


def upsample(
    rgb: Array,
    depth: Array,
    camera: Camera,
    scale: int | None = None,
    *,
    method: str = AUTO,
    mask: Array | None = None,
    device: str = "auto",
    keep_holes: bool = False,
    progress: Steps | None = None,
    **settings: Any,
) -> Array:
    """Return depth as fine as the photo.

    The depth map has to be registered to the photo: the same view and the same field of view, at any size up to the
    photo's, with holes or without. Weights come with the package.

    Args:
        rgb: the photo: a NumPy array (H, W, 3), 0..255 as uint8 or 0..1 as floats; or a tensor (3, H, W), the same.
        depth: distance to the image plane in metres, as floats, NaN in holes: (h, w), a tensor may be (1, h, w).
        camera: of the photo, ``dsr.Camera(width, height, fx, fy, cx, cy)``, all in the photo's pixels.
        scale: how much finer the result is, 4 or 8 for networks; None for what suits the sizes. Where the depth map has
            the photo's size already it is first averaged over so many pixels, 4 for None.
        method: ``auto`` for ``msg_v_noisy`` where the depth is noisy, else ``facets``; or any other of the methods that
            ``conf/method`` names, such as ``msg_v``, ``tgv``, ``guided_filter``, ``bicubic``, and ``dip_v``, which
            takes minutes.
        mask: where the depth is known, of the depth's shape; for maps that mark holes by a mask.
        device: ``auto`` for a GPU where there is one, else ``cpu``, ``cuda`` or ``cuda:1``.
        keep_holes: whether holes stay NaN; otherwise they are filled.
        progress: a function that is called with the number of parts done and their total.
        **settings: arguments of the method, by the names in its file in ``conf/method``, such as ``data_weight=30``.

    Returns:
        Depth in metres, float32: (H, W) for an array, (1, H, W) for a tensor.

    Raises:
        ValueError: a shape, value, method, setting or scale is not as above, or the method has no solution.

    Example:
        A sphere before a wall, as a coarse sensor sees it:

        >>> import numpy as np
        >>> import dsr
        >>> rows, columns = np.mgrid[0:64, 0:96]
        >>> inside = (rows - 32) ** 2 + (columns - 48) ** 2 < 20**2
        >>> photo = np.where(inside[..., None], [200, 120, 80], [60, 70, 90]).astype(np.uint8)
        >>> coarse = np.where(inside, 1.0, 2.0).reshape(16, 4, 24, 4).mean(axis=(1, 3))
        >>> coarse[3, 5] = np.nan  # a hole
        >>> camera = dsr.Camera(width=96, height=64, fx=80.0, fy=80.0, cx=47.5, cy=31.5)
        >>> fine = dsr.upsample(photo, coarse, camera, scale=4)
        >>> fine.shape, bool(np.isfinite(fine).all())
        ((64, 96), True)
        >>> float(fine[32, 48].round(1)), float(fine[2, 2].round(1))
        (1.0, 2.0)

    """
    arrays = isinstance(rgb, np.ndarray)
    if isinstance(depth, np.ndarray) != arrays:
        raise ValueError(
            f"rgb, depth: expected two NumPy arrays or two tensors, got {type(rgb).__name__} and {type(depth).__name__}"
        )
    photo, coarse = _photo(rgb), torch.as_tensor(depth)
    if coarse.dim() == 2:
        coarse = coarse[None]
    if mask is not None:
        known = torch.as_tensor(mask).bool()
        if known.shape[-2:] != coarse.shape[-2:]:
            raise ValueError(
                f"mask: expected the depth's shape {tuple(coarse.shape[-2:])}, got {tuple(known.shape[-2:])}"
            )
        coarse = coarse.masked_fill(~known, torch.nan) if coarse.is_floating_point() else coarse
    fine = upsample_depth(
        photo,
        coarse,
        camera,
        scale,
        method=method,
        settings=settings,
        device=device,
        keep_holes=keep_holes,
        progress=progress,
    )
    return cast("Array", fine[0].cpu().numpy() if arrays else fine)


def _photo(rgb: np.ndarray | Tensor) -> Tensor:
    """Return a photo as (3, H, W) float32 in [0, 1]; what is no photo is left to be refused."""
    photo = torch.as_tensor(rgb)
    if isinstance(rgb, np.ndarray):
        if rgb.ndim != 3 or rgb.shape[-1] != 3:
            raise ValueError(f"rgb: expected shape (H, W, 3), got {rgb.shape}")
        photo = photo.permute(2, 0, 1)
    if photo.dtype == torch.uint8:
        return photo.float().div_(255)
    return photo.float() if photo.is_floating_point() else photo

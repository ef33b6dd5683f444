"""Upsampling of one photo's depth: low-resolution map in, high-resolution map out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.downsampling import Downsampling
from dsr.geometry.camera import Camera
from dsr.inference.inspection import CLEAN, enlarged_by, suited_method
from dsr.inference.planning import AUTO, OWN_SIZE, USUAL_SCALE, Plan, plan, read_ability
from dsr.inference.resampling import resize_inverse_depth
from dsr.methods.base import Upsampler
from dsr.methods.classical.interpolation import Interpolation
from dsr.methods.networks.base import NetworkUpsampler
from dsr.methods.networks.inpainting import inpaint
from dsr.methods.registry import build_method, read_method
from dsr.sample import DepthSample
from dsr.utils.builder import ConfigError
from dsr.utils.devices import pick_device
from dsr.utils.progress import Steps, part_of

DECIDED = MappingProxyType({"fill_holes": True, "validate_every": 0})
"""Arguments of methods that are set here: holes are restored afterwards, and validation has no ground truth."""


@dataclass(frozen=True)
class MethodChoice:
    """A method to run, by its name in the registry.

    Args:
        name: the method's name.
        settings: its arguments that differ from its file, by name.
        directories: the user's configuration directories.
        device: where to compute.

    """

    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    directories: tuple[Path, ...] = ()
    device: torch.device = field(default=torch.device("cpu"))

    def build(self, scale: int) -> Upsampler:
        """Build the method for a factor.

        Raises:
            ValueError: there is no such method or setting, or the method rejects a value.

        """
        node = read_method(self.name, scale, self.settings, self.directories)
        node = {key: value for key, value in node.items() if key not in DECIDED or key in self.settings}
        given: dict[str, Any] = {
            "device": self.device,
            "precision": "float32",
            "downsampling": Downsampling("box"),
            **DECIDED,
        }
        try:
            return build_method(node, scale, directories=self.directories, **given)
        except ConfigError as error:
            raise ValueError(str(error).removeprefix("method.")) from error

    def plan(self, size: tuple[int, int], size_lr: tuple[int, int], scale: int | None) -> Plan:
        """Return the plan for a photo and a depth map of these heights and widths."""
        return plan(size, size_lr, scale, self.name, self.directories, self.settings)


def check_settings(choice: MethodChoice) -> None:
    """Check that a method accepts the settings.

    Raises:
        ValueError: a setting is unknown, of another type, or the method rejects it; the message begins with its
            name and a colon.

    """
    choice = replace(choice, name=CLEAN if choice.name == AUTO else choice.name)
    choice.build(next(iter(read_ability(choice.name, choice.directories, choice.settings).steps), USUAL_SCALE))


def upsample_depth(
    rgb: Tensor,
    depth: Tensor,
    camera: Camera,
    scale: int | None = None,
    *,
    method: str = AUTO,
    settings: Mapping[str, Any] | None = None,
    directories: Sequence[Path] = (),
    device: str = "auto",
    keep_holes: bool = False,
    progress: Steps | None = None,
) -> Tensor:
    """Upsample a depth map to the photo's size.

    The depth map is registered to the photo: the same view and field of view, outer edge on outer edge. A
    low-resolution map is upsampled as :mod:`dsr.inference.planning` describes. A map of the photo's size is first
    downsampled by ``scale``, by averaging the inverse depth of its valid pixels; if it was enlarged by repeating
    pixels, the repeated ones are dropped instead. ``bilateral`` without a scale filters it as it is. The averages may
    cross depth steps, as in the networks' training.
    (With a tenth of the map missing, RMSE_v on Lucy is 0.127, against 0.142 or more with means, medians or planes of
    one surface.)

    Args:
        rgb: (3, H, W) floating point, in [0, 1].
        depth: (1, h, w) orthogonal depth in metres, NaN in holes.
        camera: the photo's; only interpolation and deep image priors depend on it.
        scale: see :func:`dsr.inference.plan`.
        method: the name of one in :mod:`dsr.methods.registry`, or ``auto``, see
            :func:`dsr.inference.inspection.suited_method`.
        settings: arguments of the method that differ from its file, by name.
        directories: the user's configuration directories.
        device: ``auto`` for a GPU if there is one, or a device as torch names it.
        keep_holes: whether pixels whose own depth, or whose nearest low-resolution pixel, is missing stay NaN;
            otherwise they are inpainted.
        progress: is called with the number of parts done and their total.

    Returns:
        (1, H, W) float32 in metres, on the device of ``depth``.

    Raises:
        ValueError: a shape, value, method, setting or scale is not as above, or the method has no solution.

    """
    _check(rgb, depth, camera)
    size = (camera.height, camera.width)
    method = suited_method(depth, camera, scale) if method == AUTO else method
    choice = MethodChoice(method, settings or {}, tuple(directories), pick_device(device))
    choice.plan(size, _size(depth), scale)  # raises ValueError for sizes or a scale that cannot be used
    inverse = depth.float().reciprocal()
    valid = inverse.isfinite()
    if size[0] <= OWN_SIZE * inverse.shape[-2] and size[1] <= OWN_SIZE * inverse.shape[-1]:
        inverse = _resize_nearest(inverse, size)
        block = enlarged_by(inverse)
        repeated = block > 1 and not any(n % block for n in size)
        factor = 1 if repeated else choice.plan(size, size, scale).coarsened
        if factor == 1:
            inverse = inverse[:, ::block, ::block] if repeated else inverse
            inverse_hr = _upsample_inverse(rgb, inverse, camera, None, choice, progress)
        else:
            padded = _pad_photo(rgb, factor)
            inverse_lr = Downsampling("box")(_pad_inverse(inverse, factor), factor)
            camera_padded = Camera(padded.shape[-1], padded.shape[-2], camera.fx, camera.fy, camera.cx, camera.cy)
            inverse_hr = _upsample_inverse(padded, inverse_lr, camera_padded, factor, choice, progress)
            inverse_hr = inverse_hr[:, : size[0], : size[1]]
    else:
        inverse_hr = _upsample_inverse(rgb, inverse, camera, scale, choice, progress)
    lowest = inverse.nan_to_num(nan=torch.inf).amin()
    inverse_hr = torch.where(inverse_hr > 0, inverse_hr, lowest.to(inverse_hr.device))  # 0 is infinitely far
    result = inverse_hr.reciprocal_()
    if keep_holes and not bool(valid.all()):
        result = result.masked_fill(~_resize_nearest(valid, size).to(result.device), torch.nan)
    return result.to(depth.device)


def _upsample_inverse(
    rgb: Tensor, inverse: Tensor, camera: Camera, scale: int | None, choice: MethodChoice, progress: Steps | None
) -> Tensor:
    """Return high-resolution inverse depth, (1, H, W), of low-resolution inverse depth, (1, h, w)."""
    size = (camera.height, camera.width)
    planned = choice.plan(size, _size(inverse), scale)
    methods = [choice.build(step) for step in planned.steps or (planned.scale,)]
    method = methods[0]
    if isinstance(method, Interpolation):
        camera_lr = camera.rescale(inverse.shape[-1], inverse.shape[-2])
        return method.interpolate(inverse.reciprocal(), camera_lr, camera).reciprocal()
    networks = [method for method in methods if isinstance(method, NetworkUpsampler)]
    if networks:
        return _run_networks(rgb, inverse, size, networks, choice.device, progress)
    if not planned.steps:
        return _run_at_ratio(rgb, inverse, camera, method, progress)
    return _run_method(rgb, inverse, camera, planned.steps[0], method, progress)


def _run_networks(
    rgb: Tensor,
    inverse: Tensor,
    size: tuple[int, int],
    networks: Sequence[NetworkUpsampler],
    device: torch.device,
    progress: Steps | None,
) -> Tensor:
    """Return the high-resolution inverse depth of networks applied in turn, each to the result of the one before."""
    steps = [each.net.scale for each in networks]
    sizes = [_size(inverse)]  # of the low-resolution map of each step
    sizes += [(-(-size[0] // step), -(-size[1] // step)) for step in steps[1:]]
    parts = [net.count_steps(step * s[0], step * s[1]) for net, step, s in zip(networks, steps, sizes, strict=True)]
    for i, (net, size_lr) in enumerate(zip(networks, sizes, strict=True)):
        inverse = resize_inverse_depth(inverse, size_lr, math.inf)
        report = part_of(progress, sum(parts[:i]), sum(parts))
        guide = resize_rgb(rgb, (net.net.scale * size_lr[0], net.net.scale * size_lr[1]))
        inverse = net.upsample_disparity(guide[None].to(device), inverse[None].to(device), report)[0]
        del guide
    return resize_inverse_depth(inverse, size)


def _run_method(
    rgb: Tensor, inverse: Tensor, camera: Camera, scale: int, method: Upsampler, progress: Steps | None
) -> Tensor:
    """Return the high-resolution inverse depth of a method, its missing pixels inpainted."""
    height, width = _size(inverse)
    camera_hr = camera.rescale(scale * width, scale * height)
    guide = resize_rgb(rgb, (camera_hr.height, camera_hr.width))
    camera_lr = camera.rescale(width, height)
    sample = DepthSample("upsample", "depth", guide, inverse.reciprocal(), camera_hr, camera_lr, scale)
    result = inpaint(method(sample, progress).reciprocal()[None])[0]
    return resize_inverse_depth(result, (camera.height, camera.width))


def _run_at_ratio(rgb: Tensor, inverse: Tensor, camera: Camera, method: Upsampler, progress: Steps | None) -> Tensor:
    """Return the high-resolution inverse depth of a method that takes any ratio of the sizes."""
    height, width = _size(inverse)
    camera_lr = camera.rescale(width, height)
    down, across = camera.height / height, camera.width / width
    ratio = down if across.is_integer() else across  # whole only if both are
    sample = DepthSample("upsample", "depth", rgb, inverse.reciprocal(), camera, camera_lr, ratio)
    return inpaint(method(sample, progress).reciprocal()[None])[0]


def resize_rgb(rgb: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize a photo, (3, H, W), with antialiasing."""
    if _size(rgb) == size:
        return rgb
    return functional.interpolate(rgb[None], size, mode="bicubic", antialias=True)[0].clamp_(0, 1)


def _resize_nearest(values: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize (1, h, w) to another size by nearest neighbour."""
    if _size(values) == size:
        return values
    rows, columns = (
        ((torch.arange(new, device=values.device) + 0.5) * (old / new)).long().clamp(max=old - 1)
        for old, new in zip(_size(values), size, strict=True)
    )
    return values[:, rows][:, :, columns]


def _pad_photo(rgb: Tensor, factor: int) -> Tensor:
    """Pad a photo at the right and the bottom to a multiple of the factor, by repeating its border pixels."""
    padding = [-n % factor for n in (rgb.shape[-1], rgb.shape[-2])]
    return functional.pad(rgb[None], (0, padding[0], 0, padding[1]), mode="replicate")[0] if any(padding) else rgb


def _pad_inverse(inverse: Tensor, factor: int) -> Tensor:
    """Pad inverse depth, (1, H, W), by linear extrapolation, so that averages of a slanted plane stay on the plane."""
    for dim in (-2, -1):
        more, size = -inverse.shape[dim] % factor, inverse.shape[dim]
        if not more:
            continue
        last = inverse.narrow(dim, size - 1, 1)
        slope = (last - inverse.narrow(dim, max(size - 1 - factor, 0), 1)) / min(factor, max(size - 1, 1))
        slope = torch.where(slope.abs() * factor <= 0.1 * last, slope, 0)  # a depth step or a hole, not a plane
        steps = torch.arange(1, more + 1, dtype=inverse.dtype, device=inverse.device)
        further = last + slope * (steps[:, None] if dim == -2 else steps)
        inverse = torch.cat((inverse, further), dim)
    return inverse


def _size(values: Tensor) -> tuple[int, int]:
    """Return height and width."""
    return values.shape[-2], values.shape[-1]


def _check(rgb: Tensor, depth: Tensor, camera: Camera) -> None:
    """Raise ValueError unless the photo, the depth map and the camera are valid and fit together."""
    size = (camera.height, camera.width)
    if tuple(rgb.shape) != (3, *size):
        raise ValueError(f"rgb: expected shape (3, {size[0]}, {size[1]}), the camera's, got {tuple(rgb.shape)}")
    if not rgb.is_floating_point() or not 0 <= float(rgb.min()) <= float(rgb.max()) <= 1:
        raise ValueError(f"rgb: expected floating point values in [0, 1], got {rgb.dtype} with others")
    if depth.dim() != 3 or depth.shape[0] != 1 or not depth.is_floating_point() or not depth.numel():
        raise ValueError(f"depth: expected floating point of shape (1, h, w), got {depth.dtype} {tuple(depth.shape)}")
    wrong = depth[(depth <= 0) | depth.isinf()]
    if wrong.numel():
        raise ValueError(
            f"depth: expected metres above 0, and NaN (float('nan')) to mark holes, got {float(wrong[0]):g} "
            f"in {wrong.numel()} of {depth.numel()} pixels"
        )
    if not bool(depth.isfinite().any()):
        raise ValueError("depth: expected at least one known pixel, all are holes")

"""Upsampling of one photo's depth: low-resolution map in, high-resolution map out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, get_args

import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.downsampling import Downsampling
from dsr.degradation.sensors import Identified, identify
from dsr.geometry.camera import Camera
from dsr.geometry.holes import degrees_per_pixel, wide_holes
from dsr.geometry.resampling import pad_inverse_depth, resize_inverse_depth
from dsr.inference.agreement import expect_errors
from dsr.inference.inspection import enlarged_by
from dsr.inference.options import DEFAULT, SIZES, USUAL_SCALE, WIDEST, Fill
from dsr.inference.outliers import count_patches, find_outliers, within_measured
from dsr.inference.planning import OWN_SIZE, Plan, plan, read_ability
from dsr.inference.working_size import find_noise, left_of, limit_to_noise, reduce_by_medians, working_size_of
from dsr.methods.base import Confident, MapNoise, Surface, Upsampler, expect_some_depth
from dsr.methods.classical.interpolation import Interpolation
from dsr.methods.networks.base import NetworkUpsampler
from dsr.methods.networks.inpainting import inpaint
from dsr.methods.registry import build_method, read_method
from dsr.sample import DepthSample, expect_distances
from dsr.utils.builder import ConfigError, trait
from dsr.utils.devices import fast_precision, pick_device
from dsr.utils.progress import Steps, part_of

DECIDED = MappingProxyType({"fill_holes": True, "validate_every": 0})
"""Arguments of methods that are set here: holes are restored afterwards, and validation has no ground truth."""


_LARGEST_RATIO = 16
"""Largest ratio of the sizes that a smaller working size may lead to: there are no weights for larger ones."""


_NOISY = 0.4
"""Standard deviation of a sensor's disparity in its steps, at least; rounding alone has 0.29."""
_CORRELATED = 5.0
"""Pixels over which noise is correlated that a network takes for shape in part."""


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
            "precision": fast_precision(self.device) if trait("method", node, "tolerant") else "float32",
            "downsampling": Downsampling("box"),
            **DECIDED,
        }
        try:
            return build_method(node, scale, directories=self.directories, **given)
        except ConfigError as error:
            text = str(error).removeprefix("method.")
            set_here = text.partition(":")[0] in self.settings
            raise ValueError(text if set_here else f"method={self.name}: {text}") from error

    def finds_noise(self) -> bool:
        """Return whether the method may work at a size that the map's noise suggests.

        It has to have weights for several ratios of the sizes, and not to be told that there is no noise.
        """
        told = self.settings.get("clean") or self.settings.get("noise") == 0
        return not told and bool(read_ability(self.name, self.directories, self.settings).factors)

    def plan(self, size: tuple[int, int], size_lr: tuple[int, int], scale: int | None) -> Plan:
        """Return the plan for a photo and a depth map of these heights and widths."""
        return plan(size, size_lr, scale, self.name, self.directories, self.settings)


def check_settings(choice: MethodChoice) -> None:
    """Check that a method accepts the settings.

    Raises:
        ValueError: a setting is unknown, of another type, or the method rejects it: the message begins with its
            name and a colon; or the method's own file has such a value: it begins with ``method=NAME:``.

    """
    ability = read_ability(choice.name, choice.directories, choice.settings)
    choice.build(next(iter(ability.single_steps), USUAL_SCALE))


def check_working_size(choice: MethodChoice, scale: int | None, size: int | None) -> None:
    """Check that a working size other than the map's own, 1 or None, has an effect.

    Raises:
        ValueError: it has none with this method and scale.

    """
    if size not in (None, 1) and not (scale is None and choice.finds_noise()):
        raise ValueError(f"working_size: expected facets without a scale, for maps that may have noise, to take {size}")


def find_sensor(depth: Tensor, name: str = "auto", device_name: str = "") -> Identified | None:
    """Return the sensor of a map, see :func:`dsr.degradation.sensors.identify`.

    Its values alone tell it only where the map has a sensor's noise: computed disparity may have the same steps.

    Args:
        depth: (1, h, w) in metres, NaN in holes, as it was read.
        name: of a sensor or a device; ``auto``, or ``none`` for none.
        device_name: of the device, as its files state it; empty where they do not.

    Raises:
        ValueError: there is no such sensor, or the map's values keep to steps that it does not have.

    """
    found = identify(depth, name, device_name)
    if found is None or found.by != "values" or found.constant is None:
        return found
    noise = find_noise(depth)
    steps = 0.0 if noise is None else found.constant * noise.deviation / noise.distance**2
    return found if steps >= _NOISY else None


def upsample_depth(
    rgb: Tensor,
    depth: Tensor,
    camera: Camera,
    scale: int | None = None,
    *,
    method: str = DEFAULT,
    settings: Mapping[str, Any] | None = None,
    directories: Sequence[Path] = (),
    device: str = "auto",
    fill: Fill = "small",
    max_hole: float = WIDEST,
    working_size: int | None = None,
    sensor: Identified | str | None = "auto",
    progress: Steps | None = None,
) -> Tensor:
    """Upsample a depth map to the photo's size: the depth of :func:`upsample_surface`, (1, H, W) float32 in metres."""
    return upsample_surface(
        rgb,
        depth,
        camera,
        scale,
        method=method,
        settings=settings,
        directories=directories,
        device=device,
        fill=fill,
        max_hole=max_hole,
        working_size=working_size,
        sensor=sensor,
        progress=progress,
    ).depth


def upsample_surface(
    rgb: Tensor,
    depth: Tensor,
    camera: Camera,
    scale: int | None = None,
    *,
    method: str = DEFAULT,
    settings: Mapping[str, Any] | None = None,
    directories: Sequence[Path] = (),
    device: str = "auto",
    fill: Fill = "small",
    max_hole: float = WIDEST,
    working_size: int | None = None,
    sensor: Identified | str | None = "auto",
    progress: Steps | None = None,
) -> Surface:
    """Upsample a depth map to the photo's size, with the expected errors.

    ``facets`` says them; for other methods they are estimated, see :mod:`dsr.inference.agreement`.

    The depth map is registered to the photo: the same view and field of view, outer edge on outer edge. A
    low-resolution map is upsampled as :mod:`dsr.inference.planning` describes. ``facets`` and ``bilateral`` take a map
    of the photo's size as it is, unless a scale is given; for other methods it is first downsampled by ``scale``, by
    averaging the inverse depth of its valid pixels; if it was enlarged by repeating pixels, the repeated ones are
    dropped instead. The averages may cross depth steps, as in the networks' training.
    Patches that are far from everything around them are taken for holes, and the result stays within what is measured
    around each pixel, see :mod:`dsr.inference.outliers`.
    (With a tenth of the map missing, RMSE_v on Lucy is 0.127, against 0.142 or more with means, medians or planes of
    one surface.)

    Args:
        rgb: (3, H, W) floating point, in [0, 1].
        depth: (1, h, w) orthogonal depth in metres, NaN in holes.
        camera: the photo's; only interpolation and deep image priors depend on it.
        scale: see :func:`dsr.inference.plan`.
        method: the name of one in :mod:`dsr.methods.registry`.
        settings: arguments of the method that differ from its file, by name.
        directories: the user's configuration directories.
        device: ``auto`` for a GPU if there is one, or a device as torch names it.
        fill: which holes are filled: ``all``, the ``small`` ones, or ``none``; in others, pixels whose own depth, or
            whose nearest low-resolution pixel, is missing stay NaN.
        max_hole: width of the widest hole that counts as small, in degrees of view; one of 5 pixels always does.
        working_size: by what ``facets`` without a scale divides the size of the map first, 1, 2, 4, 8 or 16; None to
            choose it by the map's noise, see :mod:`dsr.inference.working_size`.
        sensor: what measured the map: of :func:`find_sensor`, or its argument; None for none. No expected error is
            less than what remains of the least noise that the sensor is known to have. Where it counts disparity, and
            the noise of the map is correlated over 5 pixels or more, ``facets`` without a scale is told how strong the
            noise is and that it grows with the square of the distance, unless ``noise`` is set.
        progress: is called with the number of parts done and their total.

    Returns:
        Depth, (1, H, W) float32 in metres, and its expected errors, on the device of ``depth``; and its outliers.

    Raises:
        ValueError: a shape, value, method, setting or scale is not as above, the method has no solution, or the map's
            values contradict the named sensor.

    """
    _check(rgb, depth, camera)
    _check_options(fill, max_hole, working_size)
    size = (camera.height, camera.width)
    choice = MethodChoice(method, settings or {}, tuple(directories), pick_device(device))
    planned = choice.plan(size, _size(depth), scale)  # raises ValueError for sizes or a scale that cannot be used
    check_working_size(choice, scale, working_size)
    sensor = find_sensor(depth, sensor) if isinstance(sensor, str) else sensor
    outliers = find_outliers(depth)
    inverse = depth.masked_fill(outliers, torch.nan).float().reciprocal()
    valid, factor = inverse.isfinite(), 1
    near = size[0] <= OWN_SIZE * inverse.shape[-2] and size[1] <= OWN_SIZE * inverse.shape[-1]
    larger = any(n > m for n, m in zip(_size(inverse), size, strict=True))
    own = near and (_size(inverse) == size or larger or planned.coarsened > 1)
    if own:
        inverse = _resize_nearest(inverse, size)
        block = enlarged_by(inverse)
        repeated = block > 1 and not any(n % block for n in size)
        factor = 1 if repeated else choice.plan(size, size, scale).coarsened
        if repeated:
            inverse = inverse[:, ::block, ::block]
            valid = inverse.isfinite()
    if factor > 1:
        inverse_lr = Downsampling("box")(pad_inverse_depth(inverse, factor), factor)
        found = _upsample_padded(rgb, inverse_lr, camera, factor, choice, progress, factor)
    elif scale is None and choice.finds_noise():
        found = _upsample_at_working_size(rgb, inverse, camera, working_size, choice, sensor, progress)
    else:
        found = _upsample_inverse(rgb, inverse, camera, None if own else scale, choice, progress)
    expect_some_depth(found.inverse, method)  # as good as of the depth: 0 and infinity change places
    lowest = inverse.nan_to_num(nan=torch.inf).amin()
    infinite = found.inverse <= 0  # but what is NaN has no depth
    inverse_hr = torch.where(infinite, lowest.to(found.inverse.device), found.inverse)
    inverse_hr = within_measured(inverse_hr, inverse)
    if found.left_out is not None:
        inverse_hr = inverse_hr.masked_fill(found.left_out, torch.nan)
    spread, angle = found.spread, found.angle
    if spread is None or angle is None:
        spread, angle = expect_errors(inverse_hr, inverse.to(inverse_hr.device), camera)
    if sensor is not None:
        spread = torch.fmax(spread, left_of(sensor.least_error(inverse_hr.reciprocal()) * inverse_hr))
    result = inverse_hr.reciprocal_()
    surface = Surface(result, spread * result, angle, found.noise, count_patches(outliers))
    if fill != "all" and not bool(valid.all()):
        focal = camera.fx * valid.shape[-1] / camera.width
        left = ~valid if fill == "none" else wide_holes(valid, max_hole / degrees_per_pixel(focal))
        holes = _resize_nearest(left, size).to(result.device)
        surface = surface.map(lambda values: values.masked_fill(holes, torch.nan))
    return surface.map(lambda values: values.to(depth.device))


class _Found(NamedTuple):
    """High-resolution inverse depth, (1, H, W), its expected relative error, the normal's in degrees, and the noise.

    ``left_out`` (1, H, W) marks pixels that the method leaves as holes.
    """

    inverse: Tensor
    spread: Tensor | None = None
    angle: Tensor | None = None
    left_out: Tensor | None = None
    noise: MapNoise | None = None

    def crop(self, size: tuple[int, int]) -> _Found:
        """Return the upper left window of a size."""
        window = (..., slice(size[0]), slice(size[1]))
        inverse, spread, angle, left_out = (None if each is None else each[window] for each in self[:4])
        assert inverse is not None  # noqa: S101 - for the type checker
        return _Found(inverse, spread, angle, left_out, self.noise)


def _upsample_at_working_size(
    rgb: Tensor, inverse: Tensor, camera: Camera, size: int | None, choice: MethodChoice, sensor: Identified | None,
    progress: Steps | None,
) -> _Found:  # fmt: skip
    """Return high-resolution inverse depth of inverse depth, (1, h, w), whose size may be divided first."""
    most = max(each for each in SIZES if each == 1 or each <= _LARGEST_RATIO * inverse.shape[-1] / camera.width)
    if size is not None and size > most:
        raise ValueError(f"working_size: expected at most {most} for this map's size and the photo's, got {size}")
    noise = find_noise(inverse.reciprocal())
    factor = size or min(1 if noise is None else working_size_of(noise.extent), most)
    choice = _tell_noise(choice, sensor, noise, factor)
    if factor == 1:
        return _upsample_inverse(rgb, inverse, camera, None, choice, progress)
    inverse_lr = reduce_by_medians(pad_inverse_depth(inverse, factor), factor)
    found = _upsample_padded(rgb, inverse_lr, camera, None, choice, progress, factor * camera.width / inverse.shape[-1])
    if noise is None or found.spread is None:  # what the network has found is of the smaller map
        return found._replace(noise=None)
    left = limit_to_noise(found.spread, noise, float(inverse.nanmedian()))
    return found._replace(spread=left, noise=noise._replace(reduced=factor))


def _tell_noise(choice: MethodChoice, sensor: Identified | None, noise: MapNoise | None, factor: int) -> MethodChoice:
    """Return a choice whose method is told a map's noise where it may take it for shape.

    That is correlated noise of a sensor that counts disparity; the method judges other noise better by itself.

    Args:
        choice: the method.
        sensor: what measured the map, if that is known.
        noise: what was found of it.
        factor: by what the size of the map is divided.

    """
    counts = sensor is not None and sensor.sensor.stereo_constant is not None
    if not counts or noise is None or noise.extent < max(_CORRELATED, factor) or "noise" in choice.settings:
        return choice
    told = {"noise": noise.deviation / noise.distance**2, "noise_growth": 2.0}
    return replace(choice, settings={**choice.settings, **told})


def _upsample_padded(
    rgb: Tensor, inverse: Tensor, camera: Camera, scale: int | None, choice: MethodChoice, progress: Steps | None,
    ratio: float,
) -> _Found:  # fmt: skip
    """Return what :func:`_upsample_inverse` returns for the photo, padded to ``ratio`` times the map, cropped again."""
    height, width = (max(round(ratio * n), m) for n, m in zip(_size(inverse), _size(rgb), strict=True))
    padded = _pad_photo(rgb, (height, width))
    camera_padded = Camera(width, height, camera.fx, camera.fy, camera.cx, camera.cy)
    found = _upsample_inverse(padded, inverse, camera_padded, scale, choice, progress)
    return found.crop((camera.height, camera.width))


def _upsample_inverse(
    rgb: Tensor, inverse: Tensor, camera: Camera, scale: int | None, choice: MethodChoice, progress: Steps | None
) -> _Found:
    """Return high-resolution inverse depth of low-resolution inverse depth, (1, h, w)."""
    size = (camera.height, camera.width)
    planned = choice.plan(size, _size(inverse), scale)
    methods = [choice.build(step) for step in planned.steps or (planned.scale,)]
    method = methods[0]
    if isinstance(method, Interpolation):
        camera_lr = camera.rescale(inverse.shape[-1], inverse.shape[-2])
        return _Found(method.interpolate(inverse.reciprocal(), camera_lr, camera).reciprocal())
    networks = [method for method in methods if isinstance(method, NetworkUpsampler)]
    if networks:
        return _Found(_run_networks(rgb, inverse, size, networks, choice.device, progress))
    if not planned.steps:
        return _run_at_ratio(rgb, inverse, camera, method, progress)
    return _Found(_run_method(rgb, inverse, camera, planned.steps[0], method, progress))


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


def _run_at_ratio(rgb: Tensor, inverse: Tensor, camera: Camera, method: Upsampler, progress: Steps | None) -> _Found:
    """Return the high-resolution inverse depth of a method that takes any ratio of the sizes."""
    height, width = _size(inverse)
    camera_lr = camera.rescale(width, height)
    down, across = camera.height / height, camera.width / width
    ratio = down if across.is_integer() else across  # whole only if both are
    sample = DepthSample("upsample", "depth", rgb, inverse.reciprocal(), camera, camera_lr, ratio)
    if not isinstance(method, Confident):
        return _Found(inpaint(method(sample, progress).reciprocal()[None])[0])
    surface = method.surface(sample, progress)
    if surface.depth_error is None:
        return _Found(surface.depth.reciprocal(), None, surface.angle_error, None, surface.noise)
    left_out = surface.depth.isnan() & surface.depth_error.isfinite()
    spread = surface.depth_error / surface.depth
    return _Found(surface.depth.reciprocal(), spread, surface.angle_error, left_out, surface.noise)


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


def _pad_photo(rgb: Tensor, size: tuple[int, int]) -> Tensor:
    """Pad a photo at the right and the bottom to a size, by repeating its border pixels."""
    padding = (0, size[1] - rgb.shape[-1], 0, size[0] - rgb.shape[-2])
    return functional.pad(rgb[None], padding, mode="replicate")[0] if any(padding) else rgb


def _size(values: Tensor) -> tuple[int, int]:
    """Return height and width."""
    return values.shape[-2], values.shape[-1]


def _check_options(fill: str, max_hole: float, working_size: int | None) -> None:
    """Raise ValueError for a value that :func:`upsample_surface` does not know."""
    if fill not in get_args(Fill):
        raise ValueError(f"fill: expected one of {', '.join(get_args(Fill))}, got {fill!r}")
    if not 0 < max_hole < math.inf:
        raise ValueError(f"max_hole: expected a positive number of degrees, got {max_hole}")
    if working_size is not None and working_size not in SIZES:
        raise ValueError(f"working_size: expected one of {', '.join(map(str, SIZES))}, got {working_size}")


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
    expect_distances("depth", depth)
    if not bool(depth.isfinite().any()):
        raise ValueError("depth: expected at least one known pixel, all are holes")

"""Upsampling of one photo's depth: low-resolution map in, high-resolution map out."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args

import torch
from torch import Tensor

from dsr.degradation.downsampling import Downsampling
from dsr.degradation.sensors import Identified
from dsr.geometry.camera import Camera
from dsr.geometry.hole_size import degrees_per_pixel, wide_holes
from dsr.geometry.resampling import pad_inverse_depth
from dsr.inference import DEFAULT, WIDEST, Fill
from dsr.inference.plausibility import count_patches, expect_errors, find_outliers, within_measured
from dsr.inference.residual import restore_measured
from dsr.inference.resizing import (
    OWN_SIZE,
    USUAL_SCALE,
    Plan,
    at_factors,
    at_ratio,
    cropped,
    padded,
    plan_for,
    resize_nearest,
    size_of,
    steps_of,
)
from dsr.inference.rims import Settled, settle_holes
from dsr.inference.working_size import (
    CORRELATED,
    SIZES,
    enlarged_by,
    find_noise,
    find_sensor,
    known_noise,
    left_of,
    limit_to_noise,
    mix_where_calm,
    reduce_by_medians,
    working_size_of,
)
from dsr.methods.base import InverseSurface, MapNoise, Method, NoiseLaw, Surface, expect_some_depth
from dsr.methods.glass import NOTED, expect_glass
from dsr.methods.networks.weight_files import has_weights
from dsr.methods.recipe import Recipe, Run, read_recipe
from dsr.sample import DepthSample, expect_distances
from dsr.utils.compute_device import fast_precision, pick_device
from dsr.utils.configuration import ConfigError
from dsr.utils.guards import expect_one_of
from dsr.utils.progress import Steps

# arguments of methods that are set here: holes are restored afterwards, and validation has no ground truth
_DECIDED = MappingProxyType({"fill_holes": True, "validate_every": 0})
_LARGEST_RATIO = 16  # that a smaller working size may lead to: there are no weights for larger ones


class AnyRatio(Method):
    """A method of any factors as one of any ratio, whose maps may have the photo's size, holes and errors.

    The method is built once for each factor, so that many maps load its weights once. A low-resolution map is
    upsampled as :mod:`dsr.inference.resizing` describes. Methods that take a map of the photo's size take it as it is,
    unless a scale is given; for other methods it is first downsampled by ``scale``, by averaging the inverse depth of
    its valid pixels, even across depth steps, as in the networks' training; if it was enlarged by repeating pixels, the
    repeated ones are dropped instead. (With a tenth of the map missing, RMSE_v on Lucy is 0.127, against 0.142 or more
    with means, medians or planes of one surface.)

    For the options see :class:`dsr.Upsampler`; holes are pixels whose own depth, or whose nearest low-resolution pixel,
    is missing. ``precision`` is the dtype of the convolutions; None for the device's fast one where that costs no
    accuracy.
    """

    def __init__(
        self,
        recipe: Recipe,
        device: torch.device,
        scale: int | None = None,
        fill: Fill = "all",
        max_hole: float = WIDEST,
        working_size: int | None = None,
        *,
        precision: str | None = None,
        seed: int = 0,
    ) -> None:
        expect_one_of("fill", fill, get_args(Fill))
        if not 0 < max_hole < math.inf:
            raise ValueError(f"max_hole: expected a positive number of degrees, got {max_hole}")
        if working_size is not None and working_size not in SIZES:
            raise ValueError(f"working_size: expected one of {', '.join(map(str, SIZES))}, got {working_size}")
        self.recipe, self._scale, self._fill = recipe, scale, fill
        self._max_hole, self._working_size = max_hole, working_size
        self._may_reduce = scale is None and finds_noise(recipe)  # whether the working size may be less than the map's
        precision = precision or (fast_precision(device) if recipe.abilities.tolerant else "float32")
        self._run = Run(device=device, precision=precision, seed=seed, downsampling=Downsampling("box"))
        self._methods: dict[int, Method] = {}

    @property
    def flag(self) -> str:
        """Mark for scores of a method that used the truth, else empty."""
        return self.first().flag

    def first(self) -> Method:
        """Return the method for its smallest factor, which checks the settings."""
        factors = [step for steps in steps_of(self.recipe).values() for step in steps]
        return self._method(min(factors, default=USUAL_SCALE))

    def check_working_size(self) -> None:
        """Check that a working size other than the map's own has an effect with this method and scale."""
        size = self._working_size
        if size not in (None, 1) and not self._may_reduce:
            raise ValueError(f"working_size: expected facets without a scale, for maps that may have noise, got {size}")

    def plan(self, size: tuple[int, int], size_lr: tuple[int, int]) -> Plan:
        """Return the plan for a photo and a depth map of these heights and widths."""
        return plan_for(self.recipe, size, size_lr, self._scale)

    def describe(self, sample: DepthSample) -> str:
        """Return in one line how the method is run, for a note beside the scores; nothing if it takes the map as is."""
        planned = self.plan(size_of(sample.rgb), size_of(sample.depth_lr))
        if not self._may_reduce:
            return planned.way
        inverse, _, _ = self._at_own_size(_invert(sample.depth_lr)[0], size_of(sample.rgb), planned)
        _, factor = self._choose_size(inverse, sample.camera)
        return f"{planned.way}, worked on at 1/{factor}" if factor > 1 else ""

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution depth, (1, H, W) in metres, NaN where missing."""
        return self.surface(sample, progress).depth

    def surface(self, sample: DepthSample, progress: Steps | None = None) -> Surface:
        """Return the high-resolution depth in the dtype of the sample's, with the method's own errors."""
        surface = self.upsample(sample.rgb, sample.depth_lr, sample.camera, progress, estimate_errors=False)
        return surface._replace(depth=surface.depth.to(sample.depth_lr))

    def upsample(
        self,
        rgb: Tensor,
        depth: Tensor,
        camera: Camera,
        progress: Steps | None = None,
        sensor: Identified | str | None = "auto",
        *,
        estimate_errors: bool = True,
    ) -> Surface:
        """Upsample a depth map, (1, h, w) in metres with NaN in holes, to the size of a photo, (3, H, W) in [0, 1].

        Both are registered: the same view and field of view, outer edge on outer edge; the camera is the photo's. The
        result has depth, (1, H, W) float32 in metres, its expected errors, which depth is filled in, all on the device
        of ``depth``, and the map's outliers. ``facets`` states the expected errors; for other methods they are
        estimated, see :mod:`dsr.inference.plausibility`, unless not ``estimate_errors``.

        ``sensor``: what measured the map: of :func:`~dsr.inference.find_sensor`, or its argument; None for none. No
        expected error is less than what remains of the sensor's least noise, and a systematic error of which its maker
        states a limit is added. If it counts disparity, see also :func:`~dsr.inference.working_size.known_noise`.
        """
        expect_picture(rgb, depth, camera)
        planned = self.plan(size_of(rgb), size_of(depth))  # raises ValueError for sizes or a scale that cannot be used
        self.check_working_size()
        sensor = find_sensor(depth, sensor) if isinstance(sensor, str) else sensor
        given, outliers = _invert(depth)
        inverse, factor, scale = self._at_own_size(given, size_of(rgb), planned)
        valid = (given if size_of(inverse) == size_of(rgb) else inverse).isfinite()  # but for repeated pixels
        settled = settle_holes(inverse, rgb, self._small_holes(inverse.isfinite(), camera))
        if factor > 1:
            inverse_lr = Downsampling("box")(pad_inverse_depth(settled.inverse, factor), factor)
            whole, view = padded(rgb, camera, factor, size_of(inverse_lr))
            found = cropped(self._upsample(whole, inverse_lr, view, factor, progress), camera)
        elif self._may_reduce:
            found = self._at_working_size(rgb, inverse, settled.inverse, camera, sensor, progress)
        else:
            found = self._upsample(rgb, settled.inverse, camera, scale, progress)
        expect_some_depth(found.inverse, self.recipe.name)  # as good as of the depth: 0 and infinity change places
        photo = None if is_told_clean(self.recipe) else rgb.to(found.inverse.device)
        surface = _in_depth(found, inverse, settled, photo, camera, sensor, estimate=estimate_errors)
        if self._fill != "all" and not bool(valid.all()):
            left = ~valid if self._fill == "none" else ~valid & ~self._small_holes(valid, camera)
            holes = resize_nearest(left, size_of(rgb)).to(surface.depth.device)
            surface = surface.map(lambda values: values.masked_fill(holes, torch.nan))
        missing = resize_nearest(~valid, size_of(rgb)).to(surface.depth.device)
        surface = surface._replace(outliers=count_patches(outliers), filled=missing & surface.depth.isfinite())
        return surface.map(lambda values: values.to(depth.device))

    def _at_own_size(self, inverse: Tensor, size: tuple[int, int], planned: Plan) -> tuple[Tensor, int, int | None]:
        """Return the map to work on, the factor by which it is to be averaged first, and the one to upsample it by.

        A map of about the photo's size gets that size, less pixels that were repeated.
        """
        size_lr = size_of(inverse)
        near = all(new <= OWN_SIZE * old for new, old in zip(size, size_lr, strict=True))
        larger = any(old > new for old, new in zip(size_lr, size, strict=True))
        if not (near and (size_lr == size or larger or planned.coarsened > 1)):
            return inverse, 1, self._scale
        inverse = resize_nearest(inverse, size)
        block = enlarged_by(inverse)
        if block > 1 and not any(n % block for n in size):
            return inverse[:, ::block, ::block], 1, None
        return inverse, self.plan(size, size).coarsened, None

    def _at_working_size(
        self, rgb: Tensor, measured: Tensor, inverse: Tensor, camera: Camera, sensor: Identified | None,
        progress: Steps | None,
    ) -> InverseSurface:  # fmt: skip
        """Return high-resolution inverse depth, at a size that the noise of the ``measured`` one suggests."""
        noise, factor = self._choose_size(measured, camera)
        known = None if "noise" in self.recipe.settings else known_noise(sensor, noise, factor)
        if factor == 1:
            found = self._upsample(rgb, inverse, camera, None, progress, known)
            set_here = self.recipe.at()
            told = known is not None or set_here.get("noise") is not None or set_here.get("smooth", 1) != 1
            if noise is not None and found.noise is not None and not told:
                found = found._replace(inverse=restore_measured(found.inverse, measured.to(found.inverse), found.noise))
        else:
            inverse_lr = reduce_by_medians(pad_inverse_depth(inverse, factor), factor)
            ratio = factor * camera.width / inverse.shape[-1]
            photo, view = padded(rgb, camera, ratio, size_of(inverse_lr))
            found = cropped(self._upsample(photo, inverse_lr, view, None, progress, known), camera)
            if ratio > USUAL_SCALE:  # weights for larger ratios leave more waves on calm surfaces
                smoother = at_ratio(self._method(USUAL_SCALE), photo, inverse_lr, view, None, known)
                found = mix_where_calm(found, cropped(smoother, camera), measured, reach=round(ratio / 4))
            # what the network has found is of the smaller map
            found = found._replace(noise=noise and noise._replace(reduced=factor))
        if noise is None or found.spread is None or (factor == 1 and noise.extent < CORRELATED):
            return found
        stereo = found.inverse if sensor is not None and sensor.sensor.kind == "stereo" else None
        return found._replace(spread=limit_to_noise(found.spread, noise, measured, stereo))

    def _choose_size(self, inverse: Tensor, camera: Camera) -> tuple[MapNoise | None, int]:
        """Return the noise of inverse depth, (1, h, w), and by what its size is to be divided."""
        most = max(each for each in SIZES if each == 1 or each <= _LARGEST_RATIO * inverse.shape[-1] / camera.width)
        size = self._working_size
        if size is not None and size > most:
            raise ValueError(f"working_size: expected at most {most} for this map's size and the photo's, got {size}")
        noise = find_noise(inverse.reciprocal())
        return noise, size or min(1 if noise is None else working_size_of(noise.extent), most)

    def _upsample(
        self, rgb: Tensor, inverse: Tensor, camera: Camera, scale: int | None, progress: Steps | None,
        noise: NoiseLaw | None = None,
    ) -> InverseSurface:  # fmt: skip
        """Return high-resolution inverse depth of low-resolution inverse depth, (1, h, w)."""
        planned = plan_for(self.recipe, size_of(rgb), size_of(inverse), scale)
        if not planned.steps:
            return at_ratio(self._method(planned.scale), rgb, inverse, camera, progress, noise)
        return at_factors([(step, self._method(step)) for step in planned.steps], rgb, inverse, camera, progress)

    def _method(self, factor: int) -> Method:
        if factor not in self._methods:
            try:
                self._methods[factor] = self.recipe.build(factor, self._run, **_DECIDED)
            except ConfigError as error:
                text = str(error).removeprefix("method.")
                set_here = text.partition(":")[0] in self.recipe.settings
                raise ValueError(text if set_here else f"method={self.recipe.name}: {text}") from error
        return self._methods[factor]

    def _small_holes(self, valid: Tensor, camera: Camera) -> Tensor:
        """Return the small holes of a map, (1, h, w), be they to be filled or not: what is beside depends on it."""
        focal = camera.fx * valid.shape[-1] / camera.width
        return ~valid & ~wide_holes(valid, self._max_hole / degrees_per_pixel(focal))


def finds_noise(recipe: Recipe) -> bool:
    """Return whether a method has weights for several ratios, of which the noise of a map may suggest one."""
    return bool(recipe.computed_at) and not is_told_clean(recipe)


def is_told_clean(recipe: Recipe) -> bool:
    """Return whether a method has a setting that its maps have no noise, so that no sensor measured them."""
    node = recipe.at()
    return bool(node.get("clean")) or node.get("noise") == 0


def upsampler(
    method: str = DEFAULT,
    scale: int | None = None,
    *,
    settings: Mapping[str, Any] | None = None,
    directories: Sequence[Path] = (),
    device: str = "auto",
    fill: Fill = "small",
    max_hole: float = WIDEST,
    working_size: int | None = None,
) -> AnyRatio:
    """Return a method of ``conf/method`` for depth maps of any size, which loads its weights once.

    ``settings`` are arguments of the method that differ from its file; for the others see :class:`dsr.Upsampler`.

    Example:
        >>> import torch
        >>> import dsr
        >>> from dsr.inference import upsampler
        >>> camera, run = dsr.Camera.from_fov(60, width=32, height=24), upsampler("bicubic")
        >>> run.upsample(torch.rand(3, 24, 32), torch.full((1, 10, 13), 2.0), camera).depth.shape  # tensors alone
        torch.Size([1, 24, 32])

    """
    recipe = read_recipe(method, settings, directories)
    return AnyRatio(recipe, pick_device(device, recipe.abilities.fast_on), scale, fill, max_hole, working_size)


def upsample_surface(
    rgb: Tensor,
    depth: Tensor,
    camera: Camera,
    scale: int | None = None,
    *,
    sensor: Identified | str | None = "auto",
    progress: Steps | None = None,
    **options: Any,
) -> Surface:
    """Upsample one depth map: :meth:`AnyRatio.upsample` with the options of :func:`upsampler`."""
    return upsampler(scale=scale, **options).upsample(rgb, depth, camera, progress, sensor)


@dataclass(frozen=True)
class Selection:
    """A method for one scale, as an evaluation runs it."""

    recipe: Recipe  # with its weights
    scale: float  # ratio of the photo's width to the depth map's
    direct: bool  # run at this scale itself; else as in ``dsr upsample``, which may resize photo and map

    def files(self) -> list[Path]:
        """Return the files of weights that it may use; a ConfigError if one is missing."""
        factors: set[float] = {self.scale}
        if not self.direct:
            steps = steps_of(self.recipe).values()
            factors = {step for each in steps for step in each} or set(self.recipe.computed_at)
        found = (self.recipe.weights(factor) for factor in sorted(factors))
        return list(dict.fromkeys(file for file in found if file is not None))

    def build(self, run: Run) -> Method:
        """Build the method; a ConfigError if it rejects a setting, or has no weights."""
        if self.direct:
            return self.recipe.build(self.scale, run)
        try:
            fill: Fill = "none" if self.recipe.at().get("fill_holes") is False else "all"
            method = AnyRatio(self.recipe, torch.device(run.device), fill=fill, precision=run.precision, seed=run.seed)
            method.first()
        except ConfigError:
            raise
        except ValueError as error:
            raise ConfigError(str(error.__cause__ or error)) from error  # with the key as the run names it
        return method


def select(recipe: Recipe, scale: float, weights: Path | None = None, *, measured: bool = False) -> Selection:
    """Select how an evaluation runs a method at a scale, the ratio of the photo's width to the depth map's.

    ``weights`` are a file of weights, or a directory with published ones; None for those that the method names. With
    ``measured`` maps, a sensor's own, a method that can choose its working size by the map's noise does so; of one
    without packaged weights for their ratio, those for another one are taken. Of a model of downsampling, the error
    says that it needs weights.
    """
    node = recipe.at().get("weights")  # with the scale as the run names it
    packaged = node.get("packaged") if isinstance(node, Mapping) else None
    lacking = weights is None and packaged is not None and not has_weights(node, scale)
    as_upsample = measured and (lacking or finds_noise(recipe))
    direct = recipe.abilities.takes(scale) and not as_upsample
    return Selection(recipe.with_weights(weights), scale, direct)


def _invert(depth: Tensor) -> tuple[Tensor, Tensor]:
    """Return the inverse of depth, (1, h, w), without the outliers; and where these are."""
    outliers = find_outliers(depth)
    return depth.masked_fill(outliers, torch.nan).float().reciprocal(), outliers


def _in_depth(
    found: InverseSurface, inverse: Tensor, settled: Settled, photo: Tensor | None, camera: Camera,
    sensor: Identified | None, *, estimate: bool,
) -> Surface:  # fmt: skip
    """Return a result as depth within what was measured and settled, with its errors or, on request, estimated ones.

    A sensor may have seen through glass of the photo, (3, H, W); None where there was no sensor.
    """
    lowest = inverse.nan_to_num(nan=torch.inf).amin()
    infinite = found.inverse <= 0  # but what is NaN has no depth
    inverse_hr = torch.where(infinite, lowest.to(found.inverse.device), found.inverse)
    inverse_hr = within_measured(inverse_hr, settled.inverse)
    spread, angle = found.spread, found.angle
    if (spread is None or angle is None) and not estimate:
        return Surface(inverse_hr.reciprocal_())
    if spread is None or angle is None:
        spread, angle = expect_errors(inverse_hr, inverse.to(inverse_hr.device), camera)
    if bool(settled.doubt.any()):
        spread = spread + resize_nearest(settled.doubt.to(spread), size_of(spread))
    glass = None if photo is None else expect_glass(photo, inverse)
    if glass is not None:
        spread = torch.fmax(spread, glass)
    if sensor is not None:
        depth = inverse_hr.reciprocal()
        spread = torch.fmax(spread, left_of(sensor.least_error(depth) * inverse_hr))
        offset = sensor.offset_error(depth)
        spread = spread if offset is None else torch.hypot(spread, offset * inverse_hr)
    result = inverse_hr.reciprocal_()
    share = None if glass is None else float((glass > NOTED).double().mean())
    return Surface(result, spread * result, angle, found.noise, glass=share)


def expect_picture(rgb: Tensor, depth: Tensor, camera: Camera) -> None:
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

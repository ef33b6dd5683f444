"""Random degradations of all kinds: what cameras, files and sensors do to depth, drawn for each training patch.

A degradation is drawn in three stages, each kind with its share:

- a *kernel*, also ``spread``, a wider gaussian, as of a sensor; before it, folds, fine relief, and clear, mirroring and
  glossy objects are added to the truth in some cases, and depth is displaced against the photo;
- *noise*, also of cameras, which lose pixels, too; some maps are rounded to the levels of a file;
- *holes*: blobs, shadows, bands beside depth steps, dark surfaces, single pixels.

All random numbers come from one generator. Maps are inverse depth, in which planes are linear, in 1/m.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from dsr.degradation.downsampling import KERNELS, Downsampling, Hints, encode_facts, local_noise
from dsr.degradation.glass import add_glass
from dsr.degradation.holes import HOLES, draw_holes
from dsr.degradation.noise import NOISES
from dsr.degradation.random_fields import chance, draw, field_of, integer, normal, power, uniform
from dsr.geometry.camera import Camera
from dsr.sample import CENTIMETRES, AllHolesError, DepthSample, Scene
from dsr.utils.guards import derived, unchecked

# Kinds of noise that stand for a sensor, which does not see glass; the others stand for maps made of a surface
SENSOR_NOISES = ("waves", "structured", "flight", "lidar", "stereo")
ROUNDED = 0.3  # share of the reliefs that are a file's levels
STEPS = (0.001, 0.001, 0.002, 0.005)  # metres between a file's levels
GRAIN = (-4.6, -3)  # range of the decadic logarithm of the grain's height over the inverse depth


@dataclass(frozen=True)
class Everything:
    """The distribution of random degradations."""

    scales: Mapping[Any, float] | None = None
    kernels: Mapping[str, float] = field(
        default_factory=lambda: {
            "box": 0.45, "nearest": 0.08, "bilinear": 0.08, "bicubic": 0.25, "gaussian": 0.08, "spread": 0.06
        }
    )  # fmt: skip
    noises: Mapping[str, float] = field(
        default_factory=lambda: {
            "none": 0.48, "white": 0.14, "correlated": 0.1, "waves": 0, "structured": 0.09, "flight": 0.08,
            "lidar": 0.05, "stereo": 0.06,
        }
    )  # fmt: skip
    holes: Mapping[str, float] = field(
        default_factory=lambda: {"none": 0.6, "blobs": 0.1, "shadows": 0.1, "steps": 0.08, "dark": 0.06, "pixels": 0.06}
    )
    folds: float = 0.25
    relief: float = 0.12
    displaced: float = 0.2
    rounded: float = 0.1
    soft: float = 0.3
    photo: float = 0.5
    textured: float = 0.08
    clear: float = 0
    told: float = 0.6

    def __post_init__(self) -> None:
        known = {"kernels": (*KERNELS, "spread"), "noises": ("none", *NOISES), "holes": ("none", *HOLES)}
        for name, kinds in known.items():
            shares = getattr(self, name)
            if wrong := [kind for kind in shares if kind not in kinds]:
                raise ValueError(f"{name}: expected some of {', '.join(kinds)}, got {wrong[0]}")
            if not all(share >= 0 for share in shares.values()) or not sum(shares.values()) > 0:
                raise ValueError(f"{name}: expected frequencies of 0 or more, one of them positive, got {dict(shares)}")
        for name in ("folds", "relief", "displaced", "rounded", "soft", "photo", "textured", "clear", "told"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: expected a fraction from 0 to 1, got {getattr(self, name)}")
        scales = {} if self.scales is None else self.scales
        if wrong := [scale for scale in scales if str(scale) not in ("1", "2", "4", "8", "16")]:
            raise ValueError(f"scales: expected some of 1, 2, 4, 8, 16, got {wrong[0]}")

    def draw_scale(self, scale: int, generator: torch.Generator) -> int:
        """Return a random factor; ``scale`` where there is no choice."""
        if self.scales is None:
            return scale
        return int(draw({str(scale): share for scale, share in self.scales.items()}, generator))

    def __call__(
        self, scene: Scene, scale: int, generator: torch.Generator, *, soft: bool = False
    ) -> tuple[DepthSample, Hints]:
        """Return a scene with a low-resolution map, and hints; at factor 1 it has noise, if any kind is to be drawn."""
        if chance(self.folds, generator):
            scene = add_folds(scene, generator)
        if scale > 1 and chance(self.relief, generator):
            scene = add_relief(scene, generator)
        kernel = draw(self.kernels, generator) if scale > 1 else "nearest"
        kind = draw(self.noises, generator)
        others = {name: share for name, share in self.noises.items() if name != "none"}
        if scale == 1 and kind == "none" and sum(others.values()) > 0:
            kind = draw(others, generator)
        seen = scene.true_depth
        if self.clear and kind in SENSOR_NOISES and not soft and chance(self.clear, generator):
            scene, seen = add_glass(scene, generator)
        clean, camera_lr = self._downsample(seen, scene.camera, scale, kernel, kind, generator)
        size = clean.shape[-2], clean.shape[-1]
        luma = functional.adaptive_avg_pool2d(scene.rgb.float().mean(dim=0, keepdim=True)[None], size)[0]
        noisy = clean if kind == "none" else NOISES[kind](clean, luma, generator)
        noisy = torch.where(clean.isfinite(), noisy, torch.nan)  # what is not known, or seen, stays unknown
        if chance(self.rounded, generator):
            noisy = round_values(noisy, generator)
        holes = draw(self.holes, generator)
        if holes != "none":
            noisy = noisy.masked_fill(draw_holes(holes, noisy, luma, camera_lr, generator), torch.nan)
        noisy = torch.where(noisy > 0, noisy, torch.nan)
        if not bool(noisy.isfinite().any()):
            raise AllHolesError(scene.name)
        rgb = scene.rgb.float()
        if chance(self.textured, generator):  # values may exceed 1
            pattern = field_of(rgb[:1], power(0, 1.2, generator), generator)
            colour = 0.2 * torch.randn((3, 1, 1), generator=generator) + uniform(0.1, 0.5, generator)
            rgb = rgb * (1 + colour * pattern.clamp(-2, 2)).clamp(min=0)
        if chance(self.photo / (1 + (kind == "none")), generator):
            rgb = take_another_photo(rgb, generator)
        sample = unchecked(
            DepthSample, dataset=scene.dataset, scene=scene.name, rgb=rgb.clamp(0, 1), depth_lr=noisy.reciprocal(),
            camera=scene.camera, camera_lr=camera_lr, scale=scale, depth=scene.depth, notes=(), unit=CENTIMETRES,
            regions={},
        )  # fmt: skip
        return sample, self._hints(clean, noisy, kernel, generator, soft=soft)

    def _downsample(
        self, depth: Tensor, camera: Camera, scale: int, kernel: str, kind: str, generator: torch.Generator
    ) -> tuple[Tensor, Camera]:
        """Return a map without noise, inverse depth of (1, h, w), perhaps displaced, and its camera."""
        values = depth.float().reciprocal()
        if kind != "none" and chance(self.displaced, generator):
            values = displace(values, scale, generator)
        of_depth = kind == "flight" or chance(0.15, generator)
        if scale == 1:
            return values, camera
        if kernel == "spread":
            model = Downsampling("gaussian", sigma=uniform(0.6, 1.1, generator))
        else:
            model = Downsampling(kernel)  # type: ignore[arg-type]  # one of them
        low = model(values.reciprocal(), scale).reciprocal() if of_depth else model(values, scale)
        return low, model.camera(camera, scale)

    def _hints(self, clean: Tensor, noisy: Tensor, kernel: str, generator: torch.Generator, *, soft: bool) -> Hints:
        named = "gaussian" if kernel == "spread" else kernel
        of_kernel = named if chance(self.told, generator) else None
        of_steps = soft if chance(self.told, generator) else None
        noise, of_noise = torch.zeros_like(clean), chance(self.told, generator)
        if of_noise:
            noise = local_noise(noisy[None], clean[None])[0] * math.exp(0.15 * normal(generator))
        return Hints(noise, encode_facts(of_kernel, of_steps, noise=of_noise))


def plain() -> None:
    """Return no distribution, for ``degradation=plain``: maps are made by downsampling and noise alone."""


def add_relief(scene: Scene, generator: torch.Generator) -> Scene:
    """Return a scene whose true depth has grain of 1 to 4 pixels, as of a scan, or is rounded, as in a file."""
    values = scene.true_depth.reciprocal()
    if chance(ROUNDED, generator):
        return derived(scene, depth=round_values(values, generator).reciprocal())
    grain = field_of(values.float(), draw_grain_width(generator), generator)
    return derived(scene, depth=(values * (1 + power(*GRAIN, generator) * grain)).reciprocal())


def draw_grain_width(generator: torch.Generator) -> float:
    """Return a random standard deviation of the Gaussian that blurs grain, in pixels; 0 for white grain."""
    return uniform(0, 1.5, generator) if chance(0.6, generator) else 0.0


def add_folds(scene: Scene, generator: torch.Generator) -> Scene:
    """Return a scene with smooth folds on parts of its surfaces, shaded by a light from a random side."""
    like = scene.true_depth.float()
    sizes = power(0.3, 1.4, generator), power(0.3, 1.4, generator)
    field = field_of(like, sizes, generator)
    if chance(0.4, generator):  # creases
        field = field.abs() - 0.8
    place = torch.sigmoid(6 * (field_of(like, 20, generator) + uniform(-1, 1, generator)))
    slope = power(-1.5, -0.2, generator)
    height = slope * min(sizes) / scene.camera.fx * field * place  # relative to the depth
    angle, strength = uniform(-math.pi, math.pi, generator), max(0.0, uniform(-0.4, 1.2, generator))
    down, across = (functional.pad(height.diff(dim=dim), pad) for dim, pad in ((-2, (0, 0, 0, 1)), (-1, (0, 1, 0, 0))))
    light = 1 + strength * scene.camera.fx * (math.cos(angle) * across + math.sin(angle) * down)
    rgb = (scene.rgb * light.clamp(0.2, 1.8).to(scene.rgb)).clamp(0, 1)
    return derived(scene, rgb=rgb, depth=scene.true_depth * (1 + height.clamp(-0.2, 0.2)).to(scene.true_depth))


def displace(values: Tensor, scale: int, generator: torch.Generator) -> Tensor:
    """Return a map (1, H, W) shifted by up to ``scale`` pixels along each axis, half of them also magnified."""
    for dim in (-2, -1):
        size = values.shape[dim]
        shift, growth = uniform(-scale, scale, generator), uniform(-scale, scale, generator)
        if chance(0.5, generator):
            growth = 0.0
        places = torch.arange(size, dtype=torch.float32)
        moves = (shift + growth * (2 * places / max(size - 1, 1) - 1)).clamp(-scale, scale)
        values = values.index_select(dim, (places + moves).round().long().clamp(0, size - 1))
    return values


def round_values(values: Tensor, generator: torch.Generator) -> Tensor:
    """Round to millimetres of depth, or to 8 bits of disparity."""
    if chance(0.6, generator):
        step = STEPS[integer(0, 3, generator)]
        return ((values.reciprocal() / step).round() * step).clamp(min=step).reciprocal()
    top = float(values.nan_to_num(0).max()) * uniform(1, 1.3, generator)
    return ((values / top * 255).round() / 255 * top).clamp(min=top / 255)


def take_another_photo(rgb: Tensor, generator: torch.Generator) -> Tensor:
    """Return a photo, (3, H, W), with another exposure, white balance and contrast, and with blur, noise and JPEG."""
    gain = math.exp(uniform(-0.7, 0.5, generator)) * (1 + 0.08 * torch.randn((3, 1, 1), generator=generator))
    rgb = (rgb * gain).clamp(0, 1) ** math.exp(uniform(-0.4, 0.4, generator))
    if chance(1 / 12, generator):  # shows little, down to nothing, as at night or in fog
        rgb = torch.lerp(rgb.mean(dim=(-2, -1), keepdim=True), rgb, uniform(0, 0.3, generator))
    if chance(0.5, generator):
        sigma = uniform(0.3, 1.2, generator)
        rgb = torch.from_numpy(ndimage.gaussian_filter(rgb.numpy(), (0, sigma, sigma), mode="nearest", truncate=2.5))
    rgb = (rgb + uniform(0, 0.03, generator) * torch.randn(rgb.shape, generator=generator)).clamp(0, 1)
    if chance(0.5, generator):
        pixels = (255 * rgb).round().byte().permute(1, 2, 0).numpy()[..., ::-1]
        _, code = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, round(uniform(25, 90, generator))])
        decoded = cv2.cvtColor(np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR)), cv2.COLOR_BGR2RGB)
        rgb = torch.from_numpy(decoded).permute(2, 0, 1).float() / 255
    return rgb

"""The losses of trainings: of disparity and renderings, of Facets with its expected errors, and of shading.

The shading loss is that of DDRNet (Yan et al., ECCV 2018): a photo against the shading of a surface under the light
that explains it, B = R sum over b of l_b H_b(n) of the albedo R and the nine spherical harmonics H_b up to the second
degree (Ramamoorthi and Hanrahan, SIGGRAPH 2001) of the normals n. The l_b are found by least squares with the normals
of the reference depth, the albedo from the photo alone, by Retinex (Grosse et al., ICCV 2009).
"""

import abc
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.surface import angle_between
from dsr.methods.images import compute_min_max, dct2, grey, idct2, laplacian_eigenvalues, upsample_bicubic
from dsr.methods.networks.network import Answer, DisparityNetwork
from dsr.metrics.functional import SurfacePair, masked_mean, mse_v
from dsr.metrics.losses import MSE_V, VisualLoss, VisualLossName, l1, lap1, make_visual_loss, match_weight, mse
from dsr.training.degradation import Batch
from dsr.utils.compute_device import in_own_precision
from dsr.utils.guards import expect_one_of, expect_positive

DepthLoss = Literal["lap1", "l1", "mse"]
_TILT = math.asin(5 / 255)  # 1.1 degrees: changes a rendering under grazing light by 5 of 255, as for BadPix_v(5)
_DEPTH_LOSSES = {"lap1": lap1, "l1": l1, "mse": mse}
_PATCHES_FOR_W = 64
_RIDGE = 1e-4  # weight of the light's squared coefficients, as in DDRNet's code; the errors' weight is one per pixel
_LARGEST_ALBEDO = 2.0  # albedos have a mean of 1 and are clipped to this, as in DDRNet's code
_DARKEST = 1 / 255
_GREY_STEP, _COLOUR_STEP = 0.1, 0.05  # larger changes of log intensity and of colour per pixel are the albedo's


class Objective(abc.ABC):
    """The loss of a training: a dataclass of plain values, or a class that overrides ``arguments`` and ``of``."""

    @property
    @abc.abstractmethod
    def formula(self) -> str:
        """The loss as a formula."""

    @property
    @abc.abstractmethod
    def facts(self) -> dict[str, str | float]:
        """Entries of the loss in the header of weights files."""

    def arguments(self) -> dict[str, Any]:
        """Return plain values from which :meth:`of` makes the loss again."""
        return dict(vars(self))

    @classmethod
    def of(cls, **arguments: Any) -> Self:
        """Return the loss of some :meth:`arguments`."""
        return cls(**arguments)

    @abc.abstractmethod
    def __call__(self, answer: Answer, batch: Batch) -> dict[str, Tensor]:
        """Return ``loss`` and its terms, means over the images of a batch of patches that have valid depth."""

    @abc.abstractmethod
    def check(self, net: DisparityNetwork, patch: int, *, hinted: bool) -> None:
        """Raise a ValueError if a network cannot be trained with this loss on such patches, ``hinted`` or not."""

    def balanced(self, first_patches: Callable[[int], Sequence[Batch]]) -> Self:
        """Return the loss with weights that are computed from the first patches; itself if it has no such weights."""
        return self


@dataclass(frozen=True)
class DepthObjective(Objective):
    """The loss: depth_loss + w visual (Voynov et al. 2019, eq. 4: Lap_1 + w MSE_v), and perhaps a shading loss.

    The depth loss compares disparities divided by the range of the low-resolution ones.
    """

    depth_loss: DepthLoss = "lap1"
    w: float | Literal["auto"] = 0.0
    visual: VisualLoss = MSE_V
    shading: float = 0.0

    def __post_init__(self) -> None:
        expect_one_of("depth_loss", self.depth_loss, _DEPTH_LOSSES)
        expect_positive(or_zero=True, shading=self.shading)
        if self.w != "auto" and not 0 <= self.w < math.inf:
            raise ValueError(f"w: expected auto or a number, 0 or more, got {self.w}")

    @property
    def formula(self) -> str:
        """The loss as a formula."""
        if self.w == "auto":
            return f"{self.depth_loss} + w {self.visual.title}; w is computed from the scenes"
        terms = {self.visual.title: self.w, "shading": self.shading}
        return " + ".join([self.depth_loss, *(f"{weight:.3g} {name}" for name, weight in terms.items() if weight)])

    @property
    def facts(self) -> dict[str, str | float]:
        """Entries of the loss in the header of weights files."""
        visual = self.visual.name if self.w else "none"
        return {"loss": self.depth_loss, "visual": visual, "w": self.w, "shading": self.shading}

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments, the visual loss by its name."""
        return {**vars(self), "visual": self.visual.name}

    @classmethod
    def of(cls, *, visual: VisualLossName = "mse_v", **arguments: Any) -> Self:
        """Return the loss of some :meth:`arguments`; ``lpips`` looks for AlexNet's weights."""
        return cls(visual=make_visual_loss(visual), **arguments)

    def check(self, net: DisparityNetwork, patch: int, *, hinted: bool) -> None:
        """Refuse a network that states its errors, and patches that are too small for the visual loss."""
        if net.states_errors:
            raise ValueError(f"objective: expected SurfaceObjective for {type(net).__name__}, got DepthObjective")
        self.visual.check_size(patch, patch)

    def balanced(self, first_patches: Callable[[int], Sequence[Batch]]) -> Self:
        """Return the loss with a computed weight in place of ``auto``; see :func:`balance_weight`."""
        return replace(self, w=balance_weight(first_patches(_PATCHES_FOR_W), self.visual)) if self.w == "auto" else self

    @in_own_precision
    def __call__(self, answer: Answer, batch: Batch) -> dict[str, Tensor]:
        """Return ``loss`` and its terms; intermediate stages of the network get the depth loss, too."""
        name, w = self.depth_loss, 1.0 if self.w == "auto" else self.w
        compare, extent = _DEPTH_LOSSES[name], _range(batch["disparity_lr"])
        target = (batch["bf"] / batch["depth"] - batch["doffs"]) / extent
        loss = compare(answer.disparity / extent, target).nanmean()
        terms: dict[str, Tensor] = {name: loss}
        for number, stage in enumerate(answer.stages, 1):
            terms[f"{name}_stage{number}"] = compare(stage / extent, target).nanmean()
            loss = loss + terms[f"{name}_stage{number}"]
        if w or self.shading:
            pair = SurfacePair(to_depth(answer.disparity, batch), batch["depth"], batch["rays"])
        if w:
            terms[self.visual.name] = self.visual(pair).nanmean()
            loss = loss + w * terms[self.visual.name]
        if self.shading:
            terms["shading"] = shading_loss(pair, batch["rgb"]).nanmean()
            loss = loss + self.shading * terms["shading"]
        return {"loss": loss, **terms}


@dataclass(frozen=True)
class SurfaceObjective(Objective):
    """The loss of a network with expected errors: K Lap_1 + RMSE_v, and the likelihoods of its expected errors.

    Lap_1 compares disparities divided by the truth's median. The RMSE of the divided disparities is added, with a
    larger weight where the truth's depth steps are soft. The expected errors are the scales of Laplace distributions,
    of the logarithm of disparity and of the angle between the normals.
    """

    depth: float = 20.0  # K
    soft: float = 8.0  # weight of the RMSE of maps with soft depth steps
    sharp: float = 2.0  # and of those with sharp ones
    errors: float = 0.02  # weight of each of the two negative logarithms of likelihoods

    @property
    def formula(self) -> str:
        """The loss as a formula."""
        terms = f"{self.depth:g} Lap_1 + RMSE_v + {self.sharp:g} RMSE ({self.soft:g} of soft maps)"
        return f"{terms} + {self.errors:g} (likelihoods of the expected errors)"

    @property
    def facts(self) -> dict[str, str | float]:
        """Entries of the loss in the header of weights files."""
        return {"loss": "surface", **vars(self)}

    def check(self, net: DisparityNetwork, patch: int, *, hinted: bool) -> None:
        """Refuse a network that does not state its errors, and maps without hints."""
        name = type(net).__name__
        if not net.states_errors:
            raise ValueError(f"objective: expected DepthObjective for {name}, got SurfaceObjective")
        if not hinted:
            raise ValueError(f"degradation: expected everything or another one with hints, for {name}, got plain")

    @in_own_precision
    def __call__(self, answer: Answer, batch: Batch) -> dict[str, Tensor]:
        """Return ``loss`` and its terms; disparity is without offset, and ``soft`` (B,) is 1 for soft depth steps."""
        disparity, target = answer.disparity, batch["bf"] / batch["depth"]
        unit = target.flatten(1).nanmedian(dim=1).values.view(-1, 1, 1, 1)
        positive = disparity > 0
        depth = torch.where(positive, batch["bf"] / torch.where(positive, disparity, 1), torch.nan)
        pair = SurfacePair(depth, batch["depth"], batch["rays"])
        squares = ((disparity - target) / unit).nan_to_num(0).square()
        rmse = (masked_mean(squares, target.isfinite())[:, 0] + 1e-7).sqrt()
        terms = {
            "lap1": lap1(disparity / unit, target / unit).nanmean(),
            "rmse_v": (mse_v(pair) + 1e-5).sqrt().nanmean(),
            "rmse_soft": (batch["soft"] * rmse).nanmean(),
            "rmse_sharp": ((1 - batch["soft"]) * rmse).nanmean(),
        }
        with torch.no_grad():
            off = (disparity.clamp(min=1e-6) / target).log().abs()
            angle = torch.deg2rad(angle_between(*pair.normals))
        for name, expected, error, valid in (
            ("spread", answer.spread, off, off.isfinite()),
            ("angle", answer.angle, angle, pair.normal_mask & angle.isfinite()),
        ):
            likelihood = expected.log() + torch.where(valid, error, 0) / expected
            terms[name] = masked_mean(likelihood, valid).nanmean()
        loss = self.depth * terms["lap1"] + terms["rmse_v"]
        loss = loss + self.soft * terms["rmse_soft"] + self.sharp * terms["rmse_sharp"]
        loss = loss + self.errors * (terms["spread"] + terms["angle"])
        return {"loss": loss, **terms}


@in_own_precision
def shading_loss(pair: SurfacePair, rgb: Tensor) -> Tensor:
    """Return the mean squared difference of photos (B, 3, H, W) and B clipped to [0, 1], (B,); NaN without a normal."""
    valid = pair.normal_mask
    normals, reference = (torch.where(valid, each, 0) for each in pair.normals)
    rgb = rgb.to(normals)
    intensity, albedo = grey(rgb), estimate_albedo(rgb)
    light = estimate_light(reference, intensity, albedo, valid)
    shaded = albedo * torch.einsum("bl,blhw->bhw", light, harmonics(normals))[:, None]
    squares = torch.where(valid, shaded.clamp(0, 1) - intensity, 0).square()
    return squares.sum(dim=(-3, -2, -1)) / valid.sum(dim=(-3, -2, -1))


def harmonics(normals: Tensor) -> Tensor:
    """Return the nine spherical harmonics H_b up to constant factors, (B, 9, H, W), of normals, (B, 3, H, W)."""
    x, y, z = normals.unbind(dim=-3)
    second = (x * y, y * z, 2 * z.square() - x.square() - y.square(), z * x, x.square() - y.square())
    return torch.stack((torch.ones_like(x), y, z, x, *second), dim=-3)


def estimate_light(normals: Tensor, intensity: Tensor, albedo: Tensor, valid: Tensor) -> Tensor:
    """Return the coefficients l_b of the light that explains the valid pixels of each photo best, (B, 9)."""
    # In 64 bits: of nearly flat surfaces the equations are so badly conditioned that 32 leave nothing but rounding.
    basis = torch.where(valid, albedo * harmonics(normals), 0).flatten(2).double()
    squares = basis @ basis.transpose(1, 2)
    squares = squares + _RIDGE * torch.eye(9, dtype=basis.dtype, device=basis.device)
    return torch.linalg.solve(squares, basis @ intensity.flatten(2).transpose(1, 2).double())[..., 0].to(normals)


def estimate_albedo(rgb: Tensor) -> Tensor:
    """Return the albedo of photos by Retinex, (B, 1, H, W), whose logarithm has the photo's edges, but no slopes."""
    log_rgb = rgb.clamp(min=_DARKEST).log()
    log_grey = grey(rgb).clamp(min=_DARKEST).log()
    colour = log_rgb - log_rgb.mean(dim=1, keepdim=True)
    steps = []
    for dim in (-1, -2):
        step = log_grey.diff(dim=dim)
        change = colour.diff(dim=dim).square().sum(dim=1, keepdim=True).sqrt()
        steps.append(torch.where((step.abs() > _GREY_STEP) | (change > _COLOUR_STEP), step, 0))
    albedo = integrate(*steps).exp()
    return (albedo / albedo.mean(dim=(-3, -2, -1), keepdim=True)).clamp(max=_LARGEST_ALBEDO)


def integrate(along_u: Tensor, along_v: Tensor) -> Tensor:
    """Return the maps (B, 1, H, W) of mean 0 whose differences are nearest to (B, 1, H, W - 1) and (B, 1, H - 1, W)."""
    # A Poisson equation with Neumann borders, which the discrete cosine transform diagonalises
    divergence = functional.pad(along_u, (0, 1)) - functional.pad(along_u, (1, 0))
    divergence = divergence + functional.pad(along_v, (0, 0, 0, 1)) - functional.pad(along_v, (0, 0, 1, 0))
    height, width = divergence.shape[-2:]
    eigenvalues = laplacian_eigenvalues(height, width, divergence)
    eigenvalues[0, 0] = torch.inf  # the mean is free
    return idct2(dct2(divergence) / eigenvalues)


def to_depth(disparity: Tensor, batch: Batch) -> Tensor:
    """Return orthogonal depth in metres, (B, 1, H, W); NaN where it would be infinite or negative."""
    shifted = disparity + batch["doffs"]
    return torch.where(shifted > 0, batch["bf"] / torch.where(shifted > 0, shifted, 1), torch.nan)


def balance_weight(patches: Sequence[Batch], visual: VisualLoss = MSE_V) -> float:
    """Return the weight w with which a small tilt of the surface costs the same in both terms of the loss.

    A depth error of tan(a) z / f from one pixel to the next tilts the normal by a. The depth term of this error is
    bf tan(a) / (f z range), with the range of the low-resolution disparities; MSE_v is (2 - 2 cos a) / 3. w is the
    median of their ratio over the patches, which have no batch axis. Another visual loss becomes as large as w MSE_v
    for bicubic interpolation.
    """
    if not patches:
        raise ValueError("patches: expected one or more to compute w from, got none")
    ratios, batches = [], [{name: value[None] for name, value in patch.items()} for patch in patches]
    for batch in batches:
        x = batch["rays"][0, 0, 0].double()
        focal = (x.numel() - 1) / float(x[-1] - x[0])
        depth = float(batch["depth"][batch["depth"].isfinite()].median())
        extent = float(_range(batch["disparity_lr"]))
        ratios.append(float(batch["bf"]) * math.tan(_TILT) / (focal * depth * extent))
    w = float(torch.tensor(ratios, dtype=torch.float64).median()) / ((2 - 2 * math.cos(_TILT)) / 3)
    if visual.name == "mse_v":
        return w
    pairs = []
    for batch in batches:
        scale = batch["depth"].shape[-1] // batch["disparity_lr"].shape[-1]
        interpolated = to_depth(upsample_bicubic(batch["disparity_lr"], scale), batch)
        pairs.append(SurfacePair(interpolated, batch["depth"], batch["rays"]))
    return w * match_weight(visual, pairs)


def _range(disparity: Tensor) -> Tensor:
    """Return the range of valid disparities per image, (B, 1, 1, 1), at least a thousandth of the largest."""
    low, high = compute_min_max(disparity).chunk(2, dim=1)
    return (high - low).clamp(min=1e-3 * high.abs().clamp(min=1e-3))

"""Super-resolution from shading, without training (SRfS): depth, albedo and light that explain an image.

Haefner, Quéau, Möllenhoff and Cremers, *Fight Ill-Posedness with Ill-Posedness: Single-shot Variational Depth
Super-Resolution from Shading*, CVPR 2018, minimise

    E = 1/2 sum |albedo * shading - rgb|^2 + data / 2 * sum |mean z - lr|^2
        + area * sum z |m| + boundary * (length of the albedo's boundaries),
    shading = l_1 n_x + l_2 n_y + l_3 n_z + l_4,    n = m / |m|,    m = (p, q, -z - x p - y q),

with z in pixels here (times the focal length, by the median depth), the slopes p = fx dz/du and q = fy dz/dv, and the
ray (x, y, 1) of the pixel. With a copy theta of (p, q, z) and the scaled multiplier u, the augmented Lagrangian is E
with theta in all terms except for the data term, plus penalty / 2 * (|(p, q, z) + u - theta|^2 - |u|^2). Alternating
steps lower it: the albedo by region fusion (:func:`fuse`), the lighting by least squares, theta by Levenberg and
Marquardt's method, z by conjugate gradients.

What differs, besides what docs/measurements/methods.md says and the weights (the original's: data 0.0015, area 1e-7,
boundary 0.5 at x4 with a focal length of 500 pixels): the penalty of the copy of z is weighted by 1 / scale^2; it
starts from the bicubic map, which stays unchanged outside the foreground. Holes have no data term.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from dsr.geometry.surface import length
from dsr.methods.base import Abilities, Cost, Method, whole_scale
from dsr.methods.images import box_mean, inpaint, repeat_blocks, upsample_linear_border
from dsr.sample import DepthSample
from dsr.utils.decoding import decode_pixels
from dsr.utils.guards import MOST_FILE, expect_positive, pixels_beside, read_limited
from dsr.utils.progress import Steps

_TINY = 1e-12  # minimum length of m, which avoids division by 0
_RANK = 1e-10  # relative cutoff of singular values, below which a direction of the light is not determined
_CG_ITERATIONS, _CG_TOLERANCE = 60, 1e-6
_INNER = 3  # Levenberg-Marquardt steps in an update of theta
_LESS, _MORE = 0.2, 5.0  # factors of its damping after a step that lowers the energy, and after one that does not
_RENEW = 10  # iterations between two searches for the regions of the albedo
_NEARER = 4.0  # factor by which a result may be nearer than the nearest valid low-resolution pixel
_WHITE = 127  # value of a mask above which a pixel is white
BRIGHTEST = 2.0  # maximum albedo; the minimum is 0
_LEVELS = 5  # number of times that the weight of boundaries grows to reach its value
_GROWTH = 4.0  # factor of its growth
_SHUFFLE = 2654435761  # multiplier of Knuth's hash
_RANGE = 2**32


def compute_surface(theta: Tensor, rays: Tensor) -> tuple[Tensor, Tensor]:
    """Return the normals (B, 3, H, W) and |m| (B, 1, H, W) of theta (B, 3, H, W) and rays (1, 3, H, W)."""
    p, q, z = theta.split(1, dim=1)
    m = torch.cat((p, q, -z - rays[:, :1] * p - rays[:, 1:2] * q), dim=1)
    size = length(m).clamp(min=_TINY)
    return m / size, size


def compute_shading(normals: Tensor, lighting: Tensor) -> Tensor:
    """Return the shading, (B, C, H, W), of normals (B, 3, H, W) under lighting (B, C, 4)."""
    return torch.einsum("bck,bkhw->bchw", lighting[..., :3], normals) + lighting[..., 3, None, None]


def fit_lighting(rgb: Tensor, albedo: Tensor, normals: Tensor, inside: Tensor) -> Tensor:
    """Return the lighting with the least squared error, of several the one of minimum norm, (B, C, 4) float64."""
    ones = torch.ones_like(normals[:, :1])
    design = (torch.cat((normals, ones), dim=1) * inside)[:, None] * albedo[:, :, None]  # (B, C, 4, H, W)
    columns = design.flatten(3).double()
    gram = columns @ columns.mT
    right = columns @ (rgb * inside).flatten(2).double()[..., None]
    return (torch.linalg.pinv(gram, hermitian=True, rtol=_RANK) @ right)[..., 0]


class ShadingProblem(NamedTuple):
    """The constants of the problem."""

    rgb: Tensor  # (B, C, H, W)
    lr: Tensor  # (B, 1, h, w) in the unit of z, NaN in holes
    rays: Tensor  # (1, 3, H, W)
    focal: tuple[float, float]  # (fx, fy) of the image's camera
    unit: float  # z of the median depth
    inside: Tensor  # (B, 1, H, W) bool, the pixels that may change
    data_weight: float
    area_weight: float
    boundary_weight: float


class Slopes:
    """The linear operator z -> (fx dz/du, fy dz/dv, z) / unit, and its adjoint.

    Differences are forward between pixels inside the mask, backward where there is no next pixel, else 0, without a
    mask those of :func:`dsr.geometry.surface.depth_to_normals`.
    """

    def __init__(self, problem: ShadingProblem) -> None:
        self._unit = problem.unit
        self._axes = []
        for dim, focal in zip((-1, -2), problem.focal, strict=True):
            ahead = problem.inside & problem.inside.roll(-1, dim)
            ahead.select(dim, -1).fill_(value=False)  # no pixel follows the last one
            behind = ahead.roll(1, dim) & ~ahead
            self._axes.append((dim, focal / problem.unit, ahead.to(problem.rgb), behind.to(problem.rgb)))

    def __call__(self, z: Tensor) -> Tensor:
        """Return theta of z, (B, 1, H, W) -> (B, 3, H, W)."""
        found = []
        for dim, factor, ahead, behind in self._axes:
            step = z.roll(-1, dim) - z  # where it wraps around the border, both weights are 0
            found.append(factor * (ahead * step + behind * step.roll(1, dim)))
        return torch.cat((*found, z / self._unit), dim=1)

    def adjoint(self, theta: Tensor) -> Tensor:
        """Apply the adjoint, (B, 3, H, W) -> (B, 1, H, W): <theta of z, theta> = <z, what is returned>."""
        total = theta[:, 2:] / self._unit
        for (dim, factor, ahead, behind), slope in zip(self._axes, theta[:, :2].split(1, dim=1), strict=True):
            step = factor * (ahead * slope + (behind * slope).roll(-1, dim))
            total = total + step.roll(1, dim) - step
        return total


class ShadingSolver:
    """The variables of a problem, from an initial z (B, 1, H, W), and their updates; ``missed`` is u."""

    def __init__(self, problem: ShadingProblem, first: Tensor, penalty: float) -> None:
        self.problem, self.penalty = problem, penalty
        self.scale = problem.rgb.shape[-1] // problem.lr.shape[-1]
        self.slopes = Slopes(problem)
        self._weight = problem.inside.to(problem.rgb)
        self._valid = problem.lr.isfinite()
        self._lr = torch.where(self._valid, problem.lr, 0)
        coupling = problem.rgb.new_tensor((1.0, 1.0, (problem.unit / self.scale) ** 2))
        self.coupling = coupling[:, None, None] * self._weight  # of the penalty, (B, 3, H, W)
        self.z, self.theta = first, self.slopes(first)
        self.missed = torch.zeros_like(self.theta)
        self.albedo = problem.rgb
        self.lighting = problem.rgb.new_tensor((0.0, 0.0, -1.0, 0.0)).expand(*problem.rgb.shape[:2], 4)
        self.regions: Regions | None = None
        self._damping = torch.full_like(first, 1e-3)

    def update_albedo(self, *, anew: bool = True) -> None:
        """Set the best piecewise constant albedo, in new regions if these are better than the old ones."""
        problem = self.problem
        shading = compute_shading(compute_surface(self.theta, problem.rays)[0], self.lighting)
        found = [] if self.regions is None else [self.regions]
        if anew or not found:
            found.append(fuse(problem.rgb, shading, problem.boundary_weight, problem.inside))
        tried = [(fit_albedo(problem.rgb, shading, regions), regions) for regions in found]
        energies = [sum(self._energies(albedo, shading, regions)) for albedo, regions in tried]
        self.albedo, self.regions = tried[energies.index(min(energies))]

    def update_lighting(self) -> None:
        """Set the best lighting."""
        normals, _ = compute_surface(self.theta, self.problem.rays)
        self.lighting = fit_lighting(self.problem.rgb, self.albedo, normals, self._weight).to(self.problem.rgb)

    def update_theta(self) -> None:
        """Lower the Lagrangian in theta, pixel by pixel."""
        target = self.slopes(self.z) + self.missed
        energy = self.pixel_energy(self.theta, target)
        for _ in range(_INNER):
            near = self.theta - _solve(*self.expand_energy(self.theta, target), self._damping)
            lower = self.pixel_energy(near, target)
            better = lower < energy
            self.theta, energy = torch.where(better, near, self.theta), torch.where(better, lower, energy)
            self._damping = (self._damping * torch.where(better, _LESS, _MORE)).clamp(1e-6, 1e6)

    def update_depth(self, growth: float) -> None:
        """Lower the Lagrangian in z by conjugate gradients; then update the multiplier, and multiply the penalty."""

        def curvature(z: Tensor) -> Tensor:  # the second derivative in z, times z; 0 outside the mask
            inside = self._weight * z
            own = self.penalty * self.slopes.adjoint(self.coupling * self.slopes(inside))
            return self._weight * (own + data_weight * self._block_means_adjoint(self._block_means(inside)))

        data_weight = self.problem.data_weight
        wanted = self.theta - self.missed - self.slopes(self.z)
        right = self._weight * (
            data_weight * self._block_means_adjoint(self._lr - self._block_means(self.z))
            + self.penalty * self.slopes.adjoint(self.coupling * wanted)
        )
        self.z = self.z + conjugate_gradients(curvature, right, _CG_ITERATIONS, _CG_TOLERANCE)
        self.missed = (self.missed + self.slopes(self.z) - self.theta) / growth
        self.penalty *= growth

    def terms(self, theta: Tensor) -> dict[str, float]:
        """Return the terms ``shading``, ``data``, ``area`` and ``boundaries`` of E; of the Lagrangian for the copy."""
        normals, size = compute_surface(theta, self.problem.rays)
        miss = self._lr - self._block_means(self.z)
        area = theta[:, 2:].abs() * size
        shading, boundaries = self._energies(self.albedo, compute_shading(normals, self.lighting), self.regions)
        return {
            "shading": shading,
            "data": 0.5 * self.problem.data_weight * float(miss.square().sum()),
            "area": self.problem.area_weight * float((self._weight * area).sum()),
            "boundaries": boundaries,
        }

    def pixel_energy(self, theta: Tensor, target: Tensor) -> Tensor:
        """Return the Lagrangian of theta in each pixel, (B, 1, H, W); ``target`` is (p, q, z) + u."""
        normals, size = compute_surface(theta, self.problem.rays)
        missed = self.albedo * compute_shading(normals, self.lighting) - self.problem.rgb
        area = theta[:, 2:].abs() * size
        own = 0.5 * missed.square().sum(dim=1, keepdim=True) + self.problem.area_weight * area
        bound = 0.5 * self.penalty * (self.coupling * (theta - target).square()).sum(dim=1, keepdim=True)
        return self._weight * own + bound

    def expand_energy(self, theta: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Return its gradient (B, 3, H, W) and an approximate Hessian (B, 6, H, W): the upper triangle, row by row."""
        rays, area_weight, light = self.problem.rays, self.problem.area_weight, self.lighting[..., :3]
        n, size = compute_surface(theta, rays)
        directed = torch.einsum("bck,bkhw->bchw", light, n)
        residual = self.albedo * (directed + self.lighting[..., 3, None, None]) - self.problem.rgb
        by_m = (light[..., None, None] - directed[:, :, None] * n[:, None]) * (self.albedo / size)[:, :, None]
        slopes = _chain_to_theta(by_m, rays)  # the derivatives of the residual, (B, C, 3, H, W)
        stretch = _chain_to_theta(n, rays)  # those of |m|

        depth = theta[:, 2:]
        gradient = (residual[:, :, None] * slopes).sum(dim=1) + area_weight * depth.abs() * stretch
        gradient[:, 2:] += area_weight * depth.sign() * size
        gradient = gradient * self._weight + self.penalty * self.coupling * (theta - target)

        curved = area_weight * depth.abs() / size
        x, y = rays[:, :1], rays[:, 1:2]
        along = ((0, 0, 1 + x * x), (0, 1, x * y), (0, 2, x), (1, 1, 1 + y * y), (1, 2, y), (2, 2, 1.0))
        triangle = []
        for i, j, product in along:
            shaded = (slopes[:, :, i] * slopes[:, :, j]).sum(dim=1, keepdim=True)
            triangle.append(shaded + curved * (product - stretch[:, i : i + 1] * stretch[:, j : j + 1]))
        hessian = torch.cat(triangle, dim=1) * self._weight
        hessian[:, [0, 3, 5]] += self.penalty * self.coupling
        return gradient, hessian

    def _block_means(self, z: Tensor) -> Tensor:
        return torch.where(self._valid, box_mean(z, self.scale), 0)

    def _block_means_adjoint(self, lr: Tensor) -> Tensor:
        return repeat_blocks(lr, self.scale) / self.scale**2

    def _energies(self, albedo: Tensor, shading: Tensor, regions: Regions | None) -> tuple[float, float]:
        """Return the terms of E for the shading and for the albedo's boundaries, 0 without regions."""
        shaded = 0.5 * float((self._weight * (albedo * shading - self.problem.rgb).square()).sum())
        if regions is None:
            return shaded, 0.0
        borders = _find_borders(regions.labels, self.problem.inside)
        return shaded, self.problem.boundary_weight * int((borders.one != borders.other).sum())


def _chain_to_theta(by_m: Tensor, rays: Tensor) -> Tensor:
    """Convert derivatives by m to derivatives by theta, (..., 3, H, W)."""
    along_u, along_v, ahead = by_m.unbind(dim=-3)
    return torch.stack((along_u - rays[0, 0] * ahead, along_v - rays[0, 1] * ahead, -ahead), dim=-3)


def _solve(gradient: Tensor, hessian: Tensor, damping: Tensor) -> Tensor:
    """Return the inverse of the damped Hessian, its diagonal multiplied by 1 + damping, times the gradient."""
    a, b, c, d, e, f = hessian.unbind(dim=1)
    more = 1 + damping[:, 0]
    a, d, f = (torch.where(each > 0, each * more, 1) for each in (a, d, f))
    x, y, z = gradient.unbind(dim=1)
    l21, l31 = b / a, c / a
    middle = d - l21 * b
    low = e - l21 * c
    l32 = low / middle
    last = f - l31 * c - l32 * low
    y = y - l21 * x
    z = (z - l31 * x - l32 * y) / last
    y = (y - low * z) / middle
    x = (x - b * y - c * z) / a
    return torch.stack((x, y, z), dim=1)


def conjugate_gradients(
    operator: Callable[[Tensor], Tensor], right: Tensor, iterations: int, tolerance: float
) -> Tensor:
    """Solve A x = b, A positive definite, for each element of a batch, (B, ...), until |b - A x| / |b| is small."""

    def dot(a: Tensor, b: Tensor) -> Tensor:  # (B, 1, ...)
        return (a * b).sum(dim=tuple(range(1, a.ndim)), keepdim=True)

    def ratio(above: Tensor, below: Tensor) -> Tensor:  # 0 where ``below`` is: a solved element stays
        return torch.where(below > 0, above / torch.where(below > 0, below, 1), 0)

    x = torch.zeros_like(right)
    residual = direction = right
    size = dot(right, right)
    goal = tolerance**2 * size
    for _ in range(iterations):
        if not bool((size > goal).any()):
            break
        image = operator(direction)
        step = ratio(size, dot(direction, image))
        x = x + step * direction
        residual = residual - step * image
        before, size = size, dot(residual, residual)
        direction = residual + ratio(size, before) * direction
    return x


@dataclass(eq=False)
class ShapeFromShading(Method):
    """Variational super-resolution from shading, of block means of depth whose holes are inpainted."""

    abilities = Abilities(fast_on="cpu", cost=Cost(1300, 60))
    range_type = "orthogonal"

    iterations: int = 40
    tolerance: float = 1e-4
    data_weight: float = 100.0
    area_weight: float = 0.2
    boundary_weight: float = 0.1
    penalty: float = 0.02
    growth: float = 1.3
    foreground: str | None = None

    def __post_init__(self) -> None:
        expect_positive(iterations=self.iterations, penalty=self.penalty)
        expect_positive(data_weight=self.data_weight, boundary_weight=self.boundary_weight)
        expect_positive(or_zero=True, tolerance=self.tolerance, area_weight=self.area_weight)
        if not 1 <= self.growth < float("inf"):
            raise ValueError(f"growth: expected at least 1, got {self.growth}")
        if self.foreground is not None and not Path(self.foreground).is_dir():
            raise ValueError(f"foreground: expected a folder of masks, there is none at {self.foreground}")

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return high-resolution depth without holes, (1, H, W) in metres on the sample's device."""
        self.history = []
        solver, metres = self.prepare(sample)
        objective = float("nan")
        for done in range(1, self.iterations + 1):
            before, objective_before = solver.z, objective
            solver.update_albedo(anew=done % _RENEW == 1)
            solver.update_lighting()
            solver.update_theta()
            solver.update_depth(self.growth)
            theta = solver.slopes(solver.z)
            terms = solver.terms(theta)
            objective = sum(terms.values())
            residual = float((theta - solver.theta)[:, :2].square().mean().sqrt())
            moved = float((solver.z - before).square().mean().sqrt()) / solver.problem.unit
            entry = {"iteration": done, "objective": objective, **terms, "residual": residual, "moved": moved}
            self.history.append(entry)
            if progress is not None:
                progress(done, self.iterations)
            change = abs(objective - objective_before)
            if change < self.tolerance * abs(objective_before) and residual < self.tolerance:
                break
        if progress is not None:
            progress(self.iterations, self.iterations)
        nearest = float(sample.depth_lr[sample.mask_lr].min()) / _NEARER
        return (solver.z[0] * metres).clamp(min=nearest).to(sample.depth_lr.dtype)

    def prepare(self, sample: DepthSample) -> tuple[ShadingSolver, float]:
        """Return the solver of a sample before its first step, and its unit of depth in metres."""
        lr = sample.depth_lr[None].double()
        camera = sample.camera
        inside = torch.ones(1, 1, camera.height, camera.width, dtype=torch.bool, device=lr.device)
        if self.foreground is not None:
            path = Path(self.foreground) / f"{sample.scene}.png"
            mask = read_foreground(path, (camera.height, camera.width))
            inside = torch.from_numpy(mask)[None, None].to(lr.device)
        unit = (camera.fx * camera.fy) ** 0.5
        metres = float(lr[lr.isfinite()].median()) / unit
        problem = ShadingProblem(
            rgb=sample.rgb[None].to(lr),
            lr=lr / metres,
            rays=camera.rays(device=lr.device)[None],
            focal=(camera.fx, camera.fy),
            unit=unit,
            inside=inside,
            data_weight=self.data_weight,
            area_weight=self.area_weight,
            boundary_weight=self.boundary_weight,
        )
        first = upsample_linear_border(inpaint(problem.lr), whole_scale(sample))
        return ShadingSolver(problem, first, self.penalty), metres


def read_foreground(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Return a mask, (H, W) bool of the given size, True where the picture is white."""
    if not path.is_file():
        raise ValueError(f"{path}: expected a mask of the foreground, there is no such file")
    levels = decode_pixels(path, read_limited(path, MOST_FILE), cv2.IMREAD_GRAYSCALE, pixels_beside(*size))
    if levels is None:
        raise ValueError(f"{path}: expected a mask of the foreground, it is no picture or damaged")
    if levels.shape != size:
        shapes = [" x ".join(map(str, each)) for each in (size, levels.shape)]
        raise ValueError(f"{path}: expected {shapes[0]}, as the photo is, got {shapes[1]}")
    if not (levels > _WHITE).any():
        raise ValueError(f"{path}: expected a foreground in white, got a black mask")
    return levels > _WHITE


class Regions(NamedTuple):
    """A partition: ``labels`` (B, H, W) int64, from 0 to ``number`` - 1, different in each image."""

    labels: Tensor
    number: int


class _Borders(NamedTuple):
    """Pairs of neighbouring regions, (N,) each: both labels, and the length of the boundary between them."""

    one: Tensor
    other: Tensor
    length: Tensor


def fuse(rgb: Tensor, shading: Tensor, weight: float, inside: Tensor) -> Regions:
    """Return regions of a piecewise constant albedo of which no fusion of two lowers E, equal for equal input.

    E = 1/2 sum (rgb - albedo * shading)^2 + weight * (number of pairs of neighbours in different regions), the Potts
    problem. As in Nguyen and Brown (*Fast and Effective L0 Gradient Minimization by Region Fusion*, ICCV 2015), from
    one region per pixel, two neighbours are fused if this costs less than the boundary between them, whose weight grows
    to its value in a few levels. Many are fused at once, in disjoint groups, and only if this lowers E.

    Image and shading are (B, C, H, W) float64, ``weight`` is that of a unit of boundary length, and ``inside`` the mask
    (B, 1, H, W) of the problem; each pixel outside is a region of its own.
    """
    batch, channels, height, width = rgb.shape
    labels = torch.arange(batch * height * width, device=rgb.device)
    squares, products = (each.movedim(1, -1).reshape(-1, channels) for each in (shading.square(), shading * rgb))
    borders = _find_borders(labels.reshape(batch, height, width), inside)
    turn = 0
    for level in range(_LEVELS, -1, -1):
        price = weight / _GROWTH**level
        while (parent := _choose_fusions(squares, products, borders, price, turn)) is not None:
            turn += 1
            roots = parent == torch.arange(len(parent), device=parent.device)
            joined = ~roots
            squares = squares.index_add(0, parent[joined], squares[joined])[roots]
            products = products.index_add(0, parent[joined], products[joined])[roots]
            renamed = (roots.cumsum(0) - 1)[parent]
            labels = renamed[labels]
            one, other = renamed[borders.one], renamed[borders.other]
            apart, count = one != other, len(squares)
            low, high = torch.minimum(one, other)[apart], torch.maximum(one, other)[apart]
            keys, places = torch.unique(low * count + high, return_inverse=True)  # each pair of regions once
            length = torch.zeros_like(keys).index_add_(0, places, borders.length[apart])
            borders = _Borders(keys // count, keys % count, length)
    return Regions(labels.reshape(batch, height, width), len(squares))


def fit_albedo(rgb: Tensor, shading: Tensor, regions: Regions) -> Tensor:
    """Return the best albedo that is constant in each region, (B, C, H, W)."""
    channels, flat = rgb.shape[1], regions.labels.reshape(-1)
    squares, products = (
        each.new_zeros(regions.number, channels).index_add_(0, flat, each.movedim(1, -1).reshape(-1, channels))
        for each in (shading.square(), shading * rgb)
    )
    return _best_albedo(squares, products)[regions.labels].movedim(-1, 1)


def _best_albedo(squares: Tensor, products: Tensor) -> Tensor:
    """Return the best albedo by the sums of shading^2 and shading * rgb, (count, C) each; 0 without shading."""
    best = products / torch.where(squares > 0, squares, 1)
    return torch.where(squares > 0, best, 0).clamp(0, BRIGHTEST)


def _worth(squares: Tensor, products: Tensor) -> Tensor:
    """Return the decrease of the data term from albedo 0 to the best albedo, (count,)."""
    albedo = _best_albedo(squares, products)
    return ((products - 0.5 * squares * albedo) * albedo).sum(dim=1)


def _find_borders(labels: Tensor, inside: Tensor) -> _Borders:
    """Return a border of length 1 for each pair of neighbouring pixels inside."""
    ends = []
    for dim in (-1, -2):
        size = labels.shape[dim] - 1
        both = inside[:, 0].narrow(dim, 0, size) & inside[:, 0].narrow(dim, 1, size)
        ends.append(torch.stack((labels.narrow(dim, 0, size)[both], labels.narrow(dim, 1, size)[both])))
    one, other = torch.cat(ends, dim=1)
    return _Borders(one, other, torch.ones_like(one))


def _choose_fusions(squares: Tensor, products: Tensor, borders: _Borders, price: float, turn: int) -> Tensor | None:
    """Return the region that each region is fused into, (count,), or None if no fusion of two lowers E."""
    one, other, length = borders
    worth, count = _worth(squares, products), len(squares)
    cost = (worth[one] + worth[other] - _worth(squares[one] + squares[other], products[one] + products[other])) / length
    cheap = cost < price
    if not bool(cheap.any()):
        return None
    leaf, centre = torch.cat((one, other))[cheap.repeat(2)], torch.cat((other, one))[cheap.repeat(2)]
    length, cost = length[cheap].repeat(2), cost[cheap].repeat(2)
    # a hash splits regions into centres and those that may join their best neighbour, if it is a centre
    joining = (_hash(torch.arange(count, device=one.device) + turn * count) & 1).bool()
    kept = ~joining[leaf] & joining[centre]
    leaf, centre, length, cost = leaf[kept], centre[kept], length[kept], cost[kept]
    kept = _is_cheapest(leaf, cost, count)
    leaf, centre, length, cost = leaf[kept], centre[kept], length[kept], cost[kept]
    union = squares.index_add(0, centre, squares[leaf]), products.index_add(0, centre, products[leaf])
    lost = worth.index_add(0, centre, worth[leaf]) - _worth(*union)
    saved = torch.zeros_like(worth).index_add_(0, centre, price * length.to(worth))
    # if all fusions of a centre together cost more than the boundaries, it only takes its best neighbour
    joins = (lost < saved)[centre] | _is_cheapest(centre, cost, count)
    parent = torch.arange(count, device=one.device)
    parent[leaf[joins]] = centre[joins]
    return parent


def _is_cheapest(owner: Tensor, cost: Tensor, count: int) -> Tensor:
    """Return the mask of the cheapest entry of each owner; ties are broken by a hash."""
    least = cost.new_full((count,), torch.inf).scatter_reduce_(0, owner, cost, "amin")
    number = torch.where(cost == least[owner], _hash(torch.arange(len(owner), device=owner.device)), _RANGE)
    return number == torch.full((count,), _RANGE, device=owner.device).scatter_reduce_(0, owner, number, "amin")[owner]


def _hash(number: Tensor) -> Tensor:
    """Return pseudo-random integers below 2^32; the map is one-to-one below 2^32."""
    for _ in range(2):
        number = (number * _SHUFFLE) % _RANGE
        number = number ^ (number >> 15)
    return number

"""Depth, albedo and lighting that explain an image and low-resolution depth: the energy and its minimisation.

Haefner et al., CVPR 2018 (see :mod:`dsr.methods.classical.shape_from_shading`) minimise

    E = 1/2 sum |albedo * shading(z, grad z) - rgb|^2 + data / 2 * sum |mean z - lr|^2
        + area * sum z |m| + boundary * (length of the albedo's boundaries),

with z in pixels here (multiplied by the focal length, divided by the typical depth), so that slopes have no unit. With
a copy theta of (grad z, z) for the nonlinear terms, and the scaled multiplier u, the augmented Lagrangian is E with
theta in place of (grad z, z) except in the data term, plus

    penalty / 2 * (|(grad z, z) + u - theta|^2 - |u|^2).

Each ``update_`` method does not increase it, and changes one variable: the albedo by region fusion, the lighting by
least squares, theta pixel by pixel by Levenberg and Marquardt's method, z by conjugate gradients.

*The image formation model* is Lambertian shading under first-order spherical harmonics lighting: in each channel

    rgb = albedo * (l_1 n_x + l_2 n_y + l_3 n_z + l_4),    n = m / |m|,    m = (p, q, -z - x p - y q),

with the depth z, its slopes p = fx dz/du and q = fy dz/dv, and the ray (x, y, 1) of the pixel. m is the normal that
faces the camera, and its length gives the surface element: a pixel sees the area z |m| / (fx fy), whose sum is the
prior on the shape. z may be any multiple of depth in metres: m scales with it, n does not.

Shapes are (B, 3, H, W) for (p, q, z), called theta as in the paper, and for normals; (B, C, H, W) for photos and
albedos; (B, C, 4) for lighting.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from dsr.geometry.surface import length
from dsr.methods.classical.potts import Regions, boundary_length, fit_albedo, fuse
from dsr.methods.images import box_mean, repeat_blocks

_TINY = 1e-12  # minimum length of m, which avoids division by 0

_CG_ITERATIONS, _CG_TOLERANCE = 60, 1e-6
_INNER = 3  # Levenberg-Marquardt steps in an update of theta
_LESS, _MORE = 0.2, 5.0  # factors of its damping after a step that lowers the energy, and after one that does not


class Surface(NamedTuple):
    """Normals (B, 3, H, W) and the length of m before normalising, (B, 1, H, W)."""

    normals: Tensor
    length: Tensor


class Photometry(NamedTuple):
    """The photometric residual, (B, C, H, W), and its derivatives by theta, (B, C, 3, H, W)."""

    residual: Tensor
    slopes: Tensor


def compute_surface(theta: Tensor, rays: Tensor) -> Surface:
    """Return the normals, and the lengths of m, of theta (B, 3, H, W) and rays (1, 3, H, W)."""
    p, q, z = theta.split(1, dim=1)
    m = torch.cat((p, q, -z - rays[:, :1] * p - rays[:, 1:2] * q), dim=1)
    size = length(m).clamp(min=_TINY)
    return Surface(m / size, size)


def compute_shading(normals: Tensor, lighting: Tensor) -> Tensor:
    """Return the shading, (B, C, H, W)."""
    return torch.einsum("bck,bkhw->bchw", lighting[..., :3], normals) + lighting[..., 3, None, None]


def linearise_photometry(rgb: Tensor, albedo: Tensor, lighting: Tensor, surface: Surface, rays: Tensor) -> Photometry:
    """Return albedo * shading - rgb and its derivatives: albedo (l - (l . n) n) / |m| times those of m."""
    n = surface.normals
    directed = torch.einsum("bck,bkhw->bchw", lighting[..., :3], n)
    across = (lighting[..., :3, None, None] - directed[:, :, None] * n[:, None]) * (albedo / surface.length)[:, :, None]
    residual = albedo * (directed + lighting[..., 3, None, None]) - rgb
    return Photometry(residual, chain_to_theta(across, rays))


def chain_to_theta(by_m: Tensor, rays: Tensor) -> Tensor:
    """Convert derivatives by m to derivatives by theta, (..., 3, H, W)."""
    x, y = rays[0, 0], rays[0, 1]
    along_u, along_v, ahead = by_m.unbind(dim=-3)
    return torch.stack((along_u - x * ahead, along_v - y * ahead, -ahead), dim=-3)


def compute_area(theta: Tensor, surface: Surface) -> Tensor:
    """Return z |m|, (B, 1, H, W): fx fy times the surface area that a pixel sees."""
    return theta[:, 2:].abs() * surface.length


def fit_lighting(rgb: Tensor, albedo: Tensor, normals: Tensor, inside: Tensor) -> Tensor:
    """Return the lighting with the least squared error in each channel, (B, C, 4) float64.

    If the normals do not determine it, as on a plane, it is the one of minimum norm. ``inside`` weights the pixels.
    """
    ones = torch.ones_like(normals[:, :1])
    design = (torch.cat((normals, ones), dim=1) * inside)[:, None] * albedo[:, :, None]  # (B, C, 4, H, W)
    columns = design.flatten(3).double()
    gram = columns @ columns.mT
    right = columns @ (rgb * inside).flatten(2).double()[..., None]
    return (torch.linalg.pinv(gram, hermitian=True, rtol=_RANK) @ right)[..., 0]


_RANK = 1e-10  # relative cutoff of singular values, below which a direction of the light is not determined


class Weights(NamedTuple):
    """Weights of the terms of E: low-resolution map, area, and boundaries of the albedo."""

    data: float
    area: float
    boundary: float


class ShadingProblem(NamedTuple):
    """The constants of the problem.

    ``rgb`` (B, C, H, W); ``lr`` (B, 1, h, w) in the unit of z, NaN in holes; ``rays`` (1, 3, H, W) and
    ``focal`` (fx, fy) of the photo's camera, ``unit`` by which z is more than depth of about 1; ``inside``
    (B, 1, H, W) bool, the pixels that may change.
    """

    rgb: Tensor
    lr: Tensor
    rays: Tensor
    focal: tuple[float, float]
    unit: float
    inside: Tensor

    @property
    def scale(self) -> int:
        """The upsampling factor."""
        return self.rgb.shape[-1] // self.lr.shape[-1]


class Slopes:
    """The linear operator z -> (fx dz/du, fy dz/dv, z) / unit, and its adjoint.

    Differences are forward between pixels inside the mask, backward where there is no next pixel, and 0 where there is
    neither. Without a mask, these are the differences that :func:`dsr.geometry.surface.depth_to_normals` takes.
    """

    def __init__(self, problem: ShadingProblem) -> None:
        inside = problem.inside
        self._factors = [focal / problem.unit for focal in problem.focal]
        self._unit = problem.unit
        self._forward, self._backward = [], []
        for dim in (-1, -2):
            size = inside.shape[dim]
            both = inside.narrow(dim, 0, size - 1) & inside.narrow(dim, 1, size - 1)
            none = torch.zeros_like(inside.narrow(dim, 0, 1))
            ahead, behind = torch.cat((both, none), dim), torch.cat((none, both), dim)
            self._forward.append(ahead.to(problem.rgb))
            self._backward.append((behind & ~ahead).to(problem.rgb))

    def __call__(self, z: Tensor) -> Tensor:
        """Return theta of z, (B, 1, H, W) -> (B, 3, H, W)."""
        found = []
        for dim, factor, forward, backward in zip((-1, -2), self._factors, self._forward, self._backward, strict=True):
            step = z.diff(dim=dim)
            none = torch.zeros_like(z.narrow(dim, 0, 1))
            found.append(factor * (forward * torch.cat((step, none), dim) + backward * torch.cat((none, step), dim)))
        return torch.cat((*found, z / self._unit), dim=1)

    def adjoint(self, theta: Tensor) -> Tensor:
        """Apply the adjoint, (B, 3, H, W) -> (B, 1, H, W): <theta of z, theta> = <z, what is returned>."""
        total = theta[:, 2:] / self._unit
        pairs = zip((-1, -2), self._factors, self._forward, self._backward, theta[:, :2].split(1, dim=1), strict=True)
        for dim, factor, forward, backward, slope in pairs:
            size = slope.shape[dim]
            ahead, behind = forward * slope, backward * slope
            step = factor * (ahead.narrow(dim, 0, size - 1) + behind.narrow(dim, 1, size - 1))
            none = torch.zeros_like(total.narrow(dim, 0, 1))
            total = total + torch.cat((none, step), dim) - torch.cat((step, none), dim)
        return total


class ShadingSolver:
    """The variables of a problem, and their updates.

    ``first`` is the initial z, (B, 1, H, W), which stays unchanged outside the mask; ``missed`` is u.
    """

    def __init__(self, problem: ShadingProblem, weights: Weights, first: Tensor, penalty: float) -> None:
        self.problem, self.weights, self.penalty = problem, weights, penalty
        self.slopes = Slopes(problem)
        self._weight = problem.inside.to(problem.rgb)
        self._valid = problem.lr.isfinite()
        self._lr = torch.where(self._valid, problem.lr, 0)
        coupling = problem.rgb.new_tensor((1.0, 1.0, (problem.unit / problem.scale) ** 2))
        self._coupling = coupling[:, None, None] * self._weight
        self.z, self.theta = first, self.slopes(first)
        self.missed = torch.zeros_like(self.theta)
        self.albedo = problem.rgb
        self.lighting = problem.rgb.new_tensor((0.0, 0.0, -1.0, 0.0)).expand(*problem.rgb.shape[:2], 4)
        self.regions: Regions | None = None
        self._damping = torch.full_like(first, 1e-3)

    def update_albedo(self, *, anew: bool = True) -> None:
        """Set the best piecewise constant albedo, in new regions if these are better than the old ones.

        Before the first call, the albedo is the image itself.
        """
        rgb, inside = self.problem.rgb, self.problem.inside
        shading = compute_shading(compute_surface(self.theta, self.problem.rays).normals, self.lighting)
        found = []
        if self.regions is not None:
            found.append(self.regions)
        if anew or not found:
            found.append(fuse(rgb, shading, self.weights.boundary, inside))
        tried = [(fit_albedo(rgb, shading, regions), regions) for regions in found]
        energies = [self._shading_energy(albedo, shading) + self._boundaries(regions) for albedo, regions in tried]
        self.albedo, self.regions = tried[energies.index(min(energies))]

    def update_lighting(self) -> None:
        """Set the best lighting."""
        normals = compute_surface(self.theta, self.problem.rays).normals
        lighting = fit_lighting(self.problem.rgb, self.albedo, normals, self._weight)
        self.lighting = lighting.to(self.problem.rgb)

    def update_theta(self) -> None:
        """Lower the Lagrangian in theta, pixel by pixel."""
        target = self.slopes(self.z) + self.missed
        theta, damping = self.theta, self._damping
        energy = self._pixel_energy(theta, target)
        for _ in range(_INNER):
            near = theta - _solve(*self._quadratic(theta, target), damping)
            lower = self._pixel_energy(near, target)
            better = lower < energy
            theta, energy = torch.where(better, near, theta), torch.where(better, lower, energy)
            damping = (damping * torch.where(better, _LESS, _MORE)).clamp(1e-6, 1e6)
        self.theta, self._damping = theta, damping

    def update_depth(self) -> None:
        """Lower the Lagrangian, which is quadratic in z, by conjugate gradients from the current z."""
        weight = self._weight
        wanted = self.theta - self.missed
        rest = self._lr - self._block_means(self.z)
        right = weight * (
            self.weights.data * self._block_means_adjoint(rest)
            + self.penalty * self.slopes.adjoint(self._coupling * (wanted - self.slopes(self.z)))
        )
        found = conjugate_gradients(
            self.normal_operator, right, torch.zeros_like(right), iterations=_CG_ITERATIONS, tolerance=_CG_TOLERANCE
        )
        self.z = self.z + found.values

    def update_missed(self, growth: float) -> None:
        """Add (grad z, z) - theta to the multiplier, and multiply the penalty."""
        self.missed = (self.missed + self.slopes(self.z) - self.theta) / growth
        self.penalty *= growth

    def normal_operator(self, z: Tensor) -> Tensor:
        """Return the second derivative of the Lagrangian in z, times z; 0 outside the mask."""
        inside = self._weight * z
        own = self.penalty * self.slopes.adjoint(self._coupling * self.slopes(inside))
        return self._weight * (own + self.weights.data * self._block_means_adjoint(self._block_means(inside)))

    def lagrangian(self) -> float:
        """Return the augmented Lagrangian."""
        miss = self.slopes(self.z) + self.missed - self.theta
        bound = 0.5 * self.penalty * float((self._coupling * (miss.square() - self.missed.square())).sum())
        return sum(self.terms(self.theta).values()) + bound

    def terms(self, theta: Tensor | None = None) -> dict[str, float]:
        """Return the terms ``shading``, ``data``, ``area`` and ``boundaries`` of E; None for (grad z, z)."""
        theta = self.slopes(self.z) if theta is None else theta
        surface = compute_surface(theta, self.problem.rays)
        return {
            "shading": self._shading_energy(self.albedo, compute_shading(surface.normals, self.lighting)),
            "data": 0.5 * self.weights.data * float((self._lr - self._block_means(self.z)).square().sum()),
            "area": self.weights.area * float((self._weight * compute_area(theta, surface)).sum()),
            "boundaries": 0.0 if self.regions is None else self._boundaries(self.regions),
        }

    def _block_means(self, z: Tensor) -> Tensor:
        return torch.where(self._valid, box_mean(z, self.problem.scale), 0)

    def _block_means_adjoint(self, lr: Tensor) -> Tensor:
        """Return the adjoint of the means."""
        return repeat_blocks(lr, self.problem.scale) / self.problem.scale**2

    def _shading_energy(self, albedo: Tensor, shading: Tensor) -> float:
        return 0.5 * float((self._weight * (albedo * shading - self.problem.rgb).square()).sum())

    def _boundaries(self, regions: Regions) -> float:
        return self.weights.boundary * boundary_length(regions, self.problem.inside)

    def _pixel_energy(self, theta: Tensor, target: Tensor) -> Tensor:
        """Return the Lagrangian of theta in each pixel, (B, 1, H, W)."""
        surface = compute_surface(theta, self.problem.rays)
        missed = self.albedo * compute_shading(surface.normals, self.lighting) - self.problem.rgb
        own = 0.5 * missed.square().sum(dim=1, keepdim=True) + self.weights.area * compute_area(theta, surface)
        bound = 0.5 * self.penalty * (self._coupling * (theta - target).square()).sum(dim=1, keepdim=True)
        return self._weight * own + bound

    def _quadratic(self, theta: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Return gradient (B, 3, H, W) and an approximate Hessian (B, 6, H, W): its upper triangle, row by row."""
        problem, weights = self.problem, self.weights
        surface = compute_surface(theta, problem.rays)
        n = surface.normals
        seen = linearise_photometry(problem.rgb, self.albedo, self.lighting, surface, problem.rays)
        gradient = (seen.residual[:, :, None] * seen.slopes).sum(dim=1)
        depth = theta[:, 2:]
        size = chain_to_theta(n, problem.rays)  # the derivative of |m|
        gradient = gradient + weights.area * depth.abs() * size
        gradient[:, 2:] += weights.area * depth.sign() * surface.length
        curved = weights.area * depth.abs() / surface.length
        x, y = problem.rays[:, :1], problem.rays[:, 1:2]
        products: dict[tuple[int, int], Tensor | float] = {
            (0, 0): 1 + x * x,
            (0, 1): x * y,
            (0, 2): x,
            (1, 1): 1 + y * y,
            (1, 2): y,
            (2, 2): 1.0,
        }
        triangle = []
        for (i, j), product in products.items():
            shaded = (seen.slopes[:, :, i] * seen.slopes[:, :, j]).sum(dim=1, keepdim=True)
            triangle.append(shaded + curved * (product - size[:, i : i + 1] * size[:, j : j + 1]))
        hessian = torch.cat(triangle, dim=1) * self._weight
        hessian[:, [0, 3, 5]] += self.penalty * self._coupling
        return gradient * self._weight + self.penalty * self._coupling * (theta - target), hessian


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


class Solution(NamedTuple):
    """The solution ``values`` (B, ...), the number of steps, and the largest |b - A x| / |b| in the batch."""

    values: Tensor
    iterations: int
    residual: float


def conjugate_gradients(
    operator: Callable[[Tensor], Tensor], right: Tensor, start: Tensor, *, iterations: int, tolerance: float
) -> Solution:
    """Solve A x = b for each element of a batch, (B, ...), from a start.

    The operator x -> A x is symmetric positive definite for each element, on the subspace that b - A start lies in, and
    does not mix elements. It stops at the relative residual ``tolerance`` in all elements.
    """

    def dot(a: Tensor, b: Tensor) -> Tensor:  # (B, 1, ...)
        return (a * b).sum(dim=tuple(range(1, a.ndim)), keepdim=True)

    def ratio(above: Tensor, below: Tensor) -> Tensor:  # 0 where ``below`` is: a solved element stays
        return torch.where(below > 0, above / torch.where(below > 0, below, 1), 0)

    x, residual = start, right - operator(start)
    direction = residual
    size, goal = dot(residual, residual), tolerance**2 * dot(right, right)
    done = 0
    while done < iterations and bool((size > goal).any()):
        image = operator(direction)
        step = ratio(size, dot(direction, image))
        x = x + step * direction
        residual = residual - step * image
        before, size = size, dot(residual, residual)
        direction = residual + ratio(size, before) * direction
        done += 1
    return Solution(x, done, float(ratio(size, dot(right, right)).max().sqrt()))

"""The shading loss of DDRNet: a photo against the shading of a surface under the light that explains it.

Yan et al., *DDRNet*, ECCV 2018. A Lambertian surface with albedo R and normals n, under distant light, has the
intensity B = R sum over b of l_b H_b(n), where the H_b are the nine spherical harmonics up to the second degree
(Ramamoorthi and Hanrahan, *An Efficient Representation for Irradiance Environment Maps*, SIGGRAPH 2001). The l_b of a
photo are found by least squares with the normals of the reference depth; the loss is the mean squared difference of the
photo's intensity and B with the normals of the result, clipped to [0, 1].

The albedo comes from the photo alone, by the Retinex algorithm: steep changes of the logarithmic image are changes of
the albedo, and the others of the shading (Grosse et al., *Ground Truth Dataset and Baseline Evaluations for Intrinsic
Image Algorithms*, ICCV 2009). DDRNet's authors compute it in advance, for which they recommend Retinex.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dsr.methods.classical.finite_differences import grey
from dsr.methods.networks.dct import dct2, idct2, laplacian_eigenvalues
from dsr.metrics.functional import SurfacePair
from dsr.utils.compute_device import in_own_precision

_RIDGE = 1e-4
"""Weight of the squared coefficients of the light, as in the authors' code; the errors' weight is one per pixel."""
_LARGEST_ALBEDO = 2.0  # albedos have a mean of 1 and are clipped to this, as in the authors' code
_DARKEST = 1 / 255
_GREY_STEP, _COLOUR_STEP = 0.1, 0.05
"""Changes of the logarithm of intensity and of colour per pixel, from which on they are changes of the albedo."""


@in_own_precision
def shading_loss(pair: SurfacePair, rgb: Tensor) -> Tensor:
    """Return the shading loss of each image, (B,); NaN without a valid normal.

    Args:
        pair: the depth, and the reference depth that the light is estimated with.
        rgb: (B, 3, H, W) photos in [0, 1].

    """
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
    """Return the coefficients l_b of the light that explains each photo best, (B, 9).

    Args:
        normals: (B, 3, H, W) unit vectors.
        intensity: (B, 1, H, W) the photos.
        albedo: (B, 1, H, W).
        valid: (B, 1, H, W) bool, the pixels to explain.

    """
    # In 64 bits: of nearly flat surfaces the equations are so badly conditioned that 32 leave nothing but rounding.
    basis = torch.where(valid, albedo * harmonics(normals), 0).flatten(2).double()
    squares = basis @ basis.transpose(1, 2)
    squares = squares + _RIDGE * torch.eye(9, dtype=basis.dtype, device=basis.device)
    return torch.linalg.solve(squares, basis @ intensity.flatten(2).transpose(1, 2).double())[..., 0].to(normals)


def estimate_albedo(rgb: Tensor) -> Tensor:
    """Return the albedo of photos by the Retinex algorithm, (B, 1, H, W), with a mean of 1 before it is clipped to 2.

    Its logarithm has the gradient of the photo's logarithm where that is an edge of intensity or of colour, and else
    none, as well as least squares allow (a Poisson equation with free borders).

    Args:
        rgb: (B, 3, H, W) in [0, 1].

    """
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
    """Return the maps with a mean of 0 whose differences between neighbours are nearest to those given, (B, 1, H, W).

    The normal equations are a Poisson equation with Neumann borders, which the discrete cosine transform diagonalises.

    Args:
        along_u: (B, 1, H, W - 1) differences along the rows.
        along_v: (B, 1, H - 1, W) differences along the columns.

    """
    zeros_u, zeros_v = torch.zeros_like(along_u[..., :1]), torch.zeros_like(along_v[..., :1, :])
    divergence = torch.cat((along_u, zeros_u), dim=-1) - torch.cat((zeros_u, along_u), dim=-1)
    divergence = divergence + torch.cat((along_v, zeros_v), dim=-2) - torch.cat((zeros_v, along_v), dim=-2)
    height, width = divergence.shape[-2:]
    eigenvalues = laplacian_eigenvalues(height, width, divergence)
    eigenvalues[0, 0] = torch.inf  # the mean is free
    return idct2(dct2(divergence) / eigenvalues)

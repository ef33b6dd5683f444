"""Test-time augmentation: dihedral transforms and the average over them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from dsr.geometry.camera import Camera, from_range, to_range
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.network import ENSEMBLES, DisparityNetwork, NetworkUpsampler, apply_dihedral, undo_dihedral
from dsr.sample import DepthSample


class _Leaning(DisparityNetwork):
    """Repeats the low-resolution pixels and adds a ramp to the right and an arc from top to bottom."""

    scale = 2

    def arguments(self) -> dict[str, Any]:
        return {}

    def upsample(self, rgb: Tensor, disparity: Tensor, min_max: Tensor | None = None) -> Tensor:
        ramp = torch.linspace(-1, 1, rgb.shape[-1], dtype=disparity.dtype)
        arc = torch.linspace(-1, 1, rgb.shape[-2], dtype=disparity.dtype)[:, None] ** 2
        return functional.interpolate(disparity, scale_factor=2, mode="nearest") + ramp + arc


def _sample(height: int = 6, width: int = 8) -> DepthSample:
    camera = Camera(2 * width, 2 * height, 600.0, 600.0, 3.0, 4.0, baseline=0.2)
    coarse = camera.rescale(width, height)
    generator = torch.Generator().manual_seed(1)
    disparity = 20 + torch.rand((1, height, width), generator=generator, dtype=torch.float64)
    rgb = torch.rand((3, 2 * height, 2 * width), generator=generator)
    return DepthSample("test", "scene", rgb, from_range(disparity / 2, coarse, "disparity"), camera, coarse, 2)


@pytest.mark.parametrize("index", range(8))
def test_dihedral_transforms_are_distinct_and_invertible(index: int) -> None:
    x = torch.rand(2, 3, 5, 5)
    torch.testing.assert_close(undo_dihedral(apply_dihedral(x, index), index), x, rtol=0, atol=0)
    assert not any(
        torch.equal(apply_dihedral(x, index), apply_dihedral(x, other)) for other in range(8) if other != index
    )


def test_augmentation_averages_what_depends_on_the_orientation() -> None:
    sample = _sample()
    coarse = to_range(sample.depth_lr, sample.camera_lr, "disparity") * 2
    plain = functional.interpolate(coarse[None], scale_factor=2, mode="nearest")[0]
    height, width = plain.shape[-2:]
    down, right = (torch.linspace(-1, 1, n, dtype=torch.float64) for n in (height, width))
    leaning = plain + right + down[:, None] ** 2
    even = plain + (right**2 + down[:, None] ** 2) / 2  # the ramps cancel out, the arcs turn
    for ensemble, expected in zip(ENSEMBLES, (leaning, even, even), strict=True):
        depth = NetworkUpsampler(_Leaning(), ensemble=ensemble)(sample)
        torch.testing.assert_close(to_range(depth, sample.camera, "disparity"), expected)


def test_augmentation_is_equivariant_to_turns() -> None:
    torch.manual_seed(0)
    method = NetworkUpsampler(MSGNet(2, "dsr"), ensemble=4)
    sample = _sample()
    rgb, coarse = sample.rgb[None], to_range(sample.depth_lr, sample.camera_lr, "disparity")[None]
    single = method.net.upsample(apply_dihedral(rgb, 1), apply_dihedral(coarse, 1)) - apply_dihedral(
        method.net.upsample(rgb, coarse), 1
    )
    assert float(single.abs().max()) > 1e-3
    both = [
        method.upsample_disparity(apply_dihedral(rgb, 1), apply_dihedral(coarse, 1)),
        apply_dihedral(method.upsample_disparity(rgb, coarse), 1),
    ]
    torch.testing.assert_close(both[0], both[1], rtol=0, atol=1e-6)


def test_invalid_augmentation_is_refused() -> None:
    with pytest.raises(ValueError, match="ensemble: expected one of 1, 4, 8, got 2"):
        NetworkUpsampler(MSGNet(2, "dsr"), ensemble=2)
    with pytest.raises(ValueError, match="ensemble: expected 1 for a network that leaves out pixels, got 4"):
        NetworkUpsampler(MSGNet(2, "hui"), ensemble=4)

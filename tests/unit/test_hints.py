"""Hints: facts as numbers, and the noise of a map around each pixel."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from dsr.degradation.hints import FACTS, KERNELS, encode_facts, local_noise


def _plane(height: int, width: int) -> Tensor:
    """Return inverse depth from 0.5 to 0.6 across an image, (1, 1, height, width)."""
    across = (torch.arange(width, dtype=torch.float64) + 0.5) / width
    return (0.5 + 0.1 * across).expand(1, 1, height, width).contiguous()


def test_each_fact_has_a_place_of_its_own() -> None:
    assert not bool(encode_facts().any())
    reported = [encode_facts(kernel) for kernel in KERNELS]
    reported += [encode_facts(soft=soft) for soft in (False, True)] + [encode_facts(noise=True)]
    assert torch.equal(torch.stack(reported), torch.eye(FACTS))
    assert torch.equal(encode_facts("bicubic", soft=True, noise=True), reported[3] + reported[6] + reported[7])
    with pytest.raises(ValueError, match=r"kernel: expected one of box, nearest, .*, got sinc"):
        encode_facts("sinc")


def test_local_noise_ignores_holes_and_outliers() -> None:
    truth = _plane(48, 64)
    given = functional.avg_pool2d(truth, 4)
    error = 0.002 * torch.ones_like(given)
    error[..., 8:] = 0.02
    given = given * (1 + error)
    given[..., 2, 2], given[..., 5, 3] = torch.nan, 5.0
    noise = local_noise(given, truth)
    assert bool(noise.isfinite().all())
    torch.testing.assert_close(noise[..., 0], torch.full_like(noise[..., 0], 0.002), rtol=1e-3, atol=0)
    torch.testing.assert_close(noise[..., -1], torch.full_like(noise[..., -1], 0.02), rtol=1e-3, atol=0)

"""Expected errors of methods that say none."""

from __future__ import annotations

import torch

from dsr.geometry.camera import Camera
from dsr.inference.plausibility import expect_errors

CAMERA = Camera.from_fov(60, 96, 64)


def _plane(height: int, width: int) -> torch.Tensor:
    """Return inverse depth of a slanted plane, (1, height, width)."""
    across = (torch.arange(width) + 0.5) / width
    return (0.5 + 0.1 * across).expand(1, height, width).clone()


def test_a_plane_that_agrees_with_its_input_has_next_to_no_errors() -> None:
    spread, angle = expect_errors(_plane(64, 96), _plane(16, 24), CAMERA)
    assert spread.shape == angle.shape == (1, 64, 96)
    inside = (..., slice(20, -20), slice(20, -20))
    assert float(spread[inside].max()) < 1e-5
    assert float(angle[inside].max()) < 0.1


def test_copied_noise_is_expected_to_be_wrong() -> None:
    noise = 0.01 * torch.randn(1, 16, 24, generator=torch.Generator().manual_seed(0))
    given = _plane(16, 24) * (1 + noise)
    copied = given.repeat_interleave(4, -1).repeat_interleave(4, -2)
    rough, tilted = expect_errors(copied, given, CAMERA)
    smooth, flat = expect_errors(_plane(64, 96), given, CAMERA)
    assert 0.003 < float(rough.mean()) < 0.015
    assert float(smooth.mean()) < 0.7 * float(rough.mean())
    assert float(flat.mean()) < 0.7 * float(tilted.mean())


def test_errors_are_larger_at_steps_and_grow_into_holes() -> None:
    given = _plane(16, 24)
    given[..., 12:] *= 2
    given[:, 4:12, 2:8] = torch.nan
    result = _plane(64, 96)
    result[..., 48:] *= 2
    spread, angle = expect_errors(result, given, CAMERA)
    assert float(spread[0, 60, 48]) > 10 * float(spread[0, 60, 80])
    row = spread[0, 32, 8:17]
    assert bool((row.diff() > 0).all())
    assert float(row[0]) > 0.02
    assert float(angle[0, 32, 20]) >= 45
    assert float(angle[0, 32, 80]) < 1

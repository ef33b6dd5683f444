"""Filling of holes before networks: from outside in, and up to the photo's edges."""

from __future__ import annotations

import pytest
import torch

from dsr.methods.images import inpaint


def _two_surfaces(height: int = 24, width: int = 32) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a map of two surfaces that meet in a slanted line, (1, 1, h, w), and a photo of four times the size."""
    rows, columns = torch.meshgrid(torch.arange(4.0 * height), torch.arange(4.0 * width), indexing="ij")
    left = columns < 40 + 0.5 * rows
    photo = torch.where(
        left, torch.tensor([0.7, 0.3, 0.2])[:, None, None], torch.tensor([0.2, 0.3, 0.5])[:, None, None]
    )
    fine = torch.where(left, 1.0, 0.5)[None, None]
    return torch.nn.functional.interpolate(fine, (height, width), mode="nearest"), photo[None]


@pytest.mark.parametrize("guided", [False, True])
def test_known_values_stay_and_others_lie_between_them(guided: bool) -> None:
    truth, photo = _two_surfaces()
    holes = torch.rand(truth.shape, generator=torch.Generator().manual_seed(0)) < 0.6
    filled = inpaint(truth.masked_fill(holes, torch.nan), photo if guided else None)
    assert torch.equal(filled[~holes], truth[~holes])
    assert bool(((filled >= 0.5) & (filled <= 1)).all())


def test_holes_are_filled_up_to_the_edges_of_the_photo() -> None:
    truth, photo = _two_surfaces()
    given = truth.clone()
    given[..., 6:18, 6:26] = torch.nan
    guided, plain = inpaint(given, photo), inpaint(given)
    wrong = [float(((each - truth).abs() > 0.05).float().mean()) for each in (guided, plain)]
    assert wrong[0] < 0.03
    assert wrong[1] > 0.05


def test_each_image_has_its_photo_and_one_without_values_stays_as_it_is() -> None:
    truth, photo = _two_surfaces()
    given = truth.clone()
    given[..., 6:18, 6:26] = torch.nan
    nothing = torch.full_like(truth, torch.nan)
    both = inpaint(torch.cat((given, given, nothing)), torch.cat((photo, photo.flip(1), photo)))
    assert torch.equal(both[:1], inpaint(given, photo))
    assert torch.equal(both[1:2], inpaint(given, photo.flip(1)))
    assert bool(both[2].isnan().all())


def test_without_contrast_the_mean_of_the_surroundings_is_taken() -> None:
    given = torch.full((1, 1, 9, 9), 2.0)
    given[..., 4, 4] = torch.nan
    given[..., 3, 3] = 4.0
    filled = inpaint(given, torch.full((1, 3, 36, 36), 0.5))
    assert float(filled[0, 0, 4, 4]) == pytest.approx((7 * 2 + 4) / 8)

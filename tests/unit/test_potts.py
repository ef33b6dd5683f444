"""The Potts problem: closed forms, and all partitions of small pictures tried."""

import itertools

import numpy as np
import pytest
import torch
from torch import Tensor

from dsr.methods.classical.potts import Regions, boundary_length, fit_albedo, fuse


def _everywhere(rgb: Tensor) -> Tensor:
    return torch.ones_like(rgb[:, :1], dtype=torch.bool)


def _energy(rgb: Tensor, shading: Tensor, regions: Regions, weight: float) -> float:
    missed = fit_albedo(rgb, shading, regions) * shading - rgb
    return 0.5 * float(missed.square().sum()) + weight * boundary_length(regions, _everywhere(rgb))


def _two(size: int = 24, noise: float = 0.03) -> tuple[Tensor, Tensor, Tensor]:
    """Return a photo of a disc before a wall under uneven light, its shading, and the disc."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:size, :size]
    disc = torch.from_numpy((u - 11) ** 2 + (v - 13) ** 2 < 50)
    albedo = torch.where(
        disc, torch.tensor([0.8, 0.3, 0.5])[:, None, None], torch.tensor([0.4, 0.6, 0.5])[:, None, None]
    )
    shading = torch.from_numpy(0.5 + 0.4 * u / size + 0.1 * np.sin(v)).expand(1, 3, size, size)
    rgb = albedo[None] * shading + noise * torch.from_numpy(rng.normal(size=(1, 3, size, size)))
    return rgb, shading, disc


def test_two_regions_under_noise_are_found_exactly() -> None:
    rgb, shading, disc = _two()
    regions = fuse(rgb, shading, 0.05, _everywhere(rgb))
    assert regions.number == 2
    assert torch.equal(regions.labels[0] == regions.labels[0, 13, 11], disc)


def test_albedo_of_a_region_is_the_least_squares_one() -> None:
    rgb, shading, disc = _two()
    albedo = fit_albedo(rgb, shading, fuse(rgb, shading, 0.05, _everywhere(rgb)))
    for channel in range(3):
        for where in (disc, ~disc):
            expected = np.linalg.lstsq(
                shading[0, channel][where].numpy()[:, None], rgb[0, channel][where].numpy(), rcond=None
            )[0]
            torch.testing.assert_close(albedo[0, channel][where], torch.full((int(where.sum()),), expected[0]).double())


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("weight", [0.001, 0.02, 0.5])
def test_partitions_that_fuse_two_regions_have_no_less_energy(seed: int, weight: float) -> None:
    rng = np.random.default_rng(seed)
    rgb, shading = (torch.from_numpy(rng.uniform(0.2, 1, (1, 2, 4, 5))) for _ in range(2))
    regions = fuse(rgb, shading, weight, _everywhere(rgb))
    least = _energy(rgb, shading, regions, weight)
    for one, other in itertools.combinations(range(regions.number), 2):
        labels = torch.where(regions.labels == other, one, regions.labels)
        assert _energy(rgb, shading, Regions(labels, regions.number), weight) >= least - 1e-12


def test_row_of_pixels_is_cut_as_by_an_exhaustive_search() -> None:
    values = torch.tensor([0.2, 0.22, 0.21, 0.6, 0.62, 0.9, 0.88, 0.91]).double()
    rgb = values.reshape(1, 1, 1, 8)
    shading = torch.ones_like(rgb)
    best = min(
        (torch.tensor([0, *np.cumsum(cuts)]) for cuts in itertools.product((0, 1), repeat=7)),
        key=lambda labels: _energy(rgb, shading, Regions(labels.reshape(1, 1, 8), 8), 0.02),
    )
    assert torch.equal(fuse(rgb, shading, 0.02, _everywhere(rgb)).labels.reshape(-1), best)


def test_batch_equals_its_pictures_one_at_a_time() -> None:
    rgb, shading, _ = _two()
    rgb, shading = torch.cat((rgb, rgb.flip(-1))), torch.cat((shading, shading.flip(-1)))
    together = fit_albedo(rgb, shading, fuse(rgb, shading, 0.05, _everywhere(rgb)))
    assert torch.equal(together, fit_albedo(rgb, shading, fuse(rgb, shading, 0.05, _everywhere(rgb))))
    for number in range(2):
        one = rgb[number : number + 1], shading[number : number + 1]
        torch.testing.assert_close(together[number], fit_albedo(*one, fuse(*one, 0.05, _everywhere(one[0])))[0])


def test_pixels_outside_stay_alone_and_separate_the_inside() -> None:
    rgb = torch.full((1, 1, 3, 5), 0.5).double()
    inside = torch.ones(1, 1, 3, 5, dtype=torch.bool)
    inside[..., 2] = False
    regions = fuse(rgb, torch.ones_like(rgb), 0.1, inside)
    assert regions.number == 2 + 3
    assert boundary_length(regions, inside) == 0

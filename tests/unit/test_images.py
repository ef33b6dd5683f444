"""Operations on images and maps that methods share: values, sizes, holes and noise."""

import math

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.surface import depth_to_normals
from dsr.methods.images import (
    estimate_noise,
    estimate_sensor_noise,
    inpaint,
    mean3x3,
    normal_noise_deg,
    normalise,
    upsample_bicubic,
)


def test_3x3_mean_equals_scipy_with_mirrored_borders() -> None:
    x = torch.rand(2, 1, 5, 7, dtype=torch.float64)
    expected = [ndimage.convolve(image, np.full((3, 3), 1 / 9), mode="reflect") for image in x[:, 0].numpy()]
    torch.testing.assert_close(mean3x3(x)[:, 0], torch.from_numpy(np.stack(expected)))


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_bicubic_upsampling_equals_pillow_on_a_float_image(scale: int) -> None:
    image = np.random.default_rng(0).random((6, 9), dtype=np.float32)
    expected = np.asarray(Image.fromarray(image).resize((9 * scale, 6 * scale), Image.Resampling.BICUBIC))
    ours = upsample_bicubic(torch.from_numpy(image)[None, None], scale)[0, 0]
    torch.testing.assert_close(ours, torch.from_numpy(expected.copy()), rtol=0, atol=1e-6)


def test_normalisation_is_per_sample_over_finite_values_and_holes_become_0() -> None:
    x = torch.tensor([[2.0, torch.nan, 6.0], [3.0, torch.inf, 4.0]])[:, None, None]
    values, minimum, span = normalise(x)
    assert values[:, 0, 0].tolist() == [[0, 0, 1], [0, 0, 1]]
    assert (minimum.flatten().tolist(), span.flatten().tolist()) == ([2, 3], [4, 1])


def _two_surfaces(height: int = 24, width: int = 32) -> tuple[Tensor, Tensor]:
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


def _ramp() -> Tensor:
    rows, columns = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    return (2 + 0.01 * rows + 0.005 * columns).double()[None, None]


def _draws() -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.randn(1, 1, 120, 160, generator=generator, dtype=torch.float64)


def test_white_noise_is_estimated_with_steps_and_holes() -> None:
    values = _ramp() + 0.01 * _draws()
    values[..., 80:] += 3
    values[..., 20:40, 30:60] = torch.nan
    assert estimate_sensor_noise(values) == pytest.approx(0.01, rel=0.1)


def test_noise_of_rounded_values_is_found() -> None:
    values = ((3 + 0.005 * _draws()) / 0.0125).round() * 0.0125  # mostly one of two values
    assert estimate_noise(values.exp()) == 0
    assert estimate_sensor_noise(values) == pytest.approx(0.006, rel=0.7)


def test_noise_that_neighbours_share_is_found_better_than_from_neighbours_alone() -> None:
    smooth = mean3x3(_draws())
    values = 0.01 * smooth / smooth.std()
    assert estimate_noise(values.exp()) < 0.0025
    assert 0.005 < estimate_sensor_noise(values) < 0.012


def test_clean_and_tiny_maps_have_no_noise() -> None:
    assert estimate_sensor_noise(_ramp()) < 1e-9
    assert estimate_sensor_noise(_ramp()[..., :2, :2]) == 0
    assert estimate_sensor_noise(torch.full((1, 1, 8, 8), torch.nan)) == 0


@pytest.mark.parametrize("std", [0.001, 0.01])
def test_noise_level_is_estimated_from_the_depth_map_alone(std: float) -> None:
    v, u = torch.meshgrid(torch.linspace(0, 1, 90), torch.linspace(0, 1, 120), indexing="ij")
    depth = (2 + u + 0.5 * v + 1.5 * (u > 0.4))[None, None].double()
    noisy = depth * (
        1 + std * torch.randn(depth.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    )
    noisy[..., 20:40, 30:60] = torch.nan
    assert estimate_noise(noisy) == pytest.approx(std, rel=0.1)
    assert estimate_noise(depth) < 1e-5
    assert estimate_noise(depth[..., :2, :2]) == 0


def test_normal_noise_deg_is_the_tilt_of_a_frontal_surface() -> None:
    camera = Camera(width=200, height=150, fx=80.0, fy=80.0, cx=99.5, cy=74.5)
    draws = torch.randn(1, 1, 150, 200, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    normals = depth_to_normals(3 * (1 + 0.001 * draws), camera.rays()[None])
    slopes = (normals[:, 0] / normals[:, 2])[..., 60:90, 80:120]
    assert math.degrees(math.atan(float(slopes.std()))) == pytest.approx(normal_noise_deg(0.001, camera), rel=0.1)
    assert normal_noise_deg(0.0, camera) == 0

"""Guided anisotropic diffusion, against a plain loop over pixels, closed forms and its own guarantee."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from small_scenes import disparity_of, plane, random_scene, sample_of, step
from torch import Tensor

from dsr.geometry.camera import to_range
from dsr.methods.classical.anisotropic_diffusion import AnisotropicDiffusion
from dsr.methods.classical.finite_differences import upsample_linear_border
from dsr.sample import DepthSample


def _coarse(sample: DepthSample) -> np.ndarray:
    return to_range(sample.depth_lr, sample.camera_lr, "disparity")[0].numpy() * sample.scale


def _means(x: Tensor, scale: int) -> np.ndarray:
    height, width = x.shape
    return x.numpy().reshape(height // scale, scale, width // scale, scale).mean(axis=(1, 3))


@pytest.mark.parametrize(("scale", "size"), [(2, (10, 6)), (4, (32, 48)), (8, (8, 24)), (16, (16, 16))])
@pytest.mark.parametrize("doffs", [0.0, 2.5])
def test_diffusion_keeps_the_block_means_of_disparity(scale: int, size: tuple[int, int], doffs: float) -> None:
    sample = sample_of(*random_scene(*size), scale=scale, doffs=doffs)
    hr = AnisotropicDiffusion(steps=60)(sample)
    assert hr.shape == (1, *size)
    np.testing.assert_allclose(_means(disparity_of(hr, sample), scale), _coarse(sample), rtol=1e-9)


def test_diffusion_equals_a_plain_loop_over_pixels() -> None:
    disparity, rgb = random_scene(16, 16)
    sample = sample_of(disparity, rgb)
    method = AnisotropicDiffusion(steps=20, edge=0.2, depth_weight=0.0, border=0)
    lr = torch.from_numpy(_coarse(sample))[None, None]
    start = upsample_linear_border(lr, 4)[0, 0].numpy()
    expected = _plain(start, rgb.double().numpy(), lr[0, 0].numpy(), steps=20, edge=0.2)
    result = method.diffuse(rgb[None], lr, 4)
    assert result.steps == 20
    np.testing.assert_allclose(result.values[0, 0].numpy(), expected, rtol=1e-5)


def _plain(x: np.ndarray, rgb: np.ndarray, lr: np.ndarray, *, steps: int, edge: float) -> np.ndarray:
    """Return the two steps in turn, pixel by pixel; the photo alone guides."""
    height, width = x.shape
    scale = height // lr.shape[0]
    x = x.copy()
    for _ in range(steps):
        change = np.zeros_like(x)
        for i, j in itertools.product(range(height), range(width)):
            for k, m in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
                if 0 <= k < height and 0 <= m < width:
                    difference = np.abs(rgb[:, k, m] - rgb[:, i, j]).sum() / 4  # the fourth channel is the map, times 0
                    change[i, j] += 0.24 / (1 + (difference / edge) ** 2) * (x[k, m] - x[i, j])
        x += change
        for i, j in np.ndindex(lr.shape):
            block = x[scale * i : scale * (i + 1), scale * j : scale * (j + 1)]
            block *= lr[i, j] / block.mean()
    return x


@pytest.mark.parametrize("scale", [2, 4, 8])
def test_diffusion_reproduces_a_plane_within_three_ten_thousandths_of_its_range(scale: int) -> None:
    disparity = plane()
    sample = sample_of(disparity, scale=scale)
    error = (disparity_of(AnisotropicDiffusion()(sample), sample) - disparity).abs().max()
    assert error < 3e-4 * (disparity.max() - disparity.min())


def test_plane_is_bent_along_the_image_border_without_padding() -> None:
    disparity = plane()
    sample = sample_of(disparity)
    error = (disparity_of(AnisotropicDiffusion(border=0)(sample), sample) - disparity).abs()
    assert error[:, :2].max() > 10 * error[12:20, 20:28].max()


def test_step_stays_sharp_along_a_photo_edge_and_is_smooth_without_one() -> None:
    disparity, rgb = step()
    sharp, smooth = (
        disparity_of(AnisotropicDiffusion(depth_weight=0.0, edge=0.01)(sample), sample)
        for sample in (sample_of(disparity, rgb), sample_of(disparity))
    )
    assert (sharp - disparity).abs().max() < 0.05
    assert (smooth - disparity).abs().max() > 0.5


def test_hole_is_filled_from_the_side_of_the_photo_edge_that_it_lies_on() -> None:
    disparity, rgb = step(64, 32)
    sample = sample_of(disparity, rgb)
    sample.depth_lr[:, 4:10, 5:8] = torch.nan
    hr = disparity_of(AnisotropicDiffusion(edge=0.01, depth_weight=0.0)(sample), sample)
    assert (hr - disparity).abs().max() < 0.1
    valid = sample.mask_lr[0].numpy()
    np.testing.assert_allclose(_means(hr, 4)[valid], _coarse(sample)[valid], rtol=1e-9)


def test_single_valid_pixel_fills_the_map() -> None:
    sample = sample_of(torch.full((8, 8), 5.0).double())
    sample.depth_lr[:, 1:] = torch.nan
    sample.depth_lr[:, :, 1:] = torch.nan
    hr = disparity_of(AnisotropicDiffusion()(sample), sample)
    np.testing.assert_allclose(hr.numpy(), 5.0, rtol=1e-6)


def test_iteration_stops_at_convergence_and_more_steps_change_little() -> None:
    sample = sample_of(*random_scene(32, 48))
    lr, rgb = torch.from_numpy(_coarse(sample))[None, None], sample.rgb[None]
    early = AnisotropicDiffusion(edge=0.3, depth_weight=0.0).diffuse(rgb, lr, 4)
    late = AnisotropicDiffusion(edge=0.3, depth_weight=0.0, tolerance=0.0, steps=3000).diffuse(rgb, lr, 4)
    assert early.steps < 1000
    assert late.steps == 3000
    assert early.moved[-1] < 1e-5 <= early.moved[-2]
    assert (early.values - late.values).abs().max() < 1e-3 * 6


def test_batch_equals_its_samples_one_at_a_time() -> None:
    maps, photos = zip(*(random_scene(16, 24, seed) for seed in (1, 2)), strict=True)
    lr = torch.stack([torch.from_numpy(_means(each, 4)) for each in maps])[:, None]
    method = AnisotropicDiffusion(steps=100, tolerance=0.0)
    together = method.diffuse(torch.stack(photos), lr, 4).values
    for number, guide_rgb in enumerate(photos):
        alone = method.diffuse(guide_rgb[None], lr[number : number + 1], 4).values[0]
        torch.testing.assert_close(together[number], alone, rtol=1e-5, atol=0)


def test_result_is_deterministic_and_independent_of_the_truth() -> None:
    sample = sample_of(*random_scene(16, 24))
    start_hr = AnisotropicDiffusion(steps=100)(sample)
    assert sample.depth is not None
    sample.depth.fill_(torch.nan)
    assert torch.equal(start_hr, AnisotropicDiffusion(steps=100)(sample))


def test_progress_ends_at_the_maximum_number_of_steps() -> None:
    reported: list[tuple[int, int]] = []
    AnisotropicDiffusion(steps=120, tolerance=0.0)(
        sample_of(*random_scene(8, 8)), lambda done, most: reported.append((done, most))
    )
    assert reported == [(50, 120), (100, 120), (120, 120)]


@pytest.mark.parametrize(
    ("key", "value"),
    [("steps", 0), ("tolerance", -1.0), ("step", 0.3), ("edge", 0.0), ("depth_weight", -1.0), ("border", -1)],
)
def test_value_out_of_range_is_refused_by_name(key: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"^{key}: expected .*, got {value}"):
        AnisotropicDiffusion(**{key: value})  # type: ignore[arg-type]

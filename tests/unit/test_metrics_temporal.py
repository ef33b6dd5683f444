"""Metrics over time: closed forms, numpy, scipy's interpolation of moved points, the code of Video Depth Anything."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import LinearNDInterpolator

from dsr.geometry.camera import Camera
from dsr.metrics.temporal import (
    covered,
    flicker,
    normal_flicker,
    opw,
    rsd,
    temporal_noise,
    tgm,
)

CAMERA = Camera(width=24, height=20, fx=30.0, fy=30.0, cx=11.5, cy=9.5)
TIME, V, U = np.mgrid[:4, :20, :24].astype(float)
X, Y = (U[0] - 11.5) / 30, (V[0] - 9.5) / 30
STILL = 2 + 0.3 * np.sin(0.2 * U[0] + 0.1 * V[0])


def _maps(values):
    return torch.from_numpy(np.broadcast_to(values, (len(values), 20, 24)).copy())[:, None]


def _noisy(seed, frames=9):
    return STILL * (1 + 0.01 * np.random.default_rng(seed).standard_normal((frames, 20, 24)))


def _poses(*places, turn=0.0):
    """Return poses of cameras at places, each turned about the vertical by ``turn`` more than the one before."""
    found = np.tile(np.eye(4), (len(places), 1, 1))
    for number, place in enumerate(places):
        c, s = math.cos(number * turn), math.sin(number * turn)
        found[number, :3, :3], found[number, :3, 3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]], place
    return found


def test_flicker_is_numpys_deviation_over_the_median_of_each_pixel():
    depths = _noisy(0)
    ratio = depths.std(axis=0) / np.median(depths, axis=0)
    assert flicker(_maps(depths)).item() == pytest.approx(ratio.mean(), rel=1e-12)
    assert temporal_noise(_maps(depths)).item() == pytest.approx(np.median(ratio), rel=1e-12)
    static = U[0] < 9
    given = torch.from_numpy(static)[None, None]
    assert flicker(_maps(depths), given).item() == pytest.approx(ratio[static].mean(), rel=1e-12)
    assert temporal_noise(_maps(depths), given).item() == pytest.approx(np.median(ratio[static]), rel=1e-12)


def test_holes_are_left_out_and_counted():
    depths = _noisy(1)
    depths[2, :5], depths[3:, 5:7], depths[1:, 7] = np.nan, 0, -1
    known = np.where(depths > 0, depths, np.nan)
    ratio = (np.nanstd(known, axis=0) / np.nanmedian(known, axis=0))[np.isfinite(known).sum(axis=0) > 1]
    assert flicker(_maps(depths)).item() == pytest.approx(ratio.mean(), rel=1e-12)
    assert temporal_noise(_maps(depths)).item() == pytest.approx(np.median(ratio), rel=1e-12)
    assert covered(_maps(depths)).item() == pytest.approx(np.isfinite(known).mean())
    assert covered(_maps(depths), torch.from_numpy(V[0] > 7)[None, None]).item() == 1
    assert math.isnan(flicker(_maps(np.full((2, 1, 1), np.nan))))
    assert math.isnan(temporal_noise(_maps(np.full((2, 1, 1), np.nan))))
    assert covered(_maps(np.full((2, 1, 1), np.nan))).item() == 0


@pytest.mark.parametrize("tilt", [2.0, 10.0])
def test_flicker_of_normals_is_half_the_angle_between_two_planes(tilt):
    slope = math.tan(math.radians(tilt))
    planes = np.stack([2 / (1 - sign * X * slope) for sign in (1, -1, 1, -1)])
    assert normal_flicker(_maps(planes), CAMERA).item() == pytest.approx(tilt, rel=1e-6)
    planes[:, 3:8, 4:9] = np.nan
    assert normal_flicker(_maps(planes), CAMERA).item() == pytest.approx(tilt, rel=1e-6)
    assert normal_flicker(_maps(2 + 0 * planes), CAMERA, torch.from_numpy(X > 0)[None, None]).item() < 1e-5


def test_exact_planes_before_a_moving_camera_agree_and_scales_that_change_differ_by_their_change():
    places = [(0, 0, 0), (0.1, 0.05, 0), (0.15, 0.05, 0), (0.2, 0.1, 0)]
    scales = np.array([1.0, 1.01, 1.0, 1.03])
    wall = np.full((4, 20, 24), 2.0)
    assert opw(_maps(wall), CAMERA, _poses(*places)).item() < 1e-9
    # the wall of a frame is at its scale of the distance, wherever the camera is in front of it
    expected = 2 * np.abs(np.diff(scales)).mean()
    assert opw(_maps(scales[:, None, None] * wall), CAMERA, _poses(*places)).item() == pytest.approx(expected)
    approach = np.stack([np.full((20, 24), 2.0 - z) for z in (0, 0.1, 0.3)])
    assert opw(_maps(approach), CAMERA, _poses((0, 0, 0), (0, 0, 0.1), (0, 0, 0.3))).item() < 1e-9
    assert opw(_maps(approach), CAMERA, _poses(*[(0, 0, 0)] * 3)).item() == pytest.approx(0.15)


def test_distances_spread_by_the_scales_of_the_views_alone():
    places = [(0, 0, 0), (0.1, 0.05, 0), (0.15, 0.05, 0), (0, 0, 0.2)]
    room = np.stack([np.full((20, 24), 2.0 - z) for _, _, z in places])
    assert rsd(_maps(room), CAMERA, _poses(*places)).item() < 1e-9
    scales = np.array([1.0, 1.01, 1.03, 1.09])[:, None, None]  # the last of which is another surface
    maps, poses = _maps(scales * (2 + 0.01 * U[:1] + 0.02 * V[:1])), _poses(*[(0, 0, 0)] * 4)
    assert rsd(maps, CAMERA, poses).item() == pytest.approx(np.std(scales[:3]) / np.mean(scales[:3]))
    maps[0] = torch.nan
    assert rsd(maps, CAMERA, poses).item() == pytest.approx(np.std(scales[1:3]) / np.mean(scales[1:3]))
    assert math.isnan(rsd(maps[[1, 3]], CAMERA, poses[:2]))


def test_warping_metric_is_that_of_scipys_interpolation_of_moved_points():
    depths = 2 + 0.05 * np.sin(0.3 * U[:2] + 0.2 * V[:2]) + 0.02 * TIME[:2]
    poses = _poses((0, 0, 0), (0.03, -0.02, 0.05), turn=0.02)
    points = np.stack([X * depths[0], Y * depths[0], depths[0], np.ones_like(X)]).reshape(4, -1)
    x, y, z, _ = np.linalg.inv(poses[1]) @ points
    places = np.stack([30 * x / z + 11.5, 30 * y / z + 9.5], axis=-1)
    warped = 1 / LinearNDInterpolator(places, 1 / z)(U[0], V[0])
    assert 300 < np.isfinite(warped).sum() < 480
    expected = np.nanmean(np.abs(warped - depths[1]))
    assert opw(_maps(depths), CAMERA, poses).item() == pytest.approx(expected, rel=0.02)


def test_pixels_that_change_colour_or_are_not_static_weigh_less():
    depths = np.full((2, 20, 24), 2.0)
    depths[1, :, 12:] = 1.9  # something has come in front of the right half
    photos = torch.full((2, 3, 20, 24), 0.5, dtype=torch.float64)
    photos[1, :, :, 12:] = 0.8
    still = _poses((0, 0, 0), (0, 0, 0))
    weight = math.exp(-50 * 3 * 0.3**2)
    assert opw(_maps(depths), CAMERA, still).item() == pytest.approx(0.05)
    assert opw(_maps(depths), CAMERA, still, photos).item() == pytest.approx(0.1 * weight / (1 + weight), rel=1e-6)
    static = torch.from_numpy(np.broadcast_to(U[:2] < 12, (2, 20, 24)).copy())[:, None]
    assert opw(_maps(depths), CAMERA, still, static=static).item() == pytest.approx(0, abs=1e-12)


def test_photos_are_compared_where_the_points_were():
    # the camera moves right by a pixel's width on the wall, so that what was at u is at u - 1
    wall, photos = np.full((2, 20, 24), 3.0), np.random.default_rng(7).random((2, 3, 20, 24))
    wall[1, :, 12:], photos[1, ..., :-1] = 2.7, photos[0, ..., 1:]
    photos, poses = torch.from_numpy(photos), _poses((0, 0, 0), (0.1, 0, 0))
    assert opw(_maps(wall), CAMERA, poses, photos).item() == pytest.approx(opw(_maps(wall), CAMERA, poses).item())


def test_temporal_gradients_are_those_of_video_depth_anything():
    # TemporalGradientMatchingLoss(trim=0, temp_grad_scales=1) in loss/loss.py of DepthAnything/Video-Depth-Anything
    # (4f5ae23)
    true = 2 + 0.3 * np.sin(0.2 * U + 0.1 * V + 0.25 * TIME) + 0.05 * TIME * (U > 16)
    predicted = true * (1 + 0.02 * np.sin(1.3 * TIME + 0.3 * U)) + 0.01 * np.cos(2 * TIME)
    mask = (U * V + TIME) % 9 != 4
    given = torch.from_numpy(mask)[:, None]
    assert tgm(_maps(predicted), _maps(true), given).item() == pytest.approx(0.03060636149836996, rel=1e-12)
    holes = np.where(mask, true, np.nan)
    assert tgm(_maps(predicted), _maps(holes)).item() == pytest.approx(0.03060636149836996, rel=1e-12)


def test_temporal_gradients_know_no_offset_and_have_the_size_of_a_jump():
    true = np.tile(STILL, (3, 1, 1))
    assert tgm(_maps(true + 0.2), _maps(true)).item() == pytest.approx(0, abs=1e-12)
    jumps = true + np.array([0, 0.01, 0.04])[:, None, None]
    assert tgm(_maps(jumps), _maps(true)).item() == pytest.approx(0.02)
    jumps[1, :10] = np.nan
    assert tgm(_maps(jumps), _maps(true)).item() == pytest.approx(0.02)
    assert math.isnan(tgm(_maps(np.full_like(true, np.nan)), _maps(true)))


@pytest.mark.parametrize(
    ("key", "call"),
    [
        ("depths", lambda: flicker(_maps(STILL[None]))),
        ("static", lambda: flicker(_maps(_noisy(0)), torch.ones(1, 20, 24) > 0)),
        ("poses, photos", lambda: opw(_maps(_noisy(0)), CAMERA, _poses((0, 0, 0)))),
        ("poses: 0", lambda: opw(_maps(_noisy(0, 2)), CAMERA, 2 * _poses((0, 0, 0), (0, 0, 0)))),
        ("target", lambda: tgm(_maps(_noisy(0, 2)), _maps(_noisy(0, 3)))),
    ],
)
def test_sequences_that_do_not_fit_together_are_refused(key, call):
    with pytest.raises(ValueError, match=f"^{key}: expected "):
        call()

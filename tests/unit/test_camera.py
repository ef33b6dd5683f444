"""Cameras and range types, against the pinhole model written out in numpy."""

import math

import numpy as np
import pytest
import torch

from dsr.geometry.camera import RANGE_TYPES, Camera, from_range, to_range

CAMERA = Camera(width=16, height=8, fx=20.0, fy=25.0, cx=6.25, cy=4.5)
STEREO = Camera(width=16, height=8, fx=20.0, fy=25.0, cx=6.25, cy=4.5, baseline=0.16, doffs=3.5)
CAMERAS = [CAMERA, STEREO, Camera(16, 8, 20.0, 25.0, -3.0, 40.0, baseline=1e-3, doffs=-0.01)]


def _depth(camera, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).uniform(0.3, 9.0, (1, camera.height, camera.width)))


def _numpy_range(z, camera, range_type):
    v, u = np.mgrid[: camera.height, : camera.width]
    if range_type == "perspective":
        points = np.stack(((u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z))
        return np.linalg.norm(points, axis=0)
    if range_type == "disparity":
        baseline = 0.2 if camera.baseline is None else camera.baseline
        return baseline * camera.fx / z - camera.doffs
    return z


def test_rays_have_z_one_and_pixel_centres_at_integers():
    rays = CAMERA.rays()
    assert rays.shape == (3, 8, 16)
    assert rays.dtype == torch.float64
    for v, u in ((0, 0), (3, 5), (7, 15)):
        expected = [(u - 6.25) / 20.0, (v - 4.5) / 25.0, 1.0]
        assert rays[:, v, u].tolist() == pytest.approx(expected, abs=1e-15)


def test_cropped_camera_has_the_rays_and_ranges_of_the_window():
    window = (..., slice(2, 7), slice(3, 13))
    cropped = STEREO.crop(2, 3, 5, 10)
    assert (cropped.height, cropped.width) == (5, 10)
    torch.testing.assert_close(cropped.rays(), STEREO.rays()[window], rtol=0, atol=1e-15)
    depth = _depth(STEREO)
    for range_type in RANGE_TYPES:
        expected = to_range(depth, STEREO, range_type)[window]
        torch.testing.assert_close(to_range(depth[window], cropped, range_type), expected, rtol=1e-14, atol=0)


@pytest.mark.parametrize("factor", [2, 4, 8])
def test_rescaled_camera_has_the_parameters_of_the_protocol(factor):
    coarse = STEREO.rescale(16 // factor, 8 // factor)
    expected = (20 / factor, 25 / factor, (6.25 + 0.5) / factor - 0.5, (4.5 + 0.5) / factor - 0.5, 3.5 / factor)
    assert (coarse.fx, coarse.fy, coarse.cx, coarse.cy, coarse.doffs) == pytest.approx(expected, rel=1e-14, abs=1e-14)
    assert coarse.baseline == 0.16


@pytest.mark.parametrize("factor", [2, 4, 8])
@pytest.mark.parametrize("offset", ["middle", "first"])
def test_decimated_camera_has_the_rays_of_the_kept_pixels(factor, offset):
    start = factor // 2 if offset == "middle" else 0
    coarse = STEREO.decimate(factor, start)
    kept = (..., slice(start, None, factor), slice(start, None, factor))
    torch.testing.assert_close(coarse.rays(), STEREO.rays()[kept], rtol=0, atol=1e-14)
    depth = _depth(STEREO)
    expected = to_range(depth, STEREO, "disparity")[kept] / factor  # disparity is in pixels of its own map
    torch.testing.assert_close(to_range(depth[kept], coarse, "disparity"), expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("range_type", RANGE_TYPES)
def test_range_types_have_their_defined_values_and_are_converted_back(camera, range_type):
    depth = _depth(camera)
    values = to_range(depth, camera, range_type)
    expected = _numpy_range(depth[0].numpy(), camera, range_type)
    np.testing.assert_allclose(values[0].numpy(), expected, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(from_range(values, camera, range_type), depth, rtol=1e-12, atol=0)


@pytest.mark.parametrize("range_type", RANGE_TYPES)
def test_range_conversion_keeps_holes_and_adds_none(range_type):
    depth = _depth(STEREO)
    depth[0, 2, 3] = torch.nan
    for values in (to_range(depth, STEREO, range_type), from_range(depth, STEREO, range_type)):
        assert torch.equal(values.isnan(), depth.isnan())


def test_disparity_at_or_beyond_infinity_becomes_a_hole():
    disparity = torch.full((8, 16), 1.0, dtype=torch.float64)
    disparity[0, :3] = torch.tensor([-3.5, -3.6, -100.0])  # doffs = 3.5 px
    disparity[1, 0] = -3.4  # still in front of infinity
    depth = from_range(disparity, STEREO, "disparity")
    assert depth.isnan().nonzero().tolist() == [[0, 0], [0, 1], [0, 2]]
    assert depth[1, 0].item() == pytest.approx(0.16 * 20.0 / 0.1, rel=1e-12)


def test_disparity_at_infinity_has_a_zero_gradient():
    disparity = torch.tensor([[-3.5, -4.0, 1.0]], dtype=torch.float64, requires_grad=True)
    depth = from_range(disparity, Camera(3, 1, 20.0, 20.0, 1.0, 0.0, baseline=0.16, doffs=3.5), "disparity")
    torch.where(depth.isfinite(), depth, 0).sum().backward()
    assert disparity.grad.flatten().tolist() == pytest.approx([0, 0, -0.16 * 20 / 4.5**2], rel=1e-12)


@pytest.mark.parametrize("name", ["width", "height", "fx", "fy", "cx", "cy", "doffs", "baseline"])
def test_invalid_field_is_refused_by_name(name):
    fields = {"width": 4, "height": 3, "fx": 5.0, "fy": 5.0, "cx": 1.5, "cy": 1.0}
    further = {"fx": [0, -20.0], "fy": [0], "baseline": [0, -0.1], "width": [0, -3, 2.5], "height": [0, -3, 2.5]}
    wrong = [math.nan, math.inf, -math.inf, *further.get(name, [])]
    for value in wrong:
        with pytest.raises(ValueError, match=f"^camera {name}: expected "):
            Camera(**(fields | {name: value}))


@pytest.mark.parametrize(
    "window", [(-1, 0, 2, 2), (0, -1, 2, 2), (7, 0, 2, 2), (0, 15, 2, 2), (0, 0, 0, 2), (0, 0, 2, 0)]
)
def test_window_beyond_the_image_is_refused(window):
    with pytest.raises(ValueError, match=r"^crop: expected a window within 8 x 16"):
        CAMERA.crop(*window)


@pytest.mark.parametrize("turns", [-1, 0, 1, 2, 3, 5])
def test_turned_camera_has_the_turned_rays(turns):
    camera = Camera(width=7, height=5, fx=6.0, fy=8.0, cx=2.3, cy=1.9, baseline=0.1, doffs=0.5)
    rays = camera.rays().rot90(turns, (-2, -1))
    x, y = rays[0], rays[1]
    for _ in range(turns % 4):
        x, y = y, -x  # counterclockwise: what pointed down points right, what pointed right points up
    expected = torch.stack((x, y, rays[2]))
    turned = camera.rotate90(turns)
    assert (turned.height, turned.width) == tuple(expected.shape[-2:])
    torch.testing.assert_close(turned.rays(), expected, rtol=0, atol=1e-12)
    assert (turned.baseline, turned.doffs) == (0.1, 0.5)


def test_camera_of_a_field_of_view_spans_it_between_the_outer_edges():
    camera = Camera.from_fov(60.0, 512, 384)
    left, right = ((edge - camera.cx) / camera.fx for edge in (-0.5, 511.5))
    assert math.degrees(math.atan(right) - math.atan(left)) == pytest.approx(60)
    assert (camera.fy, camera.cy) == (camera.fx, 191.5)
    assert Camera(640, 480, 481.2, -480.0, 319.5, 239.5).fy == 480  # an axis y that points up

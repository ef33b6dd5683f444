"""Cameras, range types and lenses, against the pinhole model in numpy, OpenCV's and RealSense's formulas."""

import json
import math

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from dsr.geometry.camera import RANGE_TYPES, Camera, Lens, from_range, to_range, undistort
from dsr.io.frames import CaptureFrame, Geometry, Rig
from dsr.io.inputs import read_picture
from dsr.io.pairs import Pair
from dsr.io.reading import CameraChoice, Reading

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


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("range_type", RANGE_TYPES)
def test_range_types_have_their_defined_values_and_are_converted_back(camera, range_type):
    depth = _depth(camera)
    values = to_range(depth, camera, range_type)
    expected = _numpy_range(depth[0].numpy(), camera, range_type)
    np.testing.assert_allclose(values[0].numpy(), expected, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(from_range(values, camera, range_type), depth, rtol=1e-12, atol=0)


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


def test_camera_of_a_field_of_view_spans_it_between_the_outer_edges():
    camera = Camera.from_fov(60.0, 512, 384)
    left, right = ((edge - camera.cx) / camera.fx for edge in (-0.5, 511.5))
    assert math.degrees(math.atan(right) - math.atan(left)) == pytest.approx(60)
    assert (camera.fy, camera.cy) == (camera.fx, 191.5)
    assert Camera(640, 480, 481.2, -480.0, 319.5, 239.5).fy == 480  # an axis y that points up


SEEING = Camera(160, 120, 130.0, 128.0, 81.0, 58.5)
ROWS, COLUMNS = np.mgrid[:120, :160].astype(float)
IDEAL = np.stack(((COLUMNS - 81) / 130, (ROWS - 58.5) / 128), -1)  # the ray x/z, y/z of each pixel without a lens
BROWN = Lens("brown_conrady", (-0.3, 0.12, 0.004, -0.003, -0.02))
FISHEYE = Lens("kannala_brandt", (-0.06, 0.02, -0.01, 0.002))
LENSES = {
    "brown": BROWN,
    "rational": Lens("brown_conrady", (0.4, -0.1, 0.001, 0.002, 0.03, 0.7, -0.05, 0.02)),
    "modified": Lens("modified_brown_conrady", BROWN.coefficients),
    "fisheye": FISHEYE,
    "thin prism": Lens("thin_prism_fisheye", (-0.06, 0.02, 0.002, -0.01, -0.01, 0.002, 0.003, -0.002)),
}


def rays_of_pixels(lens):
    """The ray x/z, y/z that each pixel of the distorted picture sees, by iteration on the forward model; (h, w, 2)."""
    rays = IDEAL.copy()
    for _ in range(60):
        rays += 0.7 * (IDEAL - forward(lens, rays))
    return rays


def forward(lens, rays):
    x, y = rays[..., 0], rays[..., 1]
    if lens.model == "modified_brown_conrady":
        k1, k2, p1, p2, k3 = lens.coefficients
        r2 = x**2 + y**2
        f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = x * f, y * f  # r2 stays that of the point before
        return np.stack((x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)), -1)
    if lens.model == "thin_prism_fisheye":
        k1, k2, p1, p2, k3, k4, sx1, sy1 = lens.coefficients
        theta, phi = np.arctan(np.sqrt(x**2 + y**2)), np.arctan2(y, x)
        u, v = theta * np.cos(phi), theta * np.sin(phi)
        radial = 1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8
        du = 2 * p1 * u * v + p2 * (theta**2 + 2 * u**2) + sx1 * theta**2
        dv = 2 * p2 * u * v + p1 * (theta**2 + 2 * v**2) + sy1 * theta**2
        return np.stack((u * radial + du, v * radial + dv), -1)
    points = np.stack((x, y, np.ones_like(x)), -1).reshape(-1, 1, 3)
    project = cv2.fisheye.projectPoints if lens.model == "kannala_brandt" else cv2.projectPoints
    zero = np.zeros((3, 1))
    return project(points, zero, zero, np.eye(3), np.array(lens.coefficients))[0].reshape(*x.shape, 2)


def pattern(rays):
    waves = (
        np.sin(9 * rays[..., 0] + 1) * np.cos(7 * rays[..., 1]),
        np.sin(5 * rays[..., 1] - 3 * rays[..., 0]),
        rays[..., 0],
    )
    return np.stack([127 + 100 * np.clip(wave, -1, 1) for wave in waves], -1)


@pytest.mark.parametrize("name", LENSES)
def test_each_ray_is_where_the_pinhole_camera_has_it_depth_of_the_nearest_pixel_and_holes_where_none_saw_it(name):
    rays = rays_of_pixels(LENSES[name])
    assert np.abs(rays - IDEAL).max() > 3 / 130  # several pixels of distortion
    found = undistort(np.rint(pattern(rays)).astype(np.uint8), SEEING, LENSES[name])
    inner = np.abs(found - pattern(IDEAL))[20:-20, 25:-25]
    assert inner.mean() < 0.6
    assert inner.max() < 4
    values, expected = (2000 + 900 * each[..., 0] + 500 * each[..., 1] for each in (rays, IDEAL))
    depth = undistort(values.astype(np.uint16), SEEING, LENSES[name], 0)
    known = depth > 0
    assert np.abs(depth - expected)[known].max() < 900 / 130 + 6
    assert set(np.unique(depth)) <= {0, *np.unique(values.astype(np.uint16))}
    assert known[30:-30, 40:-40].all()


def test_a_lens_without_coefficients_does_nothing_unless_it_is_a_fisheye():
    assert not Lens("brown_conrady", (0.0,) * 5).bends
    assert Lens("kannala_brandt", (0.0,) * 4).bends


@pytest.mark.parametrize(
    ("model", "numbers"), [("brown_conrady", (0.1,) * 3), ("kannala_brandt", (np.nan,) * 4), ("ftheta", (1.0,))]
)
def test_what_is_no_lens_is_refused(model, numbers):
    with pytest.raises(ValueError, match="lens: expected"):
        Lens(model, numbers)


SHIFT, TURN = np.array([0.03, -0.01, 0.005]), cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0]
NORMAL, PLANE = np.array([0.1, -0.2, 1.0]), 2.0  # of the plane NORMAL . x = PLANE in the depth camera's frame


@pytest.fixture
def capture(tmp_path):
    """A pair of a distorted photo and a distorted depth map of a plane, 80 x 60, with a rig and both lenses."""
    rays = rays_of_pixels(BROWN)
    Image.fromarray(np.rint(pattern(rays)).astype(np.uint8)).save(tmp_path / "photo.png")
    rays = rays_of_pixels(FISHEYE)
    z = PLANE / (rays @ NORMAL[:2] + NORMAL[2])
    z[40:44, 60:70] = 0
    Image.fromarray(np.rint(1000 * z).astype(np.uint16)).save(tmp_path / "depth.png")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = TURN, SHIFT
    rig = Rig(SEEING, matrix, FISHEYE)
    geometry = Geometry(SEEING, lens=BROWN, rig=rig)
    frame = CaptureFrame("Test", lambda _: geometry, tmp_path / "described.json", b"")
    return Pair("x", tmp_path / "photo.png", tmp_path / "depth.png", unit=1e-3, capture=frame)


def test_captures_rig_and_lenses_give_photo_and_depth_of_the_photos_pinhole_camera(capture):
    picture = read_picture(capture, Reading())
    photo = 255 * picture.rgb.permute(1, 2, 0).numpy()
    assert np.abs(photo - pattern(IDEAL))[20:-20, 25:-25].mean() < 0.6
    normal = TURN @ NORMAL
    expected = (PLANE + normal @ SHIFT) / (IDEAL @ normal[:2] + normal[2])
    found = picture.depth_lr[0].numpy()
    assert found.shape == (120, 160)
    known = np.isfinite(found)
    assert 0.8 < known.mean() < 1
    assert np.abs(found / expected - 1)[known].max() < 0.004
    said = json.dumps([str(each) for each in picture.assumptions])
    assert "-0.3 0.12" in said
    assert "-0.06 0.02" in said


def test_what_the_user_says_of_the_cameras_is_instead_of_the_captures(capture, tmp_path):
    choice = CameraChoice(intrinsics=(130.0, 128.0, 81.0, 58.5))
    picture = read_picture(capture, Reading(camera=choice))
    assert np.array_equal(255 * picture.rgb.permute(1, 2, 0).numpy(), np.array(Image.open(capture.rgb)))


def test_depth_map_in_the_photos_pixels_has_the_photos_lens(capture):
    rays = rays_of_pixels(BROWN)
    Image.fromarray(np.rint(1000 * (2 + rays[::2, ::2, 0])).astype(np.uint16)).save(capture.depth)
    geometry = Geometry(SEEING, lens=BROWN)
    frame = CaptureFrame("Test", lambda _: geometry, capture.depth, b"")
    found = read_picture(Pair("x", capture.rgb, capture.depth, unit=1e-3, capture=frame), Reading()).depth_lr[0].numpy()
    assert np.nanmax(np.abs(found - (2 + IDEAL[::2, ::2, 0]))) < 2 / 130

"""Lens distortion: pictures painted where OpenCV or RealSense's formulas put the points of a scene."""

import json

import cv2
import numpy as np
import pytest
from PIL import Image

from dsr.geometry.camera import Camera, Lens, undistort
from dsr.io.frames import CaptureFrame, Geometry, Rig
from dsr.io.inputs import read_picture
from dsr.io.pairs import Pair
from dsr.io.reading import CameraChoice, Reading

CAMERA = Camera(160, 120, 130.0, 128.0, 81.0, 58.5)
PRISM = (-0.06, 0.02, 0.002, -0.001, -0.01, 0.002, 0.003, -0.002)
BROWN, FISHEYE = (-0.3, 0.12, 0.004, -0.003, -0.02), (-0.06, 0.02, -0.01, 0.002)
LENSES = {
    "brown_conrady": BROWN,
    "rational": (0.4, -0.1, 0.001, 0.002, 0.03, 0.7, -0.05, 0.02),
    "modified_brown_conrady": BROWN,
    "kannala_brandt": FISHEYE,
    "thin_prism_fisheye": PRISM,
}


def rays_of_pixels(name, numbers):
    """The ray x/z, y/z that each pixel of the distorted picture sees, by iteration on the forward model; (h, w, 2)."""
    rows, columns = np.mgrid[:120, :160].astype(float)
    seen = np.stack(((columns - 81) / 130, (rows - 58.5) / 128), -1)
    rays = seen.copy()
    for _ in range(60):
        rays += 0.7 * (seen - forward(name, numbers, rays))
    return rays


def forward(name, numbers, rays):
    x, y = rays[..., 0], rays[..., 1]
    if name == "modified_brown_conrady":
        k1, k2, p1, p2, k3 = numbers
        r2 = x**2 + y**2
        f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = x * f, y * f  # r2 stays that of the point before
        return np.stack((x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)), -1)
    if name == "thin_prism_fisheye":
        k1, k2, p1, p2, k3, k4, sx1, sy1 = numbers
        theta, phi = np.arctan(np.sqrt(x**2 + y**2)), np.arctan2(y, x)
        u, v = theta * np.cos(phi), theta * np.sin(phi)
        radial = 1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8
        du = 2 * p1 * u * v + p2 * (theta**2 + 2 * u**2) + sx1 * theta**2
        dv = 2 * p2 * u * v + p1 * (theta**2 + 2 * v**2) + sy1 * theta**2
        return np.stack((u * radial + du, v * radial + dv), -1)
    points = np.stack((x, y, np.ones_like(x)), -1).reshape(-1, 1, 3)
    project = cv2.fisheye.projectPoints if name == "kannala_brandt" else cv2.projectPoints
    zero = np.zeros((3, 1))
    args = (points, zero, zero, np.eye(3), np.array(numbers))
    return project(*args)[0].reshape(*x.shape, 2)


def pattern(rays):
    waves = (
        np.sin(9 * rays[..., 0] + 1) * np.cos(7 * rays[..., 1]),
        np.sin(5 * rays[..., 1] - 3 * rays[..., 0]),
        rays[..., 0],
    )
    return np.stack([127 + 100 * np.clip(wave, -1, 1) for wave in waves], -1)


def ideal_rays():
    rows, columns = np.mgrid[:120, :160].astype(float)
    return np.stack(((columns - 81) / 130, (rows - 58.5) / 128), -1)


def lens_of(name):
    return Lens("brown_conrady" if name == "rational" else name, LENSES[name])


@pytest.mark.parametrize("name", LENSES)
def test_picture_without_distortion_shows_each_ray_where_the_pinhole_camera_has_it(name):
    rays = rays_of_pixels(name, LENSES[name])
    assert np.abs(rays - ideal_rays()).max() > 3 / 130  # several pixels of distortion
    found = undistort(np.rint(pattern(rays)).astype(np.uint8), CAMERA, lens_of(name))
    inner = np.abs(found - pattern(ideal_rays()))[20:-20, 25:-25]
    assert inner.mean() < 0.6
    assert inner.max() < 4


@pytest.mark.parametrize("name", LENSES)
def test_depth_takes_the_nearest_pixel_and_what_no_pixel_saw_is_a_hole(name):
    rays = rays_of_pixels(name, LENSES[name])
    values = (2000 + 900 * rays[..., 0] + 500 * rays[..., 1]).astype(np.uint16)
    found = undistort(values, CAMERA, lens_of(name), 0)
    known = found > 0
    ideal = ideal_rays()
    assert np.abs(found - (2000 + 900 * ideal[..., 0] + 500 * ideal[..., 1]))[known].max() < 900 / 130 + 6
    assert set(np.unique(found)) <= {0, *np.unique(values)}
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
    rays = rays_of_pixels("brown_conrady", BROWN)
    Image.fromarray(np.rint(pattern(rays)).astype(np.uint8)).save(tmp_path / "photo.png")
    rays = rays_of_pixels("kannala_brandt", FISHEYE)
    z = PLANE / (rays @ NORMAL[:2] + NORMAL[2])
    z[40:44, 60:70] = 0
    Image.fromarray(np.rint(1000 * z).astype(np.uint16)).save(tmp_path / "depth.png")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = TURN, SHIFT
    rig = Rig(CAMERA, matrix, Lens("kannala_brandt", FISHEYE))
    geometry = Geometry(CAMERA, lens=Lens("brown_conrady", BROWN), rig=rig)
    frame = CaptureFrame("Test", lambda _: geometry, tmp_path / "described.json", b"")
    return Pair("x", tmp_path / "photo.png", tmp_path / "depth.png", unit=1e-3, capture=frame)


def test_captures_rig_and_lenses_give_photo_and_depth_of_the_photos_pinhole_camera(capture):
    picture = read_picture(capture, Reading())
    ideal = ideal_rays()
    photo = 255 * picture.rgb.permute(1, 2, 0).numpy()
    assert np.abs(photo - pattern(ideal))[20:-20, 25:-25].mean() < 0.6
    normal = TURN @ NORMAL
    expected = (PLANE + normal @ SHIFT) / (ideal @ normal[:2] + normal[2])
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
    rays = rays_of_pixels("brown_conrady", BROWN)
    Image.fromarray(np.rint(1000 * (2 + rays[::2, ::2, 0])).astype(np.uint16)).save(capture.depth)
    geometry = Geometry(CAMERA, lens=Lens("brown_conrady", BROWN))
    frame = CaptureFrame("Test", lambda _: geometry, capture.depth, b"")
    found = read_picture(Pair("x", capture.rgb, capture.depth, unit=1e-3, capture=frame), Reading()).depth_lr[0].numpy()
    assert np.nanmax(np.abs(found - (2 + ideal_rays()[::2, ::2, 0]))) < 2 / 130


@pytest.mark.parametrize("model", ["brown_conrady", "kannala_brandt"])
def test_intrinsics_of_whole_numbers_are_those_of_floats(model):
    picture = np.arange(64 * 48, dtype=np.float32).reshape(48, 64)
    whole, real = (Camera(64, 48, *map(kind, (60, 60, 31, 24))) for kind in (int, float))
    lens = Lens(model, (1, 0, 0, 0))
    np.testing.assert_array_equal(undistort(picture, whole, lens), undistort(picture, real, lens))

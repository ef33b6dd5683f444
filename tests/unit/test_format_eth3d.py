"""ETH3D, of files of our own: a plane before a fisheye with a prism, as its depth files have it; every damage named."""

import re

import numpy as np
import pytest
from refusals import refused
from small_files import encoded_png as png
from small_files import written

from dsr.data.eth3d import ETH3D, find_frames, load_frame

HEIGHT, WIDTH = 64, 96
FX, FY, CX, CY = 68.0, 69.0, 49.5, 31.0
"""Pixels, the centre of the first at 0.5."""
LENS = (-0.05, 0.02, 1e-3, -2e-3, -0.01, 0.003, 2e-3, 1e-3)
NORMAL, DISTANCE = np.array([0.2, -0.1, 1.0]), 3.0
CAMERAS = f"""# Camera list with one line of data per camera:
0 THIN_PRISM_FISHEYE {WIDTH} {HEIGHT} {FX} {FY} {CX} {CY} {" ".join(map(str, LENS))}
1 THIN_PRISM_FISHEYE 48 32 34 34 24 16 {" ".join(map(str, LENS))}
"""
IMAGES = """# Image list with two lines of data per image:
7 1 0 0 0 0.1 0.2 0.3 0 dslr_images/DSC_0286.JPG
10.5 20.5 -1 11.5 20.5 4
8 1 0 0 0 0.1 0.2 0.4 1 dslr_images/DSC_0287.JPG

"""


def seen(x, y):
    """Return where the lens has the ray (x, y, 1), at a focal length of 1."""
    k1, k2, p1, p2, k3, k4, sx1, sy1 = LENS
    theta, phi = np.arctan(np.hypot(x, y)), np.arctan2(y, x)
    u, v, t = theta * np.cos(phi), theta * np.sin(phi), theta**2
    radial = 1 + k1 * t + k2 * t**2 + k3 * t**3 + k4 * t**4
    du, dv = 2 * p1 * u * v + p2 * (t + 2 * u**2) + sx1 * t, 2 * p2 * u * v + p1 * (t + 2 * v**2) + sy1 * t
    return u * radial + du, v * radial + dv


def rays():
    """Return the rays that the pixels of the picture see, by a fixed point."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    u, v = (columns - CX) / FX, (rows - CY) / FY
    x, y = u.copy(), v.copy()
    for _ in range(200):
        du, dv = seen(x, y)
        x, y = x + 0.7 * (u - du), y + 0.7 * (v - dv)
    return x, y


X, Y = rays()
DEPTH = (DISTANCE / (NORMAL[0] * X + NORMAL[1] * Y + NORMAL[2])).astype("<f4")
DEPTH[28:34, 46:53] = np.inf
PHOTO = np.dstack([127 + 100 * X, 127 + 100 * Y, 0 * X + 51]).round().astype(np.uint8)


def scene(root, name="courtyard", photo="DSC_0286"):
    """Write a scene with a photo and return the files that it is loaded from."""
    place = root / name
    return (
        written(place / f"images/dslr_images/{photo}.JPG", png(PHOTO[..., ::-1])),
        written(place / f"ground_truth_depth/dslr_images/{photo}.JPG", DEPTH.tobytes()),
        written(place / "dslr_calibration_jpg/cameras.txt", CAMERAS.encode()),
        written(place / "dslr_calibration_jpg/images.txt", IMAGES.encode()),
    )


def test_depth_is_that_of_the_plane_before_the_pinhole_camera(tmp_path):
    loaded = load_frame(*scene(tmp_path), "eth3d", "a")
    camera = loaded.camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (FX, FY, CX - 0.5, CY - 0.5)
    points = (loaded.depth * camera.rays()).numpy()
    off = np.tensordot(NORMAL, points, 1) - DISTANCE
    known = np.isfinite(off)
    assert known.mean() > 0.95
    corner = X[0, 0] ** 2 + Y[0, 0] ** 2
    assert abs(off[known]).max() < 0.5 * (0.2 + 0.1) / FX * np.nanmax(points[2]) * (1 + corner)  # of half a pixel
    assert abs(off[known].mean()) < 1e-3
    assert not known[29:33, 47:52].any()


def test_photo_shows_the_rays_of_the_pinhole_camera(tmp_path):
    loaded = load_frame(*scene(tmp_path), "eth3d", "a")
    x, y, _ = loaded.camera.rays().numpy()
    red, green, blue = loaded.rgb.numpy() * 255
    inside = (slice(4, -4), slice(4, -4))
    assert abs(red - 127 - 100 * x)[inside].max() < 1.5
    assert abs(green - 127 - 100 * y)[inside].max() < 1.5
    assert (blue == 51).all()


def test_scenes_are_named_by_folder_and_photo_and_resized_on_request(tmp_path, dsr_cache):
    scene(tmp_path)
    scene(tmp_path, "pipes")
    scene(tmp_path, "office")[1].unlink()
    assert list(find_frames(tmp_path)) == ["courtyard/DSC_0286", "pipes/DSC_0286"]
    assert list(find_frames(tmp_path / "pipes")) == ["pipes/DSC_0286"]
    loaded = ETH3D(str(tmp_path), ["pipes_DSC_0286"], size=32).load("pipes_DSC_0286")
    assert tuple(loaded.depth.shape) == (1, 32, 48)
    assert loaded.camera.fx == pytest.approx(FX / 2)
    off = np.tensordot(NORMAL, (loaded.depth * loaded.camera.rays()).numpy(), 1) - DISTANCE
    assert np.nanmax(abs(off)) < 0.02
    with pytest.raises(ValueError, match="got 2 of 454 scenes"):
        ETH3D(str(tmp_path))


@pytest.mark.parametrize(
    ("which", "content", "message"),
    [
        (0, b"", "expected a picture"),
        (0, png(PHOTO[1:]), r"expected the size of its camera in cameras\.txt, got \(63, 96\)"),
        (1, DEPTH.tobytes()[4:], "expected 4 bytes for each of 64 x 96 pixels, got 24572"),
        (1, np.full_like(DEPTH, np.nan).tobytes(), "expected positive depth"),
        (1, (-DEPTH).tobytes(), "expected positive depth"),
        (1, np.full_like(DEPTH, np.inf).tobytes(), "expected at least one known pixel, all are holes"),
        (2, b"0 FOV 96 64 60 60 48 32 1", "expected a camera model of"),
        (2, CAMERAS.replace(" 0.003", "").encode(), "expected 12 numbers of THIN_PRISM_FISHEYE, got 11"),
        (3, IMAGES.replace("DSC_0286", "DSC_0285").encode(), r"expected one image DSC_0286\.JPG, got 0"),
        (3, b"7 1 0 0 0 0.1 DSC_0286.JPG\n\n", "expected IMAGE_ID"),
    ],
)
def test_damaged_or_foreign_file_is_refused_in_one_line_that_names_it(tmp_path, capfd, which, content, message):
    files = scene(tmp_path)
    files[which].write_bytes(content)
    assert re.match(message, refused(lambda: load_frame(*files, "eth3d", "a"), files[which], capfd))


@pytest.mark.parametrize("which", range(4))
def test_missing_file_is_refused(tmp_path, capfd, which):
    files = scene(tmp_path)
    files[which].unlink()
    assert refused(lambda: load_frame(*files, "eth3d", "a"), files[which], capfd).startswith("expected ")

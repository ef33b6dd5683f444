"""What `dsr view` stores of surfaces: read back by other means, and compared with dsr's own mesh."""

import base64
import hashlib
import json
import math
import re
import zlib

import numpy as np
import pytest
from small_results import CAMERA, HOLE, waves

from dsr.geometry.camera import Camera
from dsr.report.surface_page import (
    Grid,
    ViewedResult,
    find_joints,
    is_view,
    pack_grid,
    pack_result,
    reduce_depth,
    save_view,
)

SPITEFUL = "<img src=x onerror=alert(1)>\"'&</script><script>alert(2)</script>"


def unpack(about, text):
    """Return inverse depth (NaN in holes), flags and error levels, pixel by pixel as the page's script does."""
    height, width = about["height"], about["width"]
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(-1, height, width).astype(int)
    rest = (planes[0] << 16) + (planes[1] << 8) + planes[2]
    levels = np.zeros((height + 1, width + 1), int)
    for v in range(height):
        for u in range(width):
            levels[v + 1, u + 1] = (rest[v, u] + levels[v + 1, u] + levels[v, u + 1] - levels[v, u]) % 2**24
    levels = levels[1:, 1:]
    low, high = about["range"]
    inverse = np.where(levels == 0, np.nan, low + (levels - 1) / (about["levels"] - 1) * (high - low))
    return inverse, planes[3], planes[4:]


def test_inverse_depth_is_read_back_to_24_bits():
    depth, joints = waves(), find_joints(waves(), 1)
    grid = Grid(depth.astype(float), CAMERA, 1, joints, np.zeros(depth.shape, bool), joints, {})
    inverse, _, _ = unpack(*pack_grid(grid))
    np.testing.assert_array_equal(np.isnan(inverse), np.isnan(depth))
    expected = 1 / depth.astype(float)
    step = (np.nanmax(expected) - np.nanmin(expected)) / (2**24 - 2)
    assert np.nanmax(np.abs(inverse - expected)) <= 0.51 * step


def test_reduced_surface_is_cut_where_the_whole_one_is():
    _, u = np.mgrid[:60, :60] / 60
    depth = 2 + 0.06 * np.sin(9 * u)  # bends by more than a cut allows from block to block, not from pixel to pixel
    depth[30:, 20:40] += 0.5
    across, down = find_joints(depth, 5)
    expected_across, expected_down = np.ones((12, 11), bool), np.ones((11, 12), bool)
    expected_across[6:, [3, 7]] = False
    expected_down[5, 4:8] = False
    np.testing.assert_array_equal(across, expected_across)
    np.testing.assert_array_equal(down, expected_down)
    assert not find_joints(reduce_depth(depth, 5), 1)[0][:6].all()


def test_reduced_plane_is_the_plane_seen_by_the_reduced_camera():
    camera = Camera(30, 21, 40.0, 42.0, 14.0, 9.0)
    inverse_of = lambda camera: 0.3 + (camera.rays()[0] * 0.2 + camera.rays()[1] * 0.1).numpy()  # noqa: E731
    found = reduce_depth(1 / inverse_of(camera), 3)
    np.testing.assert_allclose(1 / found, inverse_of(camera.downscale(3)), rtol=1e-12)


def test_reduction_does_not_mix_surfaces_and_keeps_holes():
    depth = np.full((12, 12), 2.0)
    depth[:, 7:] = 3.0
    depth[:5, :5] = np.nan
    found = reduce_depth(depth, 3)
    assert set(found[np.isfinite(found)].round(12)) == {2.0, 3.0}
    assert np.isnan(found).tolist()[0] == [True, True, False, False]  # of the second block six pixels are holes
    assert not np.isnan(found[2:]).any()


def result(name="r", **values):
    depth = waves()
    errors = {"depth_error": np.full(depth.shape, 0.01, np.float32), "angle_error": np.full(depth.shape, 8.0)}
    errors["depth_error"][:, :10] = 0.1
    return ViewedResult(name, depth, CAMERA, **({**errors, "max_error": 0.02} | values))


def test_pixels_with_a_large_expected_error_are_doubtful():
    packed = pack_result(result(), 10**6, 512)
    _, flags, errors = unpack(packed.about["after"], packed.data["after"])
    doubtful = np.zeros((64, 64), bool)
    doubtful[:, :10] = True
    doubtful[HOLE] = False
    np.testing.assert_array_equal(flags & 16 > 0, doubtful)
    assert packed.about["doubtful"] == doubtful.mean()
    assert set(errors[0][HOLE].ravel()) == {0}
    middle = float(np.nanmedian(waves()))
    assert packed.about["errors"]["depth"] == {"low": 1e-3 * middle, "high": 1e-1 * middle}
    assert errors[0][0, 63] == round(1 + 254 * math.log(0.01 / (1e-3 * middle)) / math.log(100))


def test_depth_that_was_not_measured_is_marked_as_filled():
    filled = np.zeros((64, 64), bool)
    filled[8:12, 20:28] = True
    packed = pack_result(result(filled=filled), 10**6, 512)
    assert not filled[HOLE].any()
    np.testing.assert_array_equal(unpack(packed.about["after"], packed.data["after"])[1] & 32 > 0, filled)
    assert packed.about["filled"] == filled.mean()
    assert pack_result(result(), 10**6, 512).about["filled"] == 0


def test_large_result_is_reduced_and_says_so():
    packed = pack_result(result(), 1024, 512)
    about = packed.about["after"]
    assert (about["width"], about["height"], about["factor"], about["size"]) == (32, 32, 2, [64, 64])
    assert packed.vertices == 1024
    inverse, _, _ = unpack(about, packed.data["after"])
    blocks = 1 / waves().reshape(32, 2, 32, 2).astype(float)
    np.testing.assert_allclose(inverse[:10, :10], blocks.mean(axis=(1, 3))[:10, :10], rtol=1e-6)
    assert about["lens"] == pytest.approx([40, 40, 15.25, 16.0])


def test_input_keeps_its_own_size_and_camera():
    packed = pack_result(result(depth_lr=waves()[::4, ::4]), 10**6, 512)
    about = packed.about["before"]
    assert (about["width"], about["height"], about["errors"]) == (16, 16, [])
    assert about["lens"] == pytest.approx([20, 20, (31 + 0.5) / 4 - 0.5, (32.5 + 0.5) / 4 - 0.5])


def test_page_asks_nobody_and_escapes_every_name(tmp_path):
    packed = [pack_result(result(SPITEFUL, notes=[SPITEFUL], facts={SPITEFUL: SPITEFUL}), 10**6, 512)]
    save_view(tmp_path / "page.html", packed, title=SPITEFUL, notes=[SPITEFUL])
    text = (tmp_path / "page.html").read_text()
    assert is_view(tmp_path / "page.html")
    assert "<img src=x" not in text
    assert "alert(2)</script>" not in text
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:)?//""", text)
    content = json.loads(re.search(r'id="content">(.*?)</script>', text, re.DOTALL)[1])
    assert (content["results"][0]["name"], content["title"]) == (SPITEFUL, SPITEFUL)
    for tag, source in (("style", "style-src"), ("script", "script-src")):
        inner = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)[-1]
        digest = base64.b64encode(hashlib.sha256(inner.encode()).digest()).decode()
        assert f"{source} 'sha256-{digest}'" in text
    assert 'alt="&lt;img' in text

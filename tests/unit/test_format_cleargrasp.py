"""ClearGrasp: its regions, the bent depth and the steps of its renderings, its splits."""

import numpy as np
import pytest
import torch
from data_set_files import SETS, exr, opened, write_frame
from small_files import encoded_png as png
from small_files import written

from dsr.data.cleargrasp import EDGE, ClearGrasp, find_captures, find_renderings, read_depth

ROWS, COLUMNS = np.mgrid[0:36, 0:64]


@pytest.mark.parametrize("name", ["cleargrasp", "cleargrasp as rendered"])
def test_regions_are_the_mask_the_rest_and_five_pixels_on_either_side_of_its_outline(tmp_path, name):
    mask = 255 * ((ROWS >= 10) & (ROWS < 30) & (COLUMNS >= 20) & (COLUMNS < 50)).astype(np.uint8)
    kind = write_frame(name, tmp_path, mask_png=png(mask))
    regions = opened(kind, tmp_path).load(kind.name).regions
    assert {each.dtype for each in regions.values()} == {torch.uint8}
    assert sorted(regions) == ["edges", "glass", "outside"]
    np.testing.assert_array_equal(regions["glass"][0], mask > 0)
    np.testing.assert_array_equal(regions["outside"][0], mask == 0)
    assert regions["edges"][0, 20].nonzero().ravel().tolist() == [*range(15, 25), *range(45, 55)]
    assert EDGE == 5


def test_depth_of_renderings_is_that_of_a_plane_again(tmp_path):
    """The owners' loops: distance along the ray, times the cosines of angles that grow evenly over the picture."""
    view_y, view_x = 0.7428327202796936, 1.2112585306167603
    focal = 32 / np.tan(view_x / 2)
    x, y = (COLUMNS - 31.5) / focal, (ROWS - 17.5) / focal
    depth = 0.8 / (0.2 * x + 0.1 * y + 1)
    distance = depth * np.sqrt(x**2 + y**2 + 1)
    stored = distance * np.cos(abs(18 - ROWS) * view_y / 36) * np.cos(abs(32 - COLUMNS) * view_x / 64)
    kind = write_frame("cleargrasp as rendered", tmp_path, exr=exr(stored))
    scene = opened(kind, tmp_path).load(kind.name)
    assert abs(scene.depth[0].numpy() / depth - 1).max() < 2**-10  # half a step of rounding, and half of smoothing
    assert scene.measured == {}
    points = scene.depth * scene.camera.rays()
    off = 0.2 * points[0] + 0.1 * points[1] + points[2] - 0.8
    assert off.abs().max() < 0.8 * 2**-10


def test_steps_of_16_bits_are_smoothed_in_renderings_alone(tmp_path):
    slope = 0.5 + 2**-11 * (COLUMNS + 0.3) / 8
    path = written(tmp_path / "a.exr", exr(np.where(ROWS == 0, np.nan, slope)))
    stored, smooth = read_depth(path)[0].numpy()[1:], read_depth(path, smooth=True)[0].numpy()[1:]
    assert len(np.unique(stored)) == 9
    assert abs(smooth - stored).max() <= 2**-12 * (1 + 1e-9)
    errors = [abs(each - slope[1:])[:, 8:-8].mean() for each in (smooth, stored)]
    assert errors[0] < 0.5 * errors[1]
    assert read_depth(path, smooth=True)[0, 0].isnan().all()


def test_scenes_are_found_by_split_and_need_all_their_files(tmp_path):
    for name, place, number in (
        ("cleargrasp", "real-test/d435", "000000002"), ("cleargrasp", "real-val/d435", "000000080"),
        ("cleargrasp as rendered", "cup-val", "0"), ("cleargrasp as rendered", "big/cup-train", "0"),
    ):  # fmt: skip
        for path, content in SETS[name].files.items():
            file = path.replace("real-val/d435", place).replace("cup-val", place).replace("000000080", number)
            written(tmp_path / file, content)
    assert list(find_captures(tmp_path)) == ["real-test/d435/000000002", "real-val/d435/000000080"]
    assert list(find_captures(tmp_path, "test")) == ["real-test/d435/000000002"]
    assert list(find_renderings(tmp_path, "val")) == ["cup-val/0"]
    assert ClearGrasp(str(tmp_path), True, "val").evaluation
    assert not ClearGrasp(str(tmp_path), True, "train").evaluation

"""ClearGrasp, of files of our own: captures with twins, renderings with their bent depth, regions, every damage."""

import numpy as np
import OpenEXR
import pytest
import torch
from small_files import encoded_png as png
from small_files import written

from dsr.data.cleargrasp import (
    EDGE,
    ClearGrasp,
    find_captures,
    find_renderings,
    load_capture,
    load_rendering,
    read_depth,
)

ROWS, COLUMNS = np.mgrid[0:36, 0:64]
TWIN = 0.5 + ROWS / 128 + COLUMNS / 256  # Metres that 16-bit floats hold exactly, not symmetric under any flip
MASK = 255 * ((ROWS >= 10) & (ROWS < 30) & (COLUMNS >= 20) & (COLUMNS < 50)).astype(np.uint8)
CAMERA = b"""# Camera Intrinsic Parameters
camera_name: 'D435'
xres: 64           # Image Width
yres: 36
fx: 46.5
fy: 46
cx: 32     # Center of image
cy: 17.5
"""
PHOTO = png(np.dstack([ROWS * 0 + 51] * 3).astype(np.uint8))


def exr(path, depth):
    """Write depth as its owners do: 16-bit floats, the same in three channels."""
    path.parent.mkdir(parents=True, exist_ok=True)
    channels = {each: np.ascontiguousarray(depth.astype(np.float16)) for each in "RGB"}
    with OpenEXR.File({"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}, channels) as file:
        file.write(str(path))
    return path


def capture(folder, name="000000080"):
    """Write a capture and return its files: the glass shows what is 0.25 m behind it, with holes of both kinds."""
    seen, twin = np.where(MASK > 0, TWIN + 0.25, TWIN), TWIN.copy()
    seen[0, 0], twin[35, 63] = 0, np.nan
    return (
        written(folder / f"{name}-transparent-rgb-img.jpg", PHOTO),
        exr(folder / f"{name}-transparent-depth-img.exr", seen),
        exr(folder / f"{name}-opaque-depth-img.exr", twin),
        written(folder / f"{name}-mask.png", png(MASK)),
        written(folder / "camera_intrinsics.yaml", CAMERA),
    )


def rendering(folder, name="000000000"):
    """Write a rendering of the plane 0.2 x + 0.1 y + z = 0.8 and return its files, and the plane's depth.

    The owners' loops: distance along the ray, times the cosines of angles that grow evenly over the picture.
    """
    view_y, view_x = 0.7428327202796936, 1.2112585306167603
    focal = 32 / np.tan(view_x / 2)
    x, y = (COLUMNS - 31.5) / focal, (ROWS - 17.5) / focal
    depth = 0.8 / (0.2 * x + 0.1 * y + 1)
    distance = depth * np.sqrt(x**2 + y**2 + 1)
    stored = distance * np.cos(abs(18 - ROWS) * view_y / 36) * np.cos(abs(32 - COLUMNS) * view_x / 64)
    files = (
        written(folder / f"rgb-imgs/{name}-rgb.jpg", PHOTO),
        exr(folder / f"depth-imgs-rectified/{name}-depth-rectified.exr", stored),
        written(folder / f"segmentation-masks/{name}-segmentation-mask.png", png(MASK)),
    )
    return files, depth


def test_regions_are_the_mask_the_rest_and_five_pixels_on_either_side_of_its_outline(tmp_path):
    regions = load_capture(*capture(tmp_path), "cleargrasp", "a").regions
    assert {each.dtype for each in regions.values()} == {torch.uint8}
    assert sorted(regions) == ["edges", "glass", "outside"]
    np.testing.assert_array_equal(regions["glass"][0], MASK > 0)
    np.testing.assert_array_equal(regions["outside"][0], MASK == 0)
    assert regions["edges"][0, 20].nonzero().ravel().tolist() == [*range(15, 25), *range(45, 55)]
    assert EDGE == 5


def test_depth_of_renderings_is_that_of_a_plane_again(tmp_path):
    files, depth = rendering(tmp_path)
    scene = load_rendering(*files, "cleargrasp_synthetic", "a")
    assert abs(scene.depth[0].numpy() / depth - 1).max() < 2**-10  # half a step of rounding, and half of smoothing
    assert scene.measured == {}
    points = scene.depth * scene.camera.rays()
    off = 0.2 * points[0] + 0.1 * points[1] + points[2] - 0.8
    assert off.abs().max() < 0.8 * 2**-10
    np.testing.assert_array_equal(scene.regions["glass"][0], MASK > 0)


def test_steps_of_16_bits_are_smoothed_in_renderings_alone(tmp_path):
    slope = 0.5 + 2**-11 * (COLUMNS + 0.3) / 8
    path = exr(tmp_path / "a.exr", np.where(ROWS == 0, np.nan, slope))
    stored, smooth = read_depth(path)[0].numpy()[1:], read_depth(path, smooth=True)[0].numpy()[1:]
    assert len(np.unique(stored)) == 9
    assert abs(smooth - stored).max() <= 2**-12 * (1 + 1e-9)
    errors = [abs(each - slope[1:])[:, 8:-8].mean() for each in (smooth, stored)]
    assert errors[0] < 0.5 * errors[1]
    assert read_depth(path, smooth=True)[0, 0].isnan().all()


def test_scenes_are_found_by_split_and_need_all_their_files(tmp_path):
    capture(tmp_path / "real-val/d435")
    capture(tmp_path / "real-test/d415", "000000002")
    capture(tmp_path / "real-test/d415", "000000003")[2].unlink()
    rendering(tmp_path / "synthetic-val/cup-with-waves-val")
    rendering(tmp_path / "cleargrasp-dataset-train/cup-with-waves-train")
    rendering(tmp_path / "synthetic-val/cup-with-waves-val", "000000001")[0][2].unlink()
    assert list(find_captures(tmp_path)) == ["real-test/d415/000000002", "real-val/d435/000000080"]
    assert list(find_captures(tmp_path, "test")) == ["real-test/d415/000000002"]
    assert list(find_renderings(tmp_path, "val")) == ["synthetic-val/cup-with-waves-val/000000000"]
    both = {synthetic: ClearGrasp(str(tmp_path), synthetic, "val") for synthetic in (False, True)}
    assert both[False].scenes() == ["real-val_d435_000000080"]
    assert both[True].scenes() == ["synthetic-val_cup-with-waves-val_000000000"]
    assert all(data.load(data.scenes()[0]).dataset == data.name for data in both.values())
    assert both[True].evaluation
    assert not ClearGrasp(str(tmp_path), True, "train").evaluation
    with pytest.raises(ValueError, match="split: expected one of val, test, train, null"):
        ClearGrasp(str(tmp_path), False, "tests")


def test_real_captures_agree_outside_of_the_glass(shared):
    data = ClearGrasp(str(shared / "real/cleargrasp"), False)
    assert data.scenes() == ["080", "123"]
    for name in data.scenes():
        scene = data.load(name)
        off = (scene.measured[1] - scene.depth).abs()
        outside, glass = (off[(scene.regions[each] > 0) & off.isfinite()] for each in ("outside", "glass"))
        assert outside.median() < 0.003
        assert (glass > 0.02).double().mean() > 10 * (outside > 0.02).double().mean()

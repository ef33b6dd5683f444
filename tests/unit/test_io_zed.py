"""Pictures of a ZED beside its factory calibration: the rectified photo's camera, units, refusals."""

import captures
import numpy as np
import pytest

from dsr.io.inputs import read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.reading import Reading


def camera_of(folder):
    return read_picture(find_pairs_of_folder(folder).pairs[0], Reading()).camera


def test_frames_have_the_camera_of_the_calibration_and_millimetres(tmp_path):
    pairs = find_pairs_of_folder(captures.zed(tmp_path)).pairs
    assert [pair.name for pair in pairs] == ["000000", "000001", "000002"]
    picture = read_picture(pairs[1], Reading())
    camera = picture.camera
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (700, 700, 650, 355), atol=0.01)
    np.testing.assert_allclose(picture.depth_lr, 1.1)


def test_cameras_that_are_not_parallel_are_rectified(tmp_path):
    """An angle of 0.02 between both is 14 pixels, of which the middle of the photo moves by a part or all."""
    assert 5 < abs(camera_of(captures.zed(tmp_path, CV_HD=0.02)).cx - 650) < 15


def test_translation_is_of_each_resolution_or_of_all_or_0_as_the_files_of_each_age_have_it(tmp_path):
    path = captures.zed(tmp_path, TY_HD=9.0, TZ_HD=-30.0, CV_HD=0.02) / "SN12345.conf"
    text, each = path.read_text(), camera_of(tmp_path)
    path.write_text(text.replace("TY_HD", "TY").replace("TZ_HD", "TZ"))
    assert camera_of(tmp_path) == each
    path.write_text("".join(line for line in text.splitlines(keepends=True) if not line.startswith(("TY", "TZ"))))
    without = camera_of(tmp_path)
    assert without == camera_of(captures.zed(tmp_path, CV_HD=0.02))
    assert without != each


@pytest.mark.parametrize(("name", "size"), [("FHD1200", (1200, 1920)), ("SVGA", (600, 960))])
def test_resolutions_of_a_zed_x_have_sections_of_their_own(tmp_path, name, size):
    path = captures.zed(tmp_path, fx=400.0) / "SN12345.conf"
    path.write_text(path.read_text().replace("_HD", f"_{name}"))
    captures.save(tmp_path / "left000000.png", np.zeros((*size, 3), np.uint8))
    captures.save(tmp_path / "depth000000.png", np.full(size, 900, np.uint16))
    np.testing.assert_allclose(camera_of(tmp_path).fx, 400, atol=0.01)


def test_photos_of_another_size_have_no_camera(tmp_path):
    captures.zed(tmp_path)
    for kind, values in (("left", captures.photo()), ("depth", np.full(captures.SIZE, 900, np.uint16))):
        captures.save(tmp_path / f"{kind}000000.png", values)
    picture = read_picture(find_pairs_of_folder(tmp_path).pairs[0], Reading())
    assert any("SN12345.conf is not used" in str(each) for each in picture.assumptions)


@pytest.mark.parametrize(
    ("old", "new"),
    [("fx=700.0", "fx=x"), ("[STEREO]", "[MONO]"), ("[LEFT_CAM_HD]", "LEFT"), ("cy=355.0", "cy=nan"),
     ("fx=700.0", "fx=0"), ("fy=700.0", "fy=-1e300")],
)  # fmt: skip
def test_damaged_calibrations_are_refused(tmp_path, old, new):
    path = captures.zed(tmp_path) / "SN12345.conf"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ValueError, match=r"SN12345\.conf: ") as caught:
        camera_of(tmp_path)
    assert "\n" not in str(caught.value)


def test_several_calibrations_are_refused(tmp_path):
    path = captures.zed(tmp_path) / "SN12345.conf"
    (tmp_path / "SN2.conf").write_bytes(path.read_bytes())
    with pytest.raises(ValueError, match=r"expected one calibration"):
        find_pairs_of_folder(tmp_path)

"""DDRNet's frames: sensor's map at the photo's size, fused depth as the truth, every damage named."""

import numpy as np
import pytest
from small_files import encoded_png as png

from dsr.data.ddrnet_frames import CAMERA, DDRNetFrames, find_frames, load_frame

ROWS, COLUMNS = np.mgrid[0:480, 0:640]
TRUTH = (1000 + ROWS + 2 * COLUMNS).astype(np.uint16)
"""Millimetres, not symmetric under any flip."""


def frame(root, name="frame_000001"):
    """Write a frame, the sensor 5 mm short, with a hole in one corner and an unknown pixel in the truth's opposite."""
    measured, truth = TRUTH - 5, TRUTH.copy()
    measured[0, 0] = truth[479, 639] = 0
    contents = {"color_map": np.dstack([ROWS % 256] * 3).astype(np.uint8), "depth_map": measured,
                "high_quality_depth": truth}  # fmt: skip
    for folder, pixels in contents.items():
        (root / folder).mkdir(parents=True, exist_ok=True)
        (root / folder / f"{name}.png").write_bytes(png(pixels))
    return tuple(root / folder / f"{name}.png" for folder in contents)


def test_measured_map_and_truth_are_metres_with_holes(tmp_path):
    scene = load_frame(*frame(tmp_path), "ddrnet", "frame_000001")
    assert (scene.dataset, scene.name, scene.camera, scene.unit.name) == ("ddrnet", "frame_000001", CAMERA, "cm")
    assert scene.depth.isnan().nonzero().tolist() == [[0, 479, 639]]
    assert list(scene.measured) == [1]
    assert scene.measured[1].isnan().nonzero().tolist() == [[0, 0, 0]]
    assert scene.depth[0, 10, 20].item() == pytest.approx(1.050)
    assert scene.measured[1][0, 10, 20].item() == pytest.approx(1.045)
    assert (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy) == (536.628, 536.606, 310.591, 234.759)


def test_frames_are_named_by_their_group_and_need_all_three_files(tmp_path):
    frame(tmp_path / "20170907/group1", "frame_000002")
    frame(tmp_path / "20170907/group1")
    for lost in frame(tmp_path / "20170907/group2")[1:]:
        lost.unlink()
    assert list(find_frames(tmp_path)) == ["20170907/group1/frame_000001", "20170907/group1/frame_000002"]
    assert list(find_frames(tmp_path / "20170907/group1")) == ["frame_000001", "frame_000002"]
    data = DDRNetFrames(str(tmp_path))
    assert data.scenes() == ["20170907_group1_frame_000001", "20170907_group1_frame_000002"]
    assert data.evaluation


@pytest.mark.parametrize("which", range(3))
@pytest.mark.parametrize("content", [b"", b"text", png(TRUTH)[:999], png(TRUTH[:, 1:])])
def test_damaged_or_foreign_file_is_refused_in_one_line_that_names_it(tmp_path, capfd, which, content):
    files = frame(tmp_path)
    files[which].write_bytes(content)
    with pytest.raises(ValueError, match="expected") as caught:
        load_frame(*files, "ddrnet", "frame_000001")
    assert capfd.readouterr() == ("", "")
    assert str(caught.value).startswith(f"{files[which]}: expected ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (png(TRUTH * 0), "expected at least one known pixel, all are holes"),
        (png(np.zeros((480, 640), np.uint8)), "expected one channel of 16 bits"),
    ],
)
def test_map_of_holes_or_of_8_bits_is_refused(tmp_path, content, message):
    files = frame(tmp_path)
    files[1].write_bytes(content)
    with pytest.raises(ValueError, match=rf"depth_map/frame_000001\.png: {message}"):
        load_frame(*files, "ddrnet", "frame_000001")


def test_real_frames_are_read(shared):
    data = DDRNetFrames(str(shared / "real/ddrnet"))
    assert data.scenes() == [f"frame_{number:06d}" for number in (1, 3, 5, 7, 9, 11)]
    scene = data.load("frame_000001")
    both = scene.depth.isfinite() & scene.measured[1].isfinite()
    assert int(scene.depth.isfinite().sum()) == 480 * 640 - 258525
    assert (scene.depth - scene.measured[1])[both].abs().median() < 0.005

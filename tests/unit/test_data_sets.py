"""Data sets of files beside each other, of files of our own: values, names, splits, and every damage named."""

import io
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import pytest
from refusals import refused
from small_files import encoded_png as png
from small_files import written

from dsr.data import hammer
from dsr.data.ddrnet_frames import DDRNetFrames
from dsr.data.hammer import Hammer
from dsr.data.icl import ICL
from dsr.data.nyu import NYU
from dsr.data.rgbdd import RGBDD, find_frames
from dsr.data.tartanair import TartanAir


def ramp(height, width, start):
    """Return whole millimetres that are different in every pixel of a row, with a hole in the first one."""
    values = (start + 2 * np.arange(height)[:, None] + np.arange(width)).astype(np.uint16)
    values[0, 0] = 0
    return values


def photo(height, width):
    return np.full((height, width, 3), 51, np.uint8)


def npy(values):
    content = io.BytesIO()
    np.save(content, values)
    return content.getvalue()


@dataclass
class Set:
    """A data set: its files of a frame by path, what they hold, and what the scene has to be."""

    make: Any
    name: str
    files: dict[str, bytes]
    truth: float  # metres at row 10, column 20
    camera: tuple[float, ...]
    measured: dict[float, float] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    absent: dict[str, Any] = field(default_factory=dict)  # settings with which the frame is not found
    count: int | None = None


SIXTY = 1 / np.tan(np.pi / 6) / 2
JPG = cv2.imencode(".jpg", photo(384, 512))[1].tobytes()
SETS = {
    "hammer": Set(Hammer, "scene12_traj1_1_000000", {
        "scene12_traj1_1/polarization/rgb/000000.png": png(photo(52, 68)),
        "scene12_traj1_1/polarization/_gt/000000.png": png(ramp(52, 68, 700)),
        "scene12_traj1_1/polarization/depth_tof/000000.png": png(ramp(52, 68, 720)),
        "scene12_traj1_1/polarization/intrinsics.txt": b"44.17 0 34.1\n0 44.22 24.37\n0 0 1\n",
    }, 0.740, (44.17, 44.22, 34.1, 24.37), {1: 0.760}, {"sensor": "tof"}, {"sensor": "l515"}),
    "ddrnet": Set(DDRNetFrames, "20170907_group1_frame_000001", {
        "20170907/group1/color_map/frame_000001.png": png(photo(480, 640)),
        "20170907/group1/high_quality_depth/frame_000001.png": png(ramp(480, 640, 1000)),
        "20170907/group1/depth_map/frame_000001.png": png(ramp(480, 640, 995)),
    }, 1.040, (536.628, 536.606, 310.591, 234.759), {1: 1.035}),
    "rgbdd": Set(RGBDD, "20200509112638", {
        "plants/plants_test/20200509112638/20200509112638_RGB.jpg": JPG,
        "plants/plants_test/20200509112638/20200509112638_HR_gt.png": png(ramp(384, 512, 1000)),
        "plants/plants_test/20200509112638/20200509112638_LR_fill_depth.png": png(ramp(144, 192, 930)),
    }, 1.040, (512 * SIXTY, 512 * SIXTY, 255.5, 191.5), {8 / 3: 0.970}, {"real": True}, {"split": "train"}, 405),
    "rgbdd in circulation": Set(RGBDD, "20200509112638", {
        "RGB/20200509112638_RGB.jpg": JPG,
        "Depth/20200509112638_HR_gt.png": png(ramp(384, 512, 1000)),
    }, 1.040, (512 * SIXTY, 512 * SIXTY, 255.5, 191.5), {}, {"real": False}, {"real": True}, 405),
    "icl": Set(ICL, "traj_0007", {
        "traj/rgb/7.png": png(photo(480, 640)),
        "traj/depth/7.png": png(ramp(480, 640, 1000)),
    }, 0.208, (481.2, 480, 319.5, 239.5), {}, {"size": None}),
    "tartanair": Set(TartanAir, "office_000000", {
        "office/image_left/000000_left.png": png(photo(480, 640)),
        "office/depth_left/000000_left_depth.npy": npy(ramp(480, 640, 1000).astype(np.float32) / 1024),
    }, 1040 / 1024, (320, 320, 320, 240), {}, {"size": None}),
    "nyu": Set(NYU, "1001", {
        "DCTNet/RGB/1000.jpg": cv2.imencode(".jpg", photo(480, 640))[1].tobytes(),
        "DCTNet/Depth/1000.npy": npy(ramp(480, 640, 1000).astype(np.float32) / 1024),
    }, 1040 / 1024, (518.857901, 519.469611, 324.582449, 252.736166), {}, {"split": "test"}, {"split": "train"}, 449),
}  # fmt: skip
FOREIGN = {
    "empty": b"", "text": b"text", "8 bits": png(np.full((9, 9), 7, np.uint8)), "small": png(ramp(9, 9, 900)),
    "small array": npy(ramp(9, 9, 900).astype(np.float32)),
}  # fmt: skip


def write_frame(name, folder):
    for path, content in SETS[name].files.items():
        written(folder / path, content)
    return SETS[name]


@pytest.fixture(params=SETS)
def kind(request, tmp_path):
    return write_frame(request.param, tmp_path)


def opened(kind, folder, **settings):
    return kind.make(str(folder), **{"scenes": "found", **kind.settings, **settings})


def test_scene_is_in_metres_with_its_camera_and_holes(kind, tmp_path):
    scene = opened(kind, tmp_path).load(kind.name)
    assert scene.rgb.unique().tolist() == pytest.approx([0.2])
    camera = scene.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(kind.camera)
    assert {ratio: each[0, 10, 20].item() for ratio, each in scene.measured.items()} == pytest.approx(kind.measured)
    for each in (scene.depth, *scene.measured.values()):
        assert each.isnan().nonzero().tolist() == [[0, 0, 0]]
    assert scene.depth[0, 10, 20].item() == pytest.approx(kind.truth)


def test_frames_are_found_from_a_directory_above_and_need_all_their_files(kind, tmp_path):
    data = opened(kind, tmp_path)
    assert (data.scenes(), data.evaluation) == ([kind.name], True)
    if kind.absent:
        with pytest.raises(ValueError, match="no scene of it"):
            opened(kind, tmp_path, **kind.absent)
    if kind.count:
        with pytest.raises(ValueError, match=f"got 1 of {kind.count} scenes"):
            opened(kind, tmp_path, scenes=None)
    for key in {"split", "sensor"} & kind.make.__init__.__annotations__.keys():
        with pytest.raises(ValueError, match=f"{key}: expected one of .*, got nosuch"):
            opened(kind, tmp_path, **{key: "nosuch"})
    (tmp_path / list(kind.files)[-1]).unlink()
    with pytest.raises(ValueError, match="no scene of it"):
        opened(kind, tmp_path)


@pytest.mark.parametrize("content", FOREIGN.values(), ids=FOREIGN)
def test_damaged_or_foreign_file_is_refused_in_one_line_that_names_it(kind, tmp_path, capfd, content):
    data = opened(kind, tmp_path)
    for number, (path, right) in enumerate(kind.files.items()):
        for wrong in (content, right[: len(right) // 2]):
            (tmp_path / path).write_bytes(wrong)
            if number == 0 and wrong[:4] == png(photo(1, 1))[:4] and wrong is content:
                with pytest.raises(ValueError, match="expected"):  # a small photo: that of its map does not fit
                    data.load(kind.name)
            else:
                assert refused(lambda: data.load(kind.name), tmp_path / path, capfd).startswith("expected ")
            (tmp_path / path).write_bytes(right)
    data.load(kind.name)


def test_map_of_holes_is_refused(kind, tmp_path, capfd):
    path = tmp_path / list(kind.files)[1]
    right = np.load(path) if path.suffix == ".npy" else cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    path.write_bytes((npy if path.suffix == ".npy" else png)(0 * right))
    data = opened(kind, tmp_path)
    assert "all are holes" in refused(lambda: data.load(kind.name), path, capfd)


def test_scenes_12_to_14_of_hammer_are_to_test_on_and_naked_ones_are_left_out(tmp_path):
    for sequence in ("scene14_traj2_2", "scene2_traj1_1", "scene12_traj1_1", "scene12_traj1_naked_1"):
        for path, content in SETS["hammer"].files.items():
            for name in (path, path.replace("tof", "d435")):
                written(tmp_path / "_dataset_processed" / name.replace("scene12_traj1_1", sequence), content)
    names = ["scene12_traj1_1/000000", "scene14_traj2_2/000000"]
    assert list(hammer.find_frames(tmp_path, split="test")) == names
    (tmp_path / "_dataset_processed/scene14_traj2_2/polarization/depth_tof/000000.png").unlink()
    assert list(hammer.find_frames(tmp_path, "tof", "test")) == names[:1]
    assert list(hammer.find_frames(tmp_path, split="train")) == ["scene2_traj1_1/000000"]
    assert list(hammer.find_frames(tmp_path, naked=True)) == ["scene12_traj1_naked_1/000000"]
    assert (Hammer(str(tmp_path)).evaluation, Hammer(str(tmp_path), split="train").evaluation) == (True, False)


def test_both_layouts_of_rgbdd_and_their_splits_are_found(tmp_path):
    def image(folder, name, layout, count=3):
        for path, content in list(SETS[layout].files.items())[:count]:
            written(
                tmp_path / folder / path.replace("plants/plants_test/", "").replace(SETS[layout].name, name), content
            )

    image("flat", "20200101000001", "rgbdd in circulation")
    image("portraits/portraits_test", "20200101000002", "rgbdd")
    image("plants/plants_train", "20200101000003", "rgbdd")
    image("models/models_train", "20200101000004", "rgbdd", 2)
    image("lights/lights_test", "20200101000005", "rgbdd")
    one, two, three, four = (f"2020010100000{number}" for number in (1, 2, 3, 4))
    assert list(find_frames(tmp_path)) == [one, two, three, four]
    assert list(find_frames(tmp_path, "test")) == [one, two]
    assert list(find_frames(tmp_path, "train", measured=True)) == [three]
    assert not RGBDD(str(tmp_path), True, "train", "found").evaluation


def test_real_frames_are_read(shared):
    data = DDRNetFrames(str(shared / "real/ddrnet"))
    assert data.scenes() == [f"frame_{number:06d}" for number in (1, 3, 5, 7, 9, 11)]
    scene = data.load("frame_000001")
    both = scene.depth.isfinite() & scene.measured[1].isfinite()
    assert int(scene.depth.isfinite().sum()) == 480 * 640 - 258525
    assert (scene.depth - scene.measured[1])[both].abs().median() < 0.005
    assert len(RGBDD(str(shared / "modern/RGBDD"), real=False, scenes="found").scenes()) == 21
    scene = RGBDD(str(shared / "real/rgbdd_real"), real=True, scenes="found").load("20200509112638")
    [measured] = scene.measured.values()
    assert abs(scene.depth.median() - measured.median()) < 0.05

"""Data sets, of files of our own: values, names, splits, and every damage named."""

from pathlib import Path

import numpy as np
import pytest
from data_set_files import SETS, exr, npy, opened, ramp, write_frame
from refusals import refused
from small_files import encoded_png as png
from small_files import written

from dsr.data import hammer
from dsr.data.cleargrasp import ClearGrasp
from dsr.data.ddrnet_frames import DDRNetFrames
from dsr.data.detection import find_scenes
from dsr.data.eight_bit import NOTE, EightBit
from dsr.data.hammer import Hammer
from dsr.data.icl import ICL
from dsr.data.middlebury import Middlebury, MiddleburyLevels
from dsr.data.nyu import NYU
from dsr.data.rgbdd import RGBDD, find_frames
from dsr.data.sintel import Sintel
from dsr.data.stereo_board import StereoBoard
from dsr.data.sunrgbd import SunRGBD
from dsr.data.tartanair import TartanAir
from dsr.data.tofmark import ToFMark

FOREIGN = {
    "empty": b"", "text": b"text", "8 bits": png(np.full((9, 9), 7, np.uint8)), "small": png(ramp(9, 9, 900)),
    "small array": npy(ramp(9, 9, 900).astype(np.float32)), "truncated": None,
}  # fmt: skip


@pytest.fixture(params=SETS)
def kind(request, tmp_path):
    return write_frame(request.param, tmp_path)


def test_scene_is_in_metres_with_its_camera_and_holes(kind, tmp_path):
    scene = opened(kind, tmp_path).load(kind.name)
    assert (scene.name, scene.rgb.unique().tolist()) == (kind.name, pytest.approx([0.2]))
    camera = scene.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(kind.camera)
    assert {ratio: each[0, 10, 20].item() for ratio, each in scene.measured.items()} == pytest.approx(kind.measured)
    truth = [] if kind.truth is None else [scene.depth]
    for each in (*truth, *scene.measured.values()):
        assert each.isnan().nonzero().tolist() == ([] if scene.unit.name == "levels" else [[0, 0, 0]])
    assert [each[0, 10, 20].item() for each in truth] == pytest.approx([kind.truth] if truth else [])


def test_frames_are_found_from_a_directory_above_and_need_all_their_files(kind, tmp_path):
    data = opened(kind, tmp_path)
    assert (data.scenes(), data.evaluation) == ([kind.name], kind.make is not Sintel)
    if kind.absent:
        with pytest.raises(ValueError, match="no scene of it"):
            opened(kind, tmp_path, **kind.absent)
    if kind.count:
        with pytest.raises(ValueError, match=f"expected .* got [01] of {kind.count} scenes; .*scenes=found"):
            opened(kind, tmp_path, scenes=None)
    for key in {"split", "sensor", "benchmark"} & kind.make.__init__.__annotations__.keys():
        with pytest.raises(ValueError, match=f"{key}: expected one of .*, got 'nosuch'"):
            opened(kind, tmp_path, **{key: "nosuch"})
    (tmp_path / list(kind.files)[-1]).unlink()
    with pytest.raises(ValueError, match=r"no scene of it|expected .*, (there is none|got 0)"):
        opened(kind, tmp_path).load(kind.name)


def test_fingerprint_changes_with_every_file(kind, tmp_path):
    data = opened(kind, tmp_path)
    prints = {data.fingerprint(kind.name)}
    for path in kind.files:
        (tmp_path / path).write_bytes(b"other")
        prints.add(data.fingerprint(kind.name))
    assert len(prints) == 1 + len(kind.files)


@pytest.mark.parametrize("content", FOREIGN.values(), ids=FOREIGN)
def test_damaged_or_foreign_file_is_refused_in_one_line_that_names_it(kind, tmp_path, capfd, content):
    data = opened(kind, tmp_path)
    for number, (path, right) in enumerate(kind.files.items()):
        wrong = right[: len(right) // 2] if content is None else content
        if wrong == b"27":  # half of 270 is a number, too
            continue
        (tmp_path / path).write_bytes(wrong)
        if number == 0 and content and content.startswith(b"\x89PNG"):
            with pytest.raises(ValueError, match="expected"):  # a small photo: that of its map does not fit
                data.load(kind.name)
        else:
            assert "expected " in refused(lambda: data.load(kind.name), tmp_path / path, capfd)
        (tmp_path / path).write_bytes(right)


NEGATIVE = {"cleargrasp": exr(-1.0 - np.ones((36, 64))), "tartanair": npy(-np.ones((480, 640), np.float32))}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [*((name, kind.holes, "expected at least one known") for name, kind in SETS.items() if kind.holes),
     *((name, content, "expected positive depth") for name, content in NEGATIVE.items())],
)  # fmt: skip
def test_map_of_holes_or_negative_depth_is_refused(tmp_path, capfd, name, content, message):
    kind = write_frame(name, tmp_path)
    path = written(tmp_path / list(kind.files)[-1], content)
    data = opened(kind, tmp_path)
    assert message in refused(lambda: data.load(kind.name), path, capfd)


TOGETHER = ("lu", "middlebury8", "nyu", "rgbdd in circulation", "ddrnet")


@pytest.mark.parametrize("together", [False, True])
def test_benchmarks_are_detected_each_once_and_by_its_own_reader(tmp_path, together):
    for name in TOGETHER:
        for path, content in SETS["lu" if name == "middlebury8" else name].files.items():
            file = Path(path.removeprefix("Lu/").removeprefix("DCTNet/").removeprefix("20170907/group1/"))
            if name == "middlebury8":
                file = Path(str(file).replace("RGBD_", "Middlebury_").replace("ouput", "output"))
            written(tmp_path / ("" if together else name) / file, content)
    scenes = [load() for _, load in find_scenes(tmp_path)]
    assert sorted(scene.dataset for scene in scenes) == sorted(
        name.removesuffix(" in circulation") for name in TOGETHER
    )
    units = {scene.dataset: scene.unit.name for scene in scenes}
    assert {name for name, unit in units.items() if unit == "levels"} == {"lu", "middlebury8"}


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
    def image(folder, name, layout, without=" "):
        for path, content in SETS[layout].files.items():
            if without not in path:
                file = path.replace("plants/plants_test/", "").replace(SETS[layout].name, name)
                written(tmp_path / folder / file, content)

    image("flat", "20200101000001", "rgbdd in circulation")
    image("portraits/portraits_test", "20200101000002", "rgbdd")
    image("plants/plants_train", "20200101000003", "rgbdd")
    image("models/models_train", "20200101000004", "rgbdd", "_LR_")
    image("lights/lights_test", "20200101000005", "rgbdd")
    one, two, three, four = (f"2020010100000{number}" for number in (1, 2, 3, 4))
    assert list(find_frames(tmp_path)) == [one, two, three, four]
    assert list(find_frames(tmp_path, "test")) == [one, two]
    assert list(find_frames(tmp_path, "train", measured=True)) == [three]
    assert not RGBDD(str(tmp_path), True, "train", "found").evaluation


TOFMARK = {"intrinsics": [550.0, 550.0, 404.5, 304.5], "depth_range": [0.38, 0.93]}
REAL = [
    (TartanAir, "real/tartanair", {"size": None}, 1, "000000", (480, 640), [1.838]),
    (ICL, "real/icl_nuim", {"size": None}, 2, "living", (480, 640), [3.028]),
    (EightBit, "modern", {"benchmark": "middlebury8"}, 30, "Middlebury_30", (381, 432), [2.310]),
    (DDRNetFrames, "real/ddrnet", {}, 6, "frame_000001", (480, 640), [1.355, 1.353]),
    (RGBDD, "modern/RGBDD", {"real": False}, 21, "20200509112638", (384, 512), [1.728]),
    (RGBDD, "real/rgbdd_real", {"real": True}, 2, "20200509112638", (384, 512), [1.728, 1.745]),
    (ClearGrasp, "real/cleargrasp", {"synthetic": False}, 2, "080", (720, 1280), [0.599, 0.619]),
    (StereoBoard, "real/stereo_board", {}, 5, "14", (1080, 1920), [1.206, 1.036]),
    (NYU, "modern/NYU", {"split": "test"}, 3, "1001", (480, 640), [2.962]),
    (Middlebury, "real/middlebury2014", {"size": None}, 10, "artl", (277, 347), [1.776]),
    (MiddleburyLevels, "real/middlebury2006", {"year": 2006, "size": None}, 8, "aloe", (370, 427), [2.308]),
    (MiddleburyLevels, "real/middlebury2005", {"year": 2005, "size": None, "smooth": False}, 3, "art", (1088, 1376),
     [1.776, 1.786, 1.786]),
    (SunRGBD, "real/sunrgbd", {"size": None}, 2, "img_0063", (427, 561), [1.963]),
    (ToFMark, "real/tofmark", TOFMARK, 3, "devil", (610, 810), [0.757, 0.763]),
]  # fmt: skip


@pytest.mark.parametrize(("make", "folder", "settings", "count", "name", "size", "medians"), REAL)
def test_real_scenes_are_read_in_metres(shared, dsr_cache, make, folder, settings, count, name, size, medians):
    """``medians``: of the depth, and of the measured maps."""
    data = make(str(shared / folder), **{"scenes": "found", **settings})
    assert len(data.scenes()) == count
    scene = data.load(name)
    maps = [each for each in (scene.depth, *scene.measured.values()) if each is not None]
    assert [each.nanmedian().item() for each in maps] == pytest.approx(medians, abs=1e-3)
    assert (scene.rgb.shape[1:], NOTE in scene.notes) == (size, make is EightBit)
    if "size" in settings and max(size) < 1000:  # squares, as in an evaluation; of large scenes that takes long
        small = make(str(shared / folder), **{**settings, "scenes": [name], "size": 64}).load(name)
        assert small.rgb.shape[1:] == small.depth.shape[1:] == (64, 64)

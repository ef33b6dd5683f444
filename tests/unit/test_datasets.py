"""The paper's scenes by name, and that none of them is trained on."""

from pathlib import Path

import pytest
import yaml
from small_files import touch

from dsr.data.middlebury import EVALUATION_2014, TRAINING, Middlebury, MiddleburyLevels, MiddleburyTrain
from dsr.data.rendered import Procedural, SimGeo
from dsr.data.scene_source import Preparation
from dsr.data.sunrgbd import SunRGBD
from dsr.data.tofmark import SCENES as TOFMARK_SCENES
from dsr.data.tofmark import ToFMark
from dsr.report.paper import published_row
from dsr.synthetic.simgeo import SCENES as SIMGEO_SCENES
from dsr.utils.configuration import ConfigError, build

CONF = Path(__file__).resolve().parents[2] / "conf" / "dataset"


def stereo_2014(root, names):
    return str(touch(root, *(f"{name.title()}-perfect/calib.txt" for name in names)))


def node(name):
    """Return a data set's configuration, with environment variables left alone."""
    return yaml.safe_load((CONF / f"{name}.yaml").read_text())


ICL_FRAMES, SUN_FRAMES = (node(name)["frames"] for name in ("icl", "sunrgbd"))


def test_evaluation_set_has_34_images_and_icl_and_middlebury_have_rows_in_the_paper_tables():
    scenes = (SIMGEO_SCENES, ICL_FRAMES, EVALUATION_2014, SUN_FRAMES, TOFMARK_SCENES)
    assert [len(each) for each in scenes] == [6, 6, 7, 12, 3]
    for scene in (*ICL_FRAMES, *EVALUATION_2014):
        for scale in (4, 8):
            assert published_row(scene, "Bicubic", scale) is not None


@pytest.mark.parametrize(
    "name", [path.stem for path in CONF.glob("*.yaml") if path.stem not in ("mixture", "paper_train")]
)
def test_dataset_configurations_build_their_classes(name, tmp_path, monkeypatch):
    entries = {**node(name), "root": str(tmp_path / "nowhere")} if "root" in node(name) else node(name)
    if name in ("simgeo", "procedural"):
        assert build("dataset", entries).scenes()
        return
    with pytest.raises(ConfigError, match="nowhere") as refusal:
        build("dataset", entries)
    message = str(refusal.value)
    assert "\n" not in message
    assert name == "folder" or f"get it with: dsr data get {name}; or say where it is: dataset.root=DIR" in message


def test_frames_can_be_chosen_in_the_configuration(tmp_path):
    root = str(touch(tmp_path, *(f"{where}/{what}/{number}.png" for where in ("x", "y") for what in ("rgb", "depth")
                                 for number in (0, 7))))  # fmt: skip
    entries = {**node("icl"), "root": root, "frames": {**ICL_FRAMES, "sofa": "y/0007"}, "scenes": ["sofa", "x_0000"]}
    assert build("dataset", entries).scenes() == ["sofa", "x_0000"]
    with pytest.raises(ConfigError, match="got 1 of 6 scenes"):  # the others are not those of the paper
        build("dataset", {**entries, "scenes": None})
    with pytest.raises(ConfigError, match=r"dataset\.frames: expected .*, got \['a'\]"):
        build("dataset", {**entries, "frames": ["a"]})


def test_sun_rgbd_scenes_are_found_below_any_folder_by_path_or_prefix(tmp_path):
    paths = [*list(SUN_FRAMES.values())[:-1], "xtion/sun3ddata/brown_bm_2/brown_bm_2/b", "kv1/NYUdata/NYU00011"]
    root = touch(tmp_path, *(f"SUNRGBD/{path}/{part}/x" for path in paths for part in ("image", "depth")),
                 "SUNRGBD/xtion/sun3ddata/brown_bm_2/brown_bm_2/a/image/x",
                 "SUNRGBD/xtion/sun3ddata/brown_bm_2/brown_bm_2/a/depth/x")  # fmt: skip
    data = SunRGBD(str(root), frames=SUN_FRAMES)
    assert data.scenes() == list(SUN_FRAMES)
    assert "brown_bm_2_a" in data._found["xtion_3"].files[0].as_posix().replace("/", "_")
    assert len(SunRGBD(str(root), "found", frames=SUN_FRAMES).scenes()) == 14


def test_middlebury_has_the_scenes_of_the_paper_and_none_of_them_is_trained_on(tmp_path):
    training = {scene for scenes in TRAINING.values() for scene in scenes}
    assert not training & set(EVALUATION_2014)
    assert not set(TRAINING[2014]) & (set(ICL_FRAMES) | set(SIMGEO_SCENES) | set(SUN_FRAMES) | set(TOFMARK_SCENES))
    root = stereo_2014(tmp_path / "middlebury2014", (*EVALUATION_2014, *TRAINING[2014]))
    assert Middlebury(root).scenes() == list(EVALUATION_2014)
    assert sorted(Middlebury(root, "found").scenes()) == sorted((*EVALUATION_2014, *TRAINING[2014]))
    assert sorted(MiddleburyTrain(str(tmp_path), "found").scenes()) == sorted(TRAINING[2014])
    for scene in EVALUATION_2014:
        with pytest.raises(ValueError, match=f"'{scene}' is not there"):
            MiddleburyTrain(str(tmp_path), [scene])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda root: MiddleburyLevels(root, 2007), "year: expected one of 2001, 2003, 2005, 2006, got 2007"),
        (lambda root: MiddleburyTrain(root, years=[2005]), "years: expected some of 2001, 2006, 2014, got 2005"),
        (lambda root: SunRGBD(root, intrinsics=[1.0]), "intrinsics: expected fx, fy, cx, cy, got 1 numbers"),
        (lambda root: ToFMark(root, depth_range=[1.0]), "depth_range: expected 2 numbers, got 1"),
        (lambda _: Preparation(size=31), "size: expected at least 32 pixels, got 31"),
        (lambda _: Preparation(crop=1.5), r"crop: expected a number from 0 to 1, or null, got 1\.5"),
        (lambda _: SimGeo(size=31), "size: expected at least 32 pixels, got 31"),
        (lambda _: Procedural(count=0), "dataset: expected count at least 1 .* got 0 and 0"),
        (lambda _: Procedural(size=16), "size: expected at least 32 pixels, got 16"),
        (lambda _: Procedural(seed=-1), "dataset: expected .* seed at least 0, got 200 and -1"),
    ],
)
def test_values_out_of_range_are_refused(tmp_path, make, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        make(str(tmp_path))

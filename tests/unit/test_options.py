"""Options of a command as fields of dataclasses, by those of ``dsr upsample`` and other commands."""

import math
from pathlib import Path

import pytest

from dsr.app.requests import ReportRequest, ViewRequest
from dsr.app.upsample.parts import PARTS, Results
from dsr.app.upsample.request import FrameChoice, UpsampleRequest, Upsampling
from dsr.cli import main, make_parser
from dsr.io.reading import CameraChoice, Reading, RigFiles
from dsr.utils.options import OptionError, build

OUT = Path("out")


def asked(words, record=UpsampleRequest):
    """Return the record of a command line of ``dsr upsample a`` or another command."""
    name, given = ("upsample", ["a"]) if record is UpsampleRequest else (record.__name__.lower()[: -len("request")], [])
    return build(record, make_parser().parse_args([name, *given, *words.split(), "-o", "out"]))


def test_values_are_read_by_their_types():
    given = asked(
        "b --depth-unit 1/5000 --intrinsics 60 61 32 24 --only depth,normals --with cloud --shard 2/3 --fill none "
        "--method tgv --set iterations=7 --set tolerance=0.1 --max-hole 3 --overwrite"
    )
    assert given.frames == FrameChoice(folders=(Path("a"), Path("b")), shard=given.frames.shard)
    assert (given.frames.shard.number, given.frames.shard.count) == (2, 3)
    assert given.reading == Reading(camera=CameraChoice(intrinsics=(60.0, 61.0, 32.0, 24.0)), unit=1 / 5000)
    settings = (("iterations", 7), ("tolerance", 0.1))
    assert given.upsampling == Upsampling(method="tgv", settings=settings, fill="none", max_hole=3.0)
    assert given.results == Results(output=OUT, only=("depth", "normals"), more=("cloud",), overwrite=True)
    assert asked("runs --scale 2 2.5 --only tables", ReportRequest).scales == (2.0, 2.5)
    view = build(ViewRequest, make_parser().parse_args(["view", "out", "--no-open"]))
    assert view == ViewRequest(output=OUT, open_page=False)


@pytest.mark.parametrize(
    ("words", "name", "wrong", "message"),
    [
        ("--max-hole 0", "max_hole", lambda: Upsampling(max_hole=0.0), "a positive number of degrees, got 0"),
        ("--workers 0", "workers", lambda: FrameChoice(folders=(OUT,), workers=0), "at least 1, got 0"),
        ("--fov 180", "fov", lambda: CameraChoice(fov=180.0), "degrees from 1 to below 180, got 180"),
        ("--fov 60", "fov", lambda: CameraChoice(fov="much"), "degrees from 1 to below 180, got 'much'"),
        ("--format pgn", "format", lambda: Results(output=OUT, format="pgn"), "one of png, .*; did you mean png?"),
        ("b --poses p", "poses", lambda: FrameChoice(folders=(OUT, OUT), poses=OUT), "the frames of one folder, got 2"),
        ("--noise 1 --set noise=2", "noise", lambda: Upsampling(noise=1.0, settings=(("noise", 2),)), "it once, got"),
    ],
)
def test_wrong_value_is_named_as_a_flag_and_as_an_argument(words, name, wrong, message):
    pattern = message.replace("?", r"\?")
    with pytest.raises(OptionError, match=f"^{name}: expected {pattern}"):
        wrong()
    if "much" not in message:  # a value of another type, from Python
        with pytest.raises(ValueError, match=f"^--{name.replace('_', '-')}: expected {pattern}"):
            asked(words)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--set k", "--set k: expected KEY=VALUE"),
        ("--noise 1 --set noise=1", "--noise: expected it once, got --set noise=1, too"),
        ("--depth-unit ell", "--depth-unit: expected m, cm, mm or "),
        ("--extrinsics m.txt", "--extrinsics: expected --depth-camera with it"),
        ("--for robot --fill small", "--for robot: expected --fill none or none with it, got --fill small"),
        ("--only nothing", "--only: expected some of depth, .*, got 'nothing'"),
    ],
)
def test_value_that_cannot_be_used_is_one_line_with_the_flag(words, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        asked(words)


def test_options_that_go_together_and_one_that_stands_for_others():
    rig = asked("--extrinsics m.txt --depth-camera c.json").reading.rig
    assert rig == RigFiles(camera=Path("c.json"), extrinsics=Path("m.txt"))
    assert asked("").reading.rig is None
    robot = asked("--for robot --format mm")
    assert (robot.upsampling.fill, robot.results.certain, robot.results.format) == ("none", True, "mm")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("upsample -o out --fill some", "--fill: expected one of "),
        ("upsample -o out --fov 60 --camera c.json", "--camera: not allowed with argument --fov"),
        ("upsample -o out --rgb= --depth d.png", "--rgb: expected a path, got an empty text"),
        ("study build RUNS= -o out", ""),
    ],
)
def test_value_of_another_type_ends_with_the_usage(words, said, capsys):
    given = [word.removeprefix("RUNS=") for word in words.split()]
    with pytest.raises(SystemExit, match="2"):
        main(given)
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "of_frame", "of_all"),
    [
        ({"only": ("normals", "depth")}, ["depth", "normals"], []),
        ({"only": ("cloud",), "more": ("open3d",)}, ["depth", "cloud", "rgbd"], ["open3d"]),
        ({"only": ("nerfstudio", "gaussian")}, ["depth", "rgbd"], ["nerfstudio", "gaussian"]),
        ({"without": ("mesh",)}, [name for name in PARTS if PARTS[name].usual and name != "mesh"], []),
    ],
)
def test_parts_are_those_asked_for_and_what_they_are_made_of(options, of_frame, of_all):
    wanted = Results(output=OUT, **options)
    assert [part.name for part in wanted.of_frame] == of_frame
    assert [part.name for part in wanted.of_all] == of_all


def test_settings_are_all_options_that_a_result_depends_on():
    settings = UpsampleRequest(
        frames=FrameChoice(folders=(Path("in"),), workers=3),
        reading=Reading(camera=CameraChoice(intrinsics=(1.0, 2.0, 3.0, 4.0)), unit="sunrgbd", hole_value=math.nan),
        upsampling=Upsampling(settings=(("noise_growth", 1.0),), noise=0.01, device="cuda"),
        results=Results(output=OUT, max_error=1.0, overwrite=True),
    ).settings
    assert (settings["depth_unit"], settings["intrinsics"]) == ("sunrgbd", [1.0, 2.0, 3.0, 4.0])
    assert settings["hole_value"] is None  # NaN is a hole anyway
    assert (settings["set"], settings["max_error"]) == ({"noise_growth": 1.0, "noise": 0.01}, 0.01)
    assert {"workers", "device", "overwrite", "output", "folders"} & set(settings) == set()

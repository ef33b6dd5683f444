"""Options of a command as fields of dataclasses."""

from argparse import ArgumentParser
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from dsr.utils.options import (
    OptionError,
    Options,
    Rule,
    add_options,
    at_least,
    build,
    group,
    one_of,
    option,
    positive,
    recorded,
)


def _words(text):
    return tuple(text.split(","))


def _entries(texts):
    if any("=" not in text for text in texts):
        raise ValueError("expected KEY=VALUE")
    return dict(text.split("=") for text in texts)


@dataclass(frozen=True, kw_only=True)
class Gain(Options):
    gain: float = option(1.0, "a gain", rule=positive("number"))


@dataclass(frozen=True, kw_only=True)
class Rig(Options):
    file: Path = option(..., "camera of the rig", flags="--rig-camera")
    pose: Path = option(..., "its pose")
    gain: float = option(1.0, "its gain")


@dataclass(frozen=True, kw_only=True)
class Camera(Options):
    file: Path | None = option(None, "a file", flags="--camera", alone="camera", recorded=False)
    fov: float | None = option(None, "degrees", "DEG", alone="camera", rule=Rule("below 180", lambda x: x < 180))
    intrinsics: tuple[float, float, float, float] | None = option(None, "four", ("FX", "FY", "CX", "CY"))
    rig: Rig | None = group()


@dataclass(frozen=True, kw_only=True)
class Request(Options):
    folders: tuple[Path, ...] = option((), "folders", "DIR", flags="folders")
    output: Path = option(..., "where to", flags="-o --output")
    unit: Literal["m", "mm"] = option("m", "of the depth")
    ratios: tuple[float, ...] = option((), "some", rule=Rule("numbers above 0", lambda x: x > 0, each=True))
    only: tuple[str, ...] = option(
        ("a", "b"), "parts", parse=_words, rule=Rule("some of a, b", "ab".__contains__, each=True)
    )
    extra: tuple[Path, ...] = option((), "more", repeated=True)
    settings: dict[str, str] | None = option(None, "KEY=VALUE", flags="--set", parse=_entries, repeated=True)
    light: str = option("e1", "a light", rule=one_of(("e1", "e2")))
    max_hole: float = option(2.0, "the widest, 100 % of it", rule=positive("number of degrees"))
    workers: int = option(1, "processes", rule=at_least(1), recorded=False)
    overwrite: bool = option(False, "replace")
    show: bool = option(True, "only write", flags="--no-show")
    camera: Camera = group(Camera, "the camera")

    def __post_init__(self):
        super().__post_init__()
        if self.overwrite and self.camera.fov is not None:
            raise OptionError("fov", "expected no --overwrite")


def _parse(*words):
    parser = ArgumentParser()
    add_options(parser, Request)
    return build(Request, parser.parse_args(["-o", "out", *words]))


def test_values_are_read_by_their_types():
    words = (
        "a b --unit mm --ratios 2 2.5 --only a --extra x --extra y --set k=1 --set l=2 --light e2 "
        "--max-hole 3 --workers 2 --overwrite --no-show --intrinsics 1 2 3 4"
    )
    given = _parse(*words.split())
    assert given == Request(
        folders=(Path("a"), Path("b")),
        output=Path("out"),
        unit="mm",
        ratios=(2.0, 2.5),
        only=("a",),
        extra=(Path("x"), Path("y")),
        settings={"k": "1", "l": "2"},
        light="e2",
        max_hole=3.0,
        workers=2,
        overwrite=True,
        show=False,
        camera=Camera(intrinsics=(1.0, 2.0, 3.0, 4.0)),
    )


@pytest.mark.parametrize(
    ("words", "name", "values", "message"),
    [
        ("--max-hole 0", "max_hole", {"max_hole": 0.0}, "expected a positive number of degrees, got 0"),
        ("--workers 0", "workers", {"workers": 0}, "expected at least 1, got 0"),
        ("--light e9", "light", {"light": "e9"}, "expected one of e1, e2, got 'e9'"),
        ("--only a,c", "only", {"only": ("a", "c")}, "expected some of a, b, got 'c'"),
        ("--ratios 2 -1", "ratios", {"ratios": (2.0, -1.0)}, "expected numbers above 0, got -1"),
        ("--fov 60 --overwrite", "fov", {"overwrite": True, "camera": Camera(fov=60.0)}, "expected no --overwrite"),
    ],
)
def test_wrong_value_is_named_as_a_flag_and_as_an_argument(words, name, values, message):
    with pytest.raises(ValueError, match=f"^--{name.replace('_', '-')}: {message}$"):
        _parse(*words.split())
    with pytest.raises(OptionError, match=f"^{name}: {message}$"):
        Request(output=Path("out"), **values)


def test_value_of_another_type_from_python_is_refused_as_any_other():
    with pytest.raises(OptionError, match="gain: expected a positive number, got 'much'"):
        Gain(gain="much")


def test_value_that_cannot_be_parsed_is_one_line_with_the_flag():
    with pytest.raises(ValueError, match=r"^--set: expected KEY=VALUE$"):
        _parse("--set", "k")


@pytest.mark.parametrize(
    "words", ["--unit cm", "--fov wide", "--intrinsics 1 2 3", "--fov 60 --camera c.json", "--ratios"]
)
def test_value_of_another_type_ends_with_the_usage(words, capsys):
    with pytest.raises(SystemExit, match="2"):
        _parse(*words.split())
    assert words.split()[0] in capsys.readouterr().err


def test_required_option_has_to_be_given(capsys):
    parser = ArgumentParser()
    add_options(parser, Request)
    with pytest.raises(SystemExit):
        parser.parse_args([])
    assert "--output" in capsys.readouterr().err


def test_group_that_may_be_left_out_is_given_as_a_whole():
    assert _parse().camera.rig is None
    rig = _parse("--pose", "p.txt", "--rig-camera", "c.json").camera.rig
    assert rig == Rig(file=Path("c.json"), pose=Path("p.txt"))
    with pytest.raises(ValueError, match=r"^--pose: expected --rig-camera with it$"):
        _parse("--pose", "p.txt")
    with pytest.raises(ValueError, match=r"^--gain: expected --rig-camera with it$"):
        _parse("--gain", "2")


@dataclass(frozen=True, kw_only=True)
class Preset(Options):
    """Options, one of which stands for others."""

    purpose: Literal["cut", "keep"] | None = option(
        None, "what for", flags="--for", presets={"cut": {"depth": 3, "sharp": True}, "keep": {}}
    )
    depth: int = option(1, "how deep", "N")
    sharp: bool = option(False, "whether it is sharp")


def test_option_stands_for_others_and_refuses_what_contradicts_it():
    parser = ArgumentParser()
    add_options(parser, Preset)

    def given(*words):
        made = build(Preset, parser.parse_args(words))
        return made.depth, made.sharp

    assert given() == given("--for", "keep") == (1, False)
    assert given("--for", "cut") == given("--for", "cut", "--depth", "3") == (3, True)
    with pytest.raises(ValueError, match=r"^--for cut: expected --depth 3 or none with it, got --depth 2$"):
        given("--for", "cut", "--depth", "2")


def test_recorded_are_the_options_that_results_depend_on():
    entries = recorded(_parse("--fov", "60", "--pose", "p", "--rig-camera", "c", "--workers", "3"))
    assert {"camera", "workers"} & set(entries) == set()
    assert (entries["fov"], entries["rig_camera"], entries["only"]) == (60.0, Path("c"), ["a", "b"])

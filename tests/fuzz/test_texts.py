"""What people type and what short files say: anything at all ends with a value or with one line."""

import contextlib
import io
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from dsr.app.entry import run_command
from dsr.cli import main
from dsr.geometry.camera import Camera
from dsr.io.cameras import read_any_camera
from dsr.io.images import CameraFile, read_camera
from dsr.io.reading import parse_unit
from dsr.io.trajectories import read_poses, read_transform
from dsr.utils.console import one_line
from fuzz.values import NUMBERS

checked = settings(
    derandomize=True, database=None, deadline=None, max_examples=100, suppress_health_check=list(HealthCheck)
)
few = settings(checked, max_examples=10)
LINES = st.text(st.characters(codec="utf-8"), max_size=40)
NUMBER_TEXTS = st.one_of(st.sampled_from(NUMBERS), st.floats().map(str), st.integers().map(str), LINES)
JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | LINES,
    lambda inner: st.lists(inner, max_size=5) | st.dictionaries(LINES, inner, max_size=5),
    max_leaves=12,
)
CAMERA = {"width": 64, "height": 48, "fx": 50.0, "fy": 51.0, "cx": 31.0, "cy": 24.0}
KEYS = (*CAMERA, "range_type", "baseline", "baseline_unit", "doffs", "depth_unit", "hole_value", "intrinsic_matrix")


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("texts") / "stranger.txt"


def expect_one_line(error, named):
    message = one_line(error)  # as commands print it
    assert named in message
    assert "\n" not in message
    assert len(message) <= 1000


@checked
@given(NUMBER_TEXTS)
@example("1/0")
@example("9" * 400)
@example("1e-320/1e308")
def test_unit_is_a_positive_number_or_refused(text):
    try:
        unit = parse_unit(text)
    except ValueError as error:
        expect_one_line(error, "expected m, cm")
    else:
        assert 0 < unit < math.inf


@checked
@given(st.dictionaries(st.sampled_from(KEYS), JSON, max_size=3), st.sets(st.sampled_from(list(CAMERA)), max_size=1))
def test_camera_of_json_is_finite_or_refused(file, changes, without):
    path = file.with_suffix(".json")
    path.write_text(json.dumps({key: value for key, value in {**CAMERA, **changes}.items() if key not in without}))
    for read in (read_camera, read_any_camera):
        try:
            found = read(path)
        except ValueError as error:
            expect_one_line(error, path.name)
        else:
            assert isinstance(found, CameraFile)
            assert isinstance(found.camera, Camera)
            assert math.isfinite(found.camera.fx)
            assert found.camera.width > 0


@checked
@given(st.lists(st.lists(NUMBER_TEXTS, min_size=3, max_size=4), min_size=3, max_size=4))
def test_matrix_of_text_is_a_camera_and_a_rigid_motion_or_refused(file, rows):
    file.write_text("\n".join(" ".join(row) for row in rows), encoding="utf-8", errors="replace")
    with contextlib.suppress(ValueError):
        assert np.isfinite(read_any_camera(file)).all()
    try:
        matrix = read_transform(file)
    except ValueError as error:
        expect_one_line(error, file.name)
    else:
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1, abs=1e-3)


@checked
@given(st.lists(st.lists(NUMBER_TEXTS, min_size=8, max_size=8) | st.lists(NUMBER_TEXTS, max_size=16), max_size=4))
@example([["1", "0", "0", "0", "0", "0", "0", "1"]])
def test_poses_of_text_are_rigid_or_refused(file, rows):
    file.write_text("\n".join(" ".join(row) for row in rows), encoding="utf-8", errors="replace")
    try:
        found = read_poses(file)
    except ValueError as error:
        expect_one_line(error, file.name)
    else:
        assert all(np.isfinite(pose).all() for pose in found.poses)


OPTIONS = {
    "--fov": NUMBER_TEXTS, "--depth-unit": NUMBER_TEXTS, "--range-type": LINES, "--baseline": NUMBER_TEXTS,
    "--hole-value": NUMBER_TEXTS, "--min-confidence": NUMBER_TEXTS, "--method": LINES, "--noise": NUMBER_TEXTS,
    "--smooth": NUMBER_TEXTS, "--set": LINES | NUMBER_TEXTS.map("data_weight={}".format), "--config-dir": LINES,
    "--scale": NUMBER_TEXTS, "--neighbours": NUMBER_TEXTS, "--workers": st.sampled_from(["0", "-1", "x", "9" * 400]),
    "--device": LINES, "--fill": LINES, "--max-hole": NUMBER_TEXTS, "--format": LINES, "--only": LINES,
    "--without": LINES, "--with": LINES, "--max-error": NUMBER_TEXTS, "--max-faces": NUMBER_TEXTS,
    "--max-points": NUMBER_TEXTS, "--camera": LINES, "--poses": LINES, "--extrinsics": LINES, "--mask": LINES,
}  # fmt: skip
"""Options of ``dsr upsample`` with what people may type after them."""
COMMAND_LINES = st.lists(
    st.sampled_from(list(OPTIONS)).flatmap(lambda name: OPTIONS[name].map(lambda value: (name, value))), max_size=3
)


@settings(checked, max_examples=60)
@given(COMMAND_LINES)
def test_options_of_upsample_are_accepted_or_refused_in_lines(tmp_path_factory, chosen):
    folder = tmp_path_factory.getbasetemp() / "nothing"
    errors = io.StringIO()
    arguments = [f"{name}={value}" for name, value in chosen]
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        try:
            code = main(
                ["upsample", "--rgb", "no.png", "--depth", "no.tiff", "-o", str(folder), "--dry-run", *arguments]
            )
        except SystemExit as ended:
            code = ended.code
    assert code == 2  # at the latest, there are no pictures
    assert errors.getvalue().splitlines()[-1].strip()
    assert "Traceback" not in errors.getvalue()
    assert not folder.exists()


OVERRIDES = st.tuples(
    st.sampled_from(["", "+", "++", "~"]),
    st.sampled_from(["scale", "seed", "method", "dataset", "dataset.size", "method.x", "metrics.lpips", "x", "", "a.b",
                     "noise", "downsampling.assumed", "output_dir", "device", "weights"]),
    st.sampled_from(["=", "=", "=", ""]),
    NUMBER_TEXTS
    | st.sampled_from(["null", "[1,2", "{a:1}", "${x}", "${oc.env:NONE}", "a,b", "'", "\\", "a=b", "[[]]"]),
).map("".join)  # fmt: skip


@few
@given(st.lists(OVERRIDES, min_size=1, max_size=2))
@example(["=3"])
@example(["+validation.x=5"])
@example(["seed=99999999999999999999999"])
def test_overrides_are_accepted_or_refused_in_one_line(tmp_path_factory, monkeypatch, overrides):
    folder = tmp_path_factory.getbasetemp()
    errors, seen = io.StringIO(), []
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(errors):
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["eval.py"])
        code = 0
        try:
            run_command("eval", seen.append, overrides)
        except SystemExit as ended:
            code = ended.code
    lines = errors.getvalue().splitlines()
    assert code in (0, 2)
    assert len(lines) == (1 if code else 0)
    assert len(seen) == (0 if code else 1)
    assert all(line.startswith("error: ") and len(line) <= 1020 for line in lines)
    assert Path(folder).is_dir()

"""What people type and what short files say: anything at all ends with a value or with one line."""

import contextlib
import io
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from dsr.app.entry import run_command
from dsr.cli import main
from fuzz.texts import NUMBERS

checked = settings(derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck))
LINES = st.text(st.characters(codec="utf-8"), max_size=40)
NUMBER_TEXTS = st.one_of(st.sampled_from(NUMBERS), st.floats().map(str), st.integers().map(str), LINES)


# Options of ``dsr upsample`` that take a value.
OPTIONS = (
    "baseline", "camera", "config-dir", "depth-unit", "device", "extrinsics", "fill", "format", "fov", "hole-value",
    "mask", "max-error", "max-faces", "max-hole", "max-points", "method", "min-confidence", "neighbours", "noise",
    "only", "poses", "range-type", "scale", "set", "smooth", "with", "without", "workers",
)  # fmt: skip
VALUES = NUMBER_TEXTS | NUMBER_TEXTS.map("data_weight={}".format)


@settings(checked, max_examples=60)
@given(st.lists(st.tuples(st.sampled_from(OPTIONS), VALUES), max_size=3))
def test_options_of_upsample_are_accepted_or_refused_in_lines(tmp_path_factory, chosen):
    folder = tmp_path_factory.getbasetemp() / "nothing"
    errors = io.StringIO()
    arguments = [f"--{name}={value}" for name, value in chosen]
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


@settings(checked, max_examples=10)
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

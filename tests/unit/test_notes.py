"""Warnings of input, and their limits."""

from pathlib import Path

import pytest

from dsr.notes import LIMITS, Assumption, expect_no_warning, in_python, read_warning

PAGES = Path(__file__).resolve().parents[2] / "docs"


def test_documentation_shows_every_limit() -> None:
    page = (PAGES / "measurements" / "checks.md").read_text(encoding="utf-8")
    rows = [line.split(" | ") for line in page.splitlines() if line.startswith("| `")]
    shown = {row[0].strip("| `"): row[1] for row in rows}
    assert {code: shown.get(code) for code in LIMITS} == {code: f"{limit:g}" for code, limit in LIMITS.items()}


def test_documentation_says_what_to_do_about_every_warning() -> None:
    page = (PAGES / "checks.md").read_text(encoding="utf-8")
    assert [code for code in LIMITS if "." not in code and f"`{code}`" not in page] == []


def test_recorded_warning_has_its_threshold_and_is_read_again() -> None:
    assert Assumption("a", "6 px", "edges-beside", 6.0).record()["threshold"] == LIMITS["edges-beside"]
    for warning in (Assumption("a", "1 px", "edges-beside", 1.0), Assumption("a (b)", "", "poses", None)):
        assert read_warning(warning.record()) == warning


def test_strict_takes_a_warning_for_an_error() -> None:
    expect_no_warning("a.png", [])
    with pytest.raises(ValueError, match=r"a\.png: edges apart, and 1 more"):
        expect_no_warning(
            "a.png", [Assumption("edges apart", code="poses"), Assumption("plain"), Assumption("b", code="poses")]
        )


@pytest.mark.parametrize(
    ("reported", "in_words_of_python"),
    [
        ("take another -o, or --overwrite", "take another folder, or overwrite"),
        ("--max-hole: expected 1, got -inf", "max_hole: expected 1, got -inf"),
        ("x: --depth-unit is m", "x: unit is m"),
        ("/tmp/scan -final/x.png: damaged", "/tmp/scan -final/x.png: damaged"),
        ("/tmp/scan --final/x --two.png: damaged", "/tmp/scan --final/x --two.png: damaged"),
        ("see --sensor.", "see sensor."),
    ],
)
def test_only_options_are_named_as_arguments(reported: str, in_words_of_python: str) -> None:
    assert in_python(reported) == in_words_of_python

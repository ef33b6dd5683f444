"""The table of formats, and the command that prints it."""

from pathlib import Path

import pytest

from dsr.cli import main
from dsr.io.formats import FORMATS, markdown

CAPTURES = Path(__file__).resolve().parents[2] / "docs" / "captures.md"


def test_documentation_has_the_table_of_formats() -> None:
    shown = CAPTURES.read_text(encoding="utf-8").splitlines()
    first = shown.index(markdown()[0])
    assert shown[first : first + len(FORMATS) + 2] == markdown()


def test_command_prints_the_formats_with_a_word(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["formats", "r3d"]) == 0
    printed = capsys.readouterr().out
    assert "Record3D" in printed
    assert "Polycam" not in printed
    for word in ("found", "tried", "sensor "):  # labels of the rows
        assert main(["formats", word]) in (0, 2)
        assert "Polycam" not in capsys.readouterr().out
    assert main(["formats"]) == 0
    printed = capsys.readouterr().out
    assert all(each.name in printed for each in FORMATS)


def test_unknown_word_lists_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["formats", "daguerreotype"]) == 2
    assert "Record3D" in capsys.readouterr().err

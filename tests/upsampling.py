"""``dsr upsample`` as tests run it, what it records, and the line with which a command refuses."""

import json
from pathlib import Path
from typing import Any

import pytest

from dsr.cli import main


def upsample(*arguments: object) -> int:
    """Run the command in this process, and return its exit code."""
    return main(["upsample", *map(str, arguments)])


def info(folder: Path) -> dict[str, Any]:
    """Return what a result says of itself."""
    return json.loads((folder / "info.json").read_text())


def refused_line(capsys: pytest.CaptureFixture[str], code: int) -> str:
    """Return the one line on stderr of a command that ended with 2, without ``error: ``."""
    error = capsys.readouterr().err
    assert (code, error.count("\n"), error[:7]) == (2, 1, "error: "), error
    return error[7:-1]

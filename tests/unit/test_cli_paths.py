"""An empty text is no path on the command line: it would be the current directory."""

import pytest

from dsr.cli import main

EMPTY = {
    "--rgb": ("upsample", "--rgb", "", "--depth", "d.png", "-o", "out"),
    "-o/--output": ("report", "runs", "-o", " "),
    "DIR": ("doctor", ""),
    "RUNS": ("study", "build", "", "-o", "out"),
}


@pytest.mark.parametrize("argument", EMPTY)
def test_empty_path_is_refused_with_the_argument(argument, capsys):
    with pytest.raises(SystemExit) as ended:
        main(EMPTY[argument])
    assert ended.value.code == 2
    assert capsys.readouterr().err.endswith(f"error: argument {argument}: expected a path, got an empty text\n")

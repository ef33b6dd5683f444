"""What a contributor reads: its paths are there, its forms are whole, its versions are those of the code."""

import re
from pathlib import Path

from dsr.methods import weights
from dsr.utils.versions import RESULTS, SCENES

REPOSITORY = Path(__file__).resolve().parents[2]


def test_history_of_results_begins_with_todays_versions():
    text = (REPOSITORY / "docs" / "measurements" / "results_versions.md").read_text()
    newest = [
        re.search(rf"\| {name} \| since .*\n.*\n\| (\S+) \|", text)[1] for name in ("results", "scenes", "weights")
    ]
    assert newest == [str(RESULTS), str(SCENES), f"`{weights.version()}`"]


def test_paths_of_contributing_exist():
    text = (REPOSITORY / "CONTRIBUTING.md").read_text()
    paths = re.findall(r"`((?:src|tests|conf)/[\w*./]+)`", text) + re.findall(r"\]\((\w[\w./]+)", text)
    assert len(paths) > 10
    assert [path for path in paths if "NAME" not in path and not list(REPOSITORY.glob(path))] == []

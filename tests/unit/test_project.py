"""What a contributor reads: its paths are there, its forms are whole, its versions are those of the code."""

import doctest
import importlib
import re
from pathlib import Path

import pytest
from module_graph import MODULES

import dsr
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


WITH_EXAMPLES = sorted(name for name, path in MODULES.items() if ">>>" in path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples_of_a_module_run(name, dsr_cache):
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0


@pytest.mark.parametrize("name", sorted({*dsr.__all__} - {"__version__"}))
def test_each_name_of_the_package_has_an_example(name):
    assert "Example:" in getattr(dsr, name).__doc__

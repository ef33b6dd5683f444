"""What a contributor reads: its paths are there, its forms are whole, its versions are those of the code."""

import doctest
import importlib
import pkgutil
import re
from pathlib import Path

import pytest
from module_graph import MODULES

from dsr.methods import weights
from dsr.utils.versions import RESULTS, SCENES

REPOSITORY = Path(__file__).resolve().parents[2]


def test_history_of_results_begins_with_todays_versions():
    text = (REPOSITORY / "docs" / "measurements" / "results_versions.md").read_text()
    newest = [
        re.search(rf"\| {name} \| since .*\n.*\n\| (\S+) \|", text)[1] for name in ("results", "scenes", "weights")
    ]
    assert newest == [str(RESULTS), str(SCENES), f"`{weights.version()}`"]


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_paths_and_names_of_a_page_are_there(page):
    text = (REPOSITORY / page).read_text(encoding="utf-8")
    paths = re.findall(r"`((?:src|conf|tests|docs|benchmarks)/[\w*./]+)`", text)
    assert [path for path in paths if "NAME" not in path and not list(REPOSITORY.glob(path))] == []
    names = re.findall(r"`(dsr\.[\w.]+)`", text)
    assert len(paths) + len(names) > 10
    for name in names:
        pkgutil.resolve_name(name)


WITH_EXAMPLES = sorted(name for name, path in MODULES.items() if ">>>" in path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples_of_a_module_run(name, dsr_cache):
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0

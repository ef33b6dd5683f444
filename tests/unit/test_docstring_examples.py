"""The examples in docstrings run, and each public name has one."""

import doctest
import importlib

import pytest
from module_graph import MODULES

import dsr

WITH_EXAMPLES = sorted(name for name, path in MODULES.items() if ">>>" in path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples_of_a_module_run(name, dsr_cache):
    result = doctest.testmod(importlib.import_module(name))
    assert result.attempted > 0
    assert result.failed == 0


@pytest.mark.parametrize("name", sorted({*dsr.__all__} - {"__version__"}))
def test_each_name_of_the_package_has_an_example(name):
    assert "Example:" in getattr(dsr, name).__doc__

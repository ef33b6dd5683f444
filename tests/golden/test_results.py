"""Results are those that the versions in the code stand for, see ``results_golden.py``."""

from __future__ import annotations

from pathlib import Path

import pytest
from results_golden import GROUPS, VERSIONS, compute, differing, read


def test_kept_results_are_of_the_versions_in_the_code() -> None:
    assert read()[0] == VERSIONS, "python tests/results_golden.py keeps those of the new version"


@pytest.mark.parametrize("group", GROUPS)
def test_results_change_with_their_version_alone(group: str, dsr_cache: Path) -> None:
    version, jobs = GROUPS[group]
    lines = differing(read()[1][group], compute(jobs()))
    assert not lines, "\n".join([f"{version} in dsr/utils/versions.py has to be raised:", *lines])

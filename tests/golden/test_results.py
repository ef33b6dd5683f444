"""Results are those that the versions in the code stand for, see ``results_golden.py``."""

import pytest
from results_golden import GROUPS, VERSIONS, compute, differing, read, upsampling

_SLOW = ("upsampling", "sensors")
_RATIOS = ("2.67", "msg_v_noisy 4")


def test_kept_results_are_of_the_versions_in_the_code():
    assert read()[0] == VERSIONS, "python tests/results_golden.py keeps those of the new version"


def test_results_of_each_method_change_with_their_version_alone(dsr_cache):
    jobs = {name: job for name, job in upsampling() if name.endswith(_RATIOS)}
    kept = {name: values for name, values in read()[1]["upsampling"].items() if name.partition(", ")[0] in jobs}
    lines = differing(kept, compute(iter(jobs.items())))
    assert not lines, "\n".join(["RESULTS in dsr/utils/versions.py has to be raised:", *lines])


@pytest.mark.parametrize(
    "group", [pytest.param(each, marks=pytest.mark.nightly) if each in _SLOW else each for each in GROUPS]
)
def test_results_change_with_their_version_alone(group, dsr_cache):
    version, jobs = GROUPS[group]
    lines = differing(read()[1][group], compute(jobs()))
    assert not lines, "\n".join([f"{version} in dsr/utils/versions.py has to be raised:", *lines])

"""Three hundred cases of the fuzzer: each ends with a value, or with lines that name the file."""

import pytest

from fuzz.cases import Cases
from fuzz.readers import READERS, numbers_of

SEED = 2
TIMES = {reader: {1: 1, 2: 4}.get(reader.weight, 6) for reader in READERS}
"""Cases of each reader; one for those that take long, six for those that are used most."""


@pytest.fixture(scope="module")
def cases():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DSR_CACHE", "")  # what it was comes back
        made = Cases(SEED)
        patch.chdir(made.folder)
        yield made
        made.close()


@pytest.mark.parametrize("reader", READERS, ids=[reader.name.replace(" ", "_") for reader in READERS])
def test_reader_ends_with_a_value_or_lines_that_name_the_file(cases, reader):
    done = [cases.run(number) for number in numbers_of(reader, TIMES[reader])]
    assert [str(case) for case in done if case.outcome.kind == "unclean"] == []


def test_cases_are_three_hundred():
    assert sum(TIMES.values()) >= 300

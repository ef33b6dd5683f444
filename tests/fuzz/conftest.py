"""Options of a campaign: ``make fuzz ARGS="--rounds 40 --seed 1 -k polycam --keep broken"``."""

from pathlib import Path

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options, which exist where pytest is given this folder."""
    parser.addoption("--rounds", type=int, default=1, metavar="N", help="rounds of about 300 cases (1)")
    parser.addoption("--seed", type=int, default=2, metavar="S", help="decides about all cases (2)")
    parser.addoption("--case", type=int, metavar="N", help="run this case of each reader alone")
    parser.addoption("--keep", type=Path, metavar="DIR", help="keep the files of unclean cases there")

"""The option of a campaign: ``make chaos ARGS="--kills 40 -k upsample"``."""

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option, which exists where pytest is given this folder."""
    parser.addoption("--kills", type=int, default=1, metavar="N", help="how often each command is struck (1)")

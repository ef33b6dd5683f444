"""Fixtures that every kind of test uses."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session", autouse=True)
def _two_threads() -> None:
    torch.set_num_threads(int(os.environ.get("DSR_TEST_THREADS", "2")))


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real scenes, published networks and golden results: $DSR_SHARED, or beside the checkout."""
    folder = Path(os.environ.get("DSR_SHARED", REPOSITORY.parent / "shared"))
    if not (folder / "expected" / "metrics.json").is_file():
        message = f"needs the shared material (set DSR_SHARED); none at {folder}"
        if os.environ.get("DSR_REQUIRE_SHARED"):
            pytest.fail(message)
        pytest.skip(message)
    return folder

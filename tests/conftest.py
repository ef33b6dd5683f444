"""Fixtures that every kind of test uses."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session", autouse=True)
def _two_threads() -> None:
    torch.set_num_threads(int(os.environ.get("DSR_TEST_THREADS", "2")))


@pytest.fixture(scope="session", autouse=True)
def dsr_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """$DSR_CACHE, one for all tests: the user's own stays as it is."""
    folder = tmp_path_factory.mktemp("dsr_cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DSR_CACHE", str(folder))
        yield folder


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

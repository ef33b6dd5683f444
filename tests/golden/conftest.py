"""The scenes and the perceptual network that golden results are of."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from dsr.data.folder import Folder
from dsr.metrics.lpips import LPIPS, load_lpips
from dsr.sample import Scene


@pytest.fixture(scope="session")
def network(shared: Path) -> LPIPS:
    """LPIPS with its published weights."""
    return load_lpips(shared / "weights" / "alexnet_imagenet_features.pth")


@pytest.fixture(scope="session")
def load_scene(shared: Path) -> Callable[[str], Scene]:
    """Return what loads Lucy or Plant, once."""
    return cache(lambda name: Folder(str(shared / "scenes"), [name]).load(name))

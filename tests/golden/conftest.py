"""The scenes and the perceptual network that golden results are of."""

from functools import cache

import pytest

from dsr.data.folder import Folder
from dsr.metrics.lpips import load_lpips


@pytest.fixture(scope="session")
def network(shared):
    """LPIPS with its published weights."""
    return load_lpips(shared / "weights" / "alexnet_imagenet_features.pth")


@pytest.fixture(scope="session")
def load_scene(shared):
    """Return what loads Lucy or Plant, once."""
    return cache(lambda name: Folder(str(shared / "scenes"), [name]).load(name))

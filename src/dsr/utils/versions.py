"""The versions of what computes a result, for the files that are written beside it."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import dsr

RESULTS = 1
"""Version of what predicts and trains, raised with each change of its results, so that older predictions are not used
again. ``tests/golden/test_results.py`` notices such a change."""
SCENES = 1
"""Version of what reads and resizes the scenes of data sets, raised likewise; prepared scenes are kept under it."""
_PACKAGES = (
    "dsr", "hydra-core", "lightning", "numpy", "omegaconf", "opencv-python-headless",
    "pandas", "scikit-image", "scipy", "torch", "torchmetrics",
)  # fmt: skip


def package_versions(names: Iterable[str] = _PACKAGES) -> dict[str, str]:
    """Return the versions of packages; "not installed" where there is none."""
    found = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def versions() -> dict[str, Any]:
    """Return the versions of packages, Python and the project's checkout, and what the machine computes with."""
    import torch  # noqa: PLC0415

    return {
        "packages": package_versions(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "git_commit": _git("rev-parse", "HEAD"),
        "git_dirty": bool(_git("status", "--porcelain", "--untracked-files=no")),
        "accelerator": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "cpu_threads": torch.get_num_threads(),
    }


def _git(*arguments: str) -> str | None:
    """Return what git says of the checkout that this package runs from; None outside of one."""
    command = ["git", "-C", str(Path(dsr.__file__).parent), *arguments]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None

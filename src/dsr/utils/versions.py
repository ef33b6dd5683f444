"""Identification of results: versions of the software, and hashes of files and of code outside of the package."""

import functools
import hashlib
import importlib.util
import platform
import subprocess
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from dsr.utils.guards import opened
from dsr.utils.progress import Task

DISTRIBUTION = "depthsr"  # the name in pyproject.toml; the dsr of PyPI is another project
RESULTS = 9
"""Version of what predicts and trains, raised with each change of its results, so that older predictions are not used
again. ``tests/golden/test_results.py`` notices such a change."""
SCENES = 1
"""Version of what reads and resizes the scenes of data sets, raised likewise; prepared scenes are kept under it."""
_PACKAGES = (
    "dsr", "hydra-core", "lightning", "numpy", "omegaconf", "opencv-python-headless",
    "pandas", "scikit-image", "scipy", "torch", "torchmetrics",
)  # fmt: skip

_CHUNK = 1 << 20


@functools.cache
def how_to_install(extra: str) -> str:
    """Return the command that installs an extra of pyproject.toml, for messages."""
    if (Path(__file__).resolve().parents[3] / "pyproject.toml").is_file():
        return f"pip install -e '.[{extra}]' in a checkout"
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def package_versions(names: Iterable[str] = _PACKAGES) -> dict[str, str]:
    """Return the versions of packages; "not installed" where there is none."""
    found = {}
    for name in names:
        try:
            found[name] = version(DISTRIBUTION if name == "dsr" else name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def versions() -> dict[str, Any]:
    """Return the versions of packages, Python and the project's checkout, the accelerator and the number of threads."""
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
    command = ["git", "-C", str(Path(__file__).parent), *arguments]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return None


def file_hash(path: Path, progress: Task = lambda *_: None) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits."""
    digest, total = hashlib.sha256(), path.stat().st_size
    with opened(path) as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
            progress(file.tell(), total)
    return digest.hexdigest()


def hash_once(path: Path) -> str:
    """Return the SHA-256 of a file that is asked for often, computed once for each size and time of change."""
    state = path.stat()
    return _hash(path, state.st_size, state.st_mtime_ns)


@functools.lru_cache(maxsize=4096)
def _hash(path: Path, _size: int, _changed: int) -> str:
    return file_hash(path)


def hash_outside_code(targets: Iterable[str]) -> str | None:
    """Return a hash of the modules outside of this package that classes and functions come from; None for no such.

    A module in a package stands for all modules in its folder and the folders below.
    """
    own = __name__.partition(".")[0]
    modules = sorted({target.rpartition(".")[0] for target in targets if target.partition(".")[0] != own})
    digest = hashlib.sha256()
    for name in modules:
        try:
            spec = importlib.util.find_spec(name)
        except (ImportError, ValueError):  # what cannot be imported is refused where it is built
            continue
        if spec is None or spec.origin is None:
            continue
        path = Path(spec.origin)
        for file in [path] if "." not in name else sorted(path.parent.rglob("*.py")):
            digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16] if modules else None

"""Installed versions for ``dsr --version``, and the package's extras, without importing any heavy package."""

from __future__ import annotations

import platform
import shutil
import subprocess
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement

import dsr
from dsr.methods import weights
from dsr.utils.versions import DISTRIBUTION, RESULTS, package_versions

EXTRAS = {
    "app": "`dsr app`, a page of this machine that upsamples what is dropped on it",
    "captures": "recordings of cameras and apps, HEIC photos",
    "cluster": "`-m` on Slurm and in several processes",
    "mesh": "`dsr upsample` simplifies large meshes with more detail",
    "mlflow": "trainings logged to MLflow",
    "onnx": "`dsr export`, method=onnx and monocular",
    "rerun": "`dsr upsample --with rerun`",
    "transformers": "method=prompt_da",
    "wandb": "trainings logged to Weights & Biases",
}
"""What each extra of pyproject.toml is for; ``dev`` and ``docs`` are those of contributors."""
_CONTRIBUTORS = ("dev", "docs")


class Extra(NamedTuple):
    """An extra of the package: its name, its purpose, and its missing requirements."""

    name: str
    purpose: str
    missing: tuple[str, ...]


def version_lines() -> list[str]:
    """Return the lines for an error report: versions of dsr, Python, torch and the weights, and the device."""
    torch = package_versions(["torch"])["torch"]
    return [
        f"dsr {dsr.__version__}, results {RESULTS}, weights {weights.version()}",
        f"Python {platform.python_version()}, torch {torch}, {platform.platform()}",
        f"device: {', '.join(graphics_cards()) or processor()}",
    ]


def graphics_cards() -> list[str]:
    """Return the names of NVIDIA's graphics cards as the driver reports them, whether or not torch can use them."""
    program = shutil.which("nvidia-smi")
    if program is None:
        return []
    command = [program, "--query-gpu=name", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)  # noqa: S603
    except (OSError, subprocess.SubprocessError):
        return []
    return [line.strip() for line in done.stdout.splitlines() if line.strip()]


def processor() -> str:
    """Return the name of the processor."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text("utf-8", "replace").splitlines() if path.is_file() else []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def requirements(extra: str = "") -> list[Requirement]:
    """Return the requirements of the package on this machine, or the additional ones of an extra.

    Raises:
        PackageNotFoundError: the package is not installed.

    """
    found = [Requirement(line) for line in distribution(DISTRIBUTION).requires or ()]
    needed = [each for each in found if each.marker is None or each.marker.evaluate({"extra": ""})]
    if not extra:
        return needed
    return [each for each in found if each not in needed and each.marker and each.marker.evaluate({"extra": extra})]


def lack(requirement: Requirement) -> str | None:
    """Return what is wrong with a required package, ``NAME is missing``; None if it is there."""
    try:
        version = distribution(requirement.name).version
    except PackageNotFoundError:
        return f"{requirement.name} is missing"
    if requirement.specifier.contains(version, prereleases=True):
        return None
    return f"{requirement.name} is {version}, not {requirement.specifier}"


def extras() -> list[Extra]:
    """Return the extras for users that the installed package declares.

    Raises:
        PackageNotFoundError: it is not installed.

    """
    names = distribution(DISTRIBUTION).metadata.get_all("Provides-Extra") or []
    return [
        Extra(name, EXTRAS.get(name, ""), tuple(lacking for each in requirements(name) if (lacking := lack(each))))
        for name in sorted(names)
        if name not in _CONTRIBUTORS
    ]

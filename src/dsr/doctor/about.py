"""Installed versions for ``dsr --version``, without importing any heavy package."""

from __future__ import annotations

import platform
import shutil
import subprocess
from pathlib import Path

import dsr
from dsr.methods import weights
from dsr.utils.versions import RESULTS, package_versions


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

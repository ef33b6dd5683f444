"""Checks of what is installed and of the machine: ``dsr doctor`` without a directory."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, distribution, distributions
from pathlib import Path

import torch
from packaging.requirements import Requirement
from rich.text import Text

from dsr.data.download import CATALOGUE
from dsr.doctor import Finding, Level, graphics_cards, processor, show_findings, version_lines
from dsr.methods import weights
from dsr.synthetic import cache_directory
from dsr.utils.compute_device import fast_precision, pick_device
from dsr.utils.console import USAGE_ERROR, one_line, open_console
from dsr.utils.files import data_root
from dsr.utils.progress import megabytes
from dsr.utils.versions import DISTRIBUTION, file_hash, how_to_install

_OPENCV = "opencv-python-headless"
_LITTLE = 1 << 30  # free bytes of a disk below which results of large photos may not fit


def examine_machine() -> int:
    """Print what is installed and whether it is in order; return 0 if ``dsr upsample`` has all it needs, else 2."""
    console, findings = open_console(), [finding for check in CHECKS for finding in check()]
    show_findings(console, "this machine", findings, brief=False)
    missing = [each for each in findings if each.level == "problem"]
    if not missing:
        console.print("everything that dsr upsample needs is here", style="bold", highlight=False)
        return 0
    advice = "; ".join(dict.fromkeys(each.advice for each in missing))
    console.print(Text(f"dsr upsample needs: {advice}", "bold red"), soft_wrap=True)
    return USAGE_ERROR


def check_dsr() -> list[Finding]:
    """Check that dsr is installed, and report its version and those of Python, torch and the weights."""
    try:
        distribution(DISTRIBUTION)
    except PackageNotFoundError:
        return [Finding("dsr", "warning", "not installed, its sources are used", "pip install -e . in its folder")]
    return [Finding("dsr", "ok", line) for line in version_lines()[:2]]


def check_packages() -> list[Finding]:
    """Check that every package that dsr needs is there in a version that it works with."""
    try:
        needed = requirements()
    except PackageNotFoundError:
        return []
    wrong = {str(each).partition(";")[0].strip(): lacking for each in needed if (lacking := lack(each)) is not None}
    if not wrong:
        return [Finding("packages", "ok", f"all {len(needed)} are here")]
    names = " ".join(f"'{each}'" for each in wrong)
    return [Finding("packages", "problem", "; ".join(wrong.values()), f"pip install {names}")]


def check_weights() -> list[Finding]:
    """Check the files of weights against their recorded hashes."""
    known, there = weights.known(), weights.packaged_names()
    damaged = [name for name in there if file_hash(Path(str(weights.packaged_weights(name)))) != known.get(name)]
    if damaged or not there:
        message = f"{', '.join(damaged)}: not what dsr comes with" if damaged else "there are none"
        return [Finding("weights", "problem", message, "install dsr again from where it came, a checkout or a wheel")]
    absent = [name for name in weights.left_out() if weights.packaged_weights(name) is None]
    found = [Finding("weights", "ok", f"{weights.version()}, {len(there)} files as they have to be")]
    if absent:
        found.append(Finding("weights", "note", f"not here: {', '.join(absent)}", "dsr data get weights"))
    return found


def check_opencv() -> list[Finding]:
    """Check that there is one OpenCV, that without windows, which needs no library of a desktop."""
    names = {(each.metadata["Name"] or "").lower() for each in distributions()}
    variants = sorted(each for each in names if each.startswith("opencv-") and "python" in each)
    again = f"pip uninstall {' '.join(variants)}; pip install {_OPENCV}"
    try:
        import cv2  # noqa: PLC0415 - it may not be there
    except ImportError as error:
        return [Finding("opencv", "problem", f"cannot be imported: {one_line(error)}", again)]
    if len(variants) > 1:
        message = f"{' and '.join(variants)} write into one folder, so that which is used is a matter of chance"
        return [Finding("opencv", "warning", message, again)]
    return [Finding("opencv", "ok", f"{cv2.__version__}, {''.join(variants)}")]


def check_device() -> list[Finding]:
    """Report the computing device, and why a graphics card is not used."""
    try:
        device = pick_device("auto")
    except ValueError as error:
        return [Finding("device", "problem", one_line(error), "unset DSR_DEVICE, or correct it")]
    level: Level = "ok"
    message, advice = f"{processor()}, {fast_precision(device)}; no graphics card is needed", ""
    if device.type == "cuda":
        memory = megabytes(torch.cuda.get_device_properties(device).total_memory)
        message = f"{torch.cuda.get_device_name(device)}, {memory}, {fast_precision(device)}"
    elif not torch.cuda.is_available() and (cards := graphics_cards()):
        message, level = f"{', '.join(cards)}, which torch {torch.__version__} cannot use", "warning"
        advice = "install torch for CUDA, see pytorch.org/get-started"
    threads = f"{torch.get_num_threads()} threads, {os.cpu_count()} processors"
    threads += ", OMP_NUM_THREADS={OMP_NUM_THREADS}".format_map(os.environ) if "OMP_NUM_THREADS" in os.environ else ""
    return [Finding("device", level, message, advice), Finding("threads", "ok", threads)]


def check_folders() -> list[Finding]:
    """Check the working directory, the cache and the data sets: whether they are writable, and the free space."""
    named = {"results": Path(), "cache": cache_directory(), "temporary": Path(tempfile.gettempdir())}
    found = []
    for name, folder in named.items():
        path = folder.absolute()
        nearest = next(each for each in (path, *path.parents) if each.exists())
        if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
            level: Level = "warning" if name == "results" else "problem"
            advice = {"cache": "set DSR_CACHE to a folder of yours", "temporary": "set TMPDIR to a folder of yours"}
            elsewhere = advice.get(name, "write results elsewhere: -o DIR")
            found.append(Finding(name, level, f"{path}: cannot be written", elsewhere))
            continue
        free = shutil.disk_usage(nearest).free
        little = "free some space; results of a large photo take 1 GB" if free < _LITTLE else ""
        found.append(Finding(name, "warning" if little else "ok", f"{path}, {megabytes(free)} free", little))
    root = data_root().absolute()
    there = [each.name for each in CATALOGUE.values() if any((root / folder).is_dir() for folder in each.folders)]
    of = f"{len(there)} of {len(CATALOGUE)} data sets" + (f": {', '.join(there)}" if there else "")
    return [*found, Finding("data", "ok", f"{root}, {of}; `dsr data list` has all")]


def check_extras() -> list[Finding]:
    """List the extras for users, see docs/index.md: which are there, and how to get the others."""
    findings = []
    with contextlib.suppress(PackageNotFoundError):
        declared = distribution(DISTRIBUTION).metadata.get_all("Provides-Extra") or []
        for name in sorted(set(declared) - {"dev", "docs"}):
            missing = [lacking for each in requirements(name) if (lacking := lack(each)) is not None]
            advice = how_to_install(name) if missing else ""
            text = f"{name} ({', '.join(missing)})" if missing else name
            findings.append(Finding("extra", "note" if missing else "ok", text, advice))
    return findings


def requirements(extra: str = "") -> list[Requirement]:
    """Return the requirements of the installed package on this machine, or the additional ones of an extra."""
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


CHECKS: tuple[Callable[[], list[Finding]], ...] = (
    check_dsr, check_packages, check_weights, check_opencv, check_device, check_folders, check_extras,
)  # fmt: skip
"""A ``problem`` of these affects ``dsr upsample``, a ``note`` does not."""

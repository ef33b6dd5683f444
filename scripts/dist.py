"""Build what a release consists of, and check it: ``make dist``, or ``python scripts/dist.py [--offline]``.

The folder ``dist`` then has the source distribution, the wheel, the weights that the wheel leaves out, to be uploaded
beside them, and ``SHA256SUMS``. The wheel is installed into a new environment, whose ``dsr`` is run in an empty folder.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import tomllib
import venv
import zipfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY / "src"))

from dsr.methods import weights  # noqa: E402
from dsr.utils.versions import DISTRIBUTION, file_hash  # noqa: E402

MOST = 60e6
"""Bytes of the wheel."""
_WEIGHTS = REPOSITORY / "src" / "dsr" / "methods" / "weights"
SUMS = "SHA256SUMS"
_STATED = {
    "src/dsr/__init__.py": '__version__ = "{}"', "CITATION.cff": "\nversion: {}\n",
    "docs/methods.md": "version = {{{}}}", "CHANGELOG.md": "\n## [{}]",
}  # fmt: skip
"""Where the version stands beside pyproject.toml, and how."""


class ReleaseError(Exception):
    """What is not as a release has to be."""


def main() -> int:
    """Build and check; return the exit code: 0, or 2 with a line that says what is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=REPOSITORY / "dist", metavar="DIR", help="dist by default")
    parser.add_argument(
        "--offline", action="store_true", help="build and install with the packages of this environment"
    )
    parser.add_argument("--draft", action="store_true", help="the changelog need not have the version yet")
    options = parser.parse_args()
    try:
        version = check_versions(draft=options.draft)
        check_weights()
        wheel = build(options.output, offline=options.offline)
        check_wheel(wheel)
        for line in run_installed(wheel, version, offline=options.offline):
            print(f"  {line}")
        for line in finish(options.output):
            print(line)
    except (ReleaseError, OSError, subprocess.CalledProcessError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def check_versions(*, draft: bool) -> str:
    """Return the version, which has to be the same everywhere."""
    version = str(tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["version"])
    for name, form in _STATED.items():
        if form.format(version) not in (REPOSITORY / name).read_text("utf-8") and not (
            draft and name == "CHANGELOG.md"
        ):
            raise ReleaseError(f"{name}: expected {form.format(version).strip()}, as pyproject.toml has {version}")
    return version


def check_weights() -> None:
    """Compare all files of weights with those that are known."""
    found = {path.stem: file_hash(path) for path in sorted(_WEIGHTS.glob("*.safetensors"))}
    wrong = sorted({name for name, _ in found.items() ^ weights.known().items()})
    if wrong:
        raise ReleaseError(
            f"{', '.join(wrong)}: not as in known.sha256; (cd {_WEIGHTS}; sha256sum *.safetensors > known.sha256)"
        )


def clear(folder: Path) -> None:
    """Remove an earlier release from a folder, in which nothing else may be."""
    ours = (SUMS, f"{DISTRIBUTION}-*.whl", f"{DISTRIBUTION}-*.tar.gz", "*.safetensors")
    found = list(folder.iterdir()) if folder.is_dir() else []
    if others := [path.name for path in found if not any(path.match(each) for each in ours)]:
        raise ReleaseError(f"{folder}: expected an empty folder or one of an earlier release, got {others[0]} in it")
    for path in found:
        path.unlink()


def build(folder: Path, *, offline: bool) -> Path:
    """Build the source distribution, and from it the wheel."""
    clear(folder)
    with tempfile.TemporaryDirectory() as work:  # a copy, in which nothing of earlier builds is
        source = Path(work) / "dsr"
        names = ("src", "conf", "setup.py", "pyproject.toml", "MANIFEST.in", "constraints.txt", "eval.py", "train.py")
        for name in (*names, "README.md", "LICENSE"):
            path = REPOSITORY / name
            ignored = shutil.ignore_patterns("__pycache__", "*.egg-info")
            source.mkdir(exist_ok=True)
            shutil.copytree(path, source / name, ignore=ignored) if path.is_dir() else shutil.copy(path, source / name)
        command = [sys.executable, "-m", "build", "--outdir", str(folder), str(source)]
        _run([*command, "--no-isolation", "--skip-dependency-check"] if offline else command)
    [wheel] = folder.glob("*.whl")
    return wheel


def check_wheel(wheel: Path) -> None:
    """Check the size of a wheel, and that it has the weights that it should and the configuration."""
    if wheel.stat().st_size > MOST:
        raise ReleaseError(f"{wheel}: expected at most {MOST / 1e6:.0f} MB, got {wheel.stat().st_size / 1e6:.1f} MB")
    with zipfile.ZipFile(wheel) as packed:
        names = packed.namelist()
    there = {Path(name).stem for name in names if name.endswith(".safetensors")}
    if there != {"glass", *weights.known()} - left_out():
        raise ReleaseError(
            f"{wheel}: expected the weights of methods that compute by default and glass, got {sorted(there)}"
        )
    missing = [
        str(path) for path in (REPOSITORY / "conf").rglob("*.yaml")
        if f"dsr/{path.relative_to(REPOSITORY).as_posix()}" not in names
    ]  # fmt: skip
    if missing:
        raise ReleaseError(f"{wheel}: expected the configuration, {', '.join(missing)} included")


def left_out() -> set[str]:
    """Return the names of the weights that pyproject.toml leaves out of a wheel."""
    settings = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["setuptools"]
    patterns = settings["exclude-package-data"]["dsr"]
    return {path.stem for pattern in patterns for path in (REPOSITORY / "src" / "dsr").glob(pattern)}


def run_installed(wheel: Path, version: str, *, offline: bool) -> list[str]:
    """Install a wheel into a new environment, and return what its ``dsr`` says of itself in an empty folder."""
    with tempfile.TemporaryDirectory() as work:
        place = Path(work) / "venv"
        venv.create(place, with_pip=not offline)
        python = place / ("Scripts" if sys.platform == "win32" else "bin") / "python"
        site = sysconfig.get_path("purelib", vars={"base": str(place), "platbase": str(place)})
        pip = [sys.executable, "-m", "pip", "--python", str(python)] if offline else [str(python), "-m", "pip"]
        _run([*pip, "install", "--quiet", str(wheel), *(["--no-deps", "--no-index"] if offline else [])])
        if offline:  # what it needs is taken from here, but not dsr itself, which the environment's own comes before
            (Path(site) / "needed.pth").write_text(sysconfig.get_path("purelib") + "\n")
        empty = Path(work) / "empty"
        empty.mkdir()
        said = _run([str(python), "-I", "-m", "dsr", "--version"], empty).splitlines()
        if not said or not said[0].startswith(f"dsr {version}, ") or weights.version() not in said[0]:
            raise ReleaseError(f"dsr --version: expected dsr {version} and {weights.version()}, got {said[:1]}")
        doctor = _run([str(python), "-I", "-m", "dsr", "doctor"], empty).splitlines()
        absent = {name for line in doctor for name in left_out() if re.search(rf"not here: .*\b{name}\b", line)}
        if absent != left_out():
            raise ReleaseError(f"dsr doctor: expected {sorted(left_out())} not to be there, got {doctor}")
        return [*said, doctor[-1]]


def finish(folder: Path) -> list[str]:
    """Put the weights that are left out into the folder, and the checksums; return a line for each file."""
    for name in sorted(left_out()):
        shutil.copy(_WEIGHTS / f"{name}.safetensors", folder)
    files = sorted(path for path in folder.iterdir() if path.name != SUMS)
    (folder / SUMS).write_text("".join(f"{file_hash(path)}  {path.name}\n" for path in files))
    return [f"{path.stat().st_size / 1e6:6.1f} MB  {path}" for path in files]


def _run(command: list[str], cwd: Path | None = None) -> str:
    """Run a command, and return what it prints; its errors are shown."""
    done = subprocess.run(command, cwd=cwd, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        print(done.stdout, file=sys.stderr)
        raise ReleaseError(f"{' '.join(command)}: exit code {done.returncode}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())

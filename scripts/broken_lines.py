"""Break one line of the package at a time, and show which unit test catches it: ``python scripts/broken_lines.py``.

Each break is a plausible mistake: a sign in the normals, a wrong light, a swapped mask, a lost seed, a camera half a
pixel off. The unit tests of a copy of the checkout are run until the first failure. The exit code is 1 if a break is
not caught.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Break:
    """A mistake: the text ``before`` of ``file``, which must occur exactly once, becomes ``after``."""

    name: str
    file: str
    before: str
    after: str


BREAKS = (
    Break("sign in normals", "geometry/surface.py", "nx = fx * step_u * along_v", "nx = -fx * step_u * along_v"),
    Break("wrong light", "geometry/lights.py", "(0.0, -math.sqrt(2 / 3), -1 /", "(0.0, math.sqrt(2 / 3), -1 /"),
    Break("frontal light tilted", "geometry/lights.py", "(0.0, 0.0, -1.0)", "(0.0, 0.1, -0.99498743710662)"),
    Break("swapped mask", "metrics/functional.py", "torch.where(mask, values, 0)", "torch.where(mask, 0, values)"),
    Break("lost seed", "degradation/downsampling.py", "repr((seed, *names))", "repr(names)"),
    Break("camera half a pixel off", "geometry/camera.py", "cx=(self.cx + 0.5) * sx - 0.5", "cx=self.cx * sx"),
    Break("threshold in 1/256", "metrics/functional.py", "threshold / 255", "threshold / 256"),
    Break(
        "holes counted", "metrics/functional.py", "self.target_mask & prediction.isfinite()", "prediction.isfinite()"
    ),
)


def main() -> int:
    """Try every break, or those that are named, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="of the broken lines to try (default: all)")
    names = parser.parse_args().names
    breaks = [each for each in BREAKS if not names or each.name in names]
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "checkout"
        shutil.copytree(
            ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "outputs", "site", "*.pyc", "__pycache__")
        )
        for each in breaks:
            path = copy / "src" / "dsr" / each.file
            text = path.read_text(encoding="utf-8")
            if text.count(each.before) != 1:
                raise SystemExit(
                    f"{each.name}: {each.file}: expected {each.before!r} once, found {text.count(each.before)}"
                )
            path.write_text(text.replace(each.before, each.after), encoding="utf-8")
            started = time.perf_counter()
            failed = first_failure(copy)
            path.write_text(text, encoding="utf-8")
            missed += failed is None
            print(f"{each.name:<26} {time.perf_counter() - started:5.0f} s  {failed or 'NOT CAUGHT'}", flush=True)
    print(f"{len(breaks) - missed} of {len(breaks)} broken lines are caught")
    return 1 if missed else 0


def first_failure(checkout: Path) -> str | None:
    """Return the first unit test of a checkout that fails; None where all pass."""
    environment = os.environ | {
        "PYTHONPATH": str(checkout / "src"),
        "OMP_NUM_THREADS": "1",
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "unit", "-p", "no:cacheprovider", "--tb=no", "-n", "2"]
    done = subprocess.run(command, cwd=checkout, env=environment, capture_output=True, text=True, check=False)
    found = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return found[1] if found else None


if __name__ == "__main__":
    sys.exit(main())

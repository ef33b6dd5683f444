"""Several workers give what one gives, in a process of its own: other tests leave threads that do not fork."""

import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]


def test_workers_share_the_scenes_and_outlive_each_other():
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "sharing_cases.py"]
    done = subprocess.run(command, cwd=TESTS, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stdout[-3000:]
    assert " passed" in done.stdout

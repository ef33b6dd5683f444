"""Python programs as processes of their own, without the seconds that each takes to import torch and Lightning.

A process per worker of the tests imports them once, and each program runs in a fork of it: with a directory, an
environment, arguments, output and an exit code of its own. Tests of how commands start and of signals use
:mod:`subprocess` itself.
"""

from __future__ import annotations

import atexit
import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

SERVER = Path(__file__).with_name("command_server.py")


@functools.cache
def _server() -> subprocess.Popen[str]:
    """Start the process."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, str(SERVER)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    )
    atexit.register(process.kill)
    return process


def run_python(
    *arguments: str, cwd: Path, env: Mapping[str, str] | None = None, timeout: float = 300
) -> subprocess.CompletedProcess[str]:
    """Run a Python program.

    Args:
        arguments: the program's path, or ``-m`` and a module's name, and its arguments.
        cwd: directory that it runs in.
        env: its environment; None for that of the tests.
        timeout: seconds after which it is killed.

    Raises:
        subprocess.TimeoutExpired: it took longer.

    """
    server = _server()
    assert server.stdin is not None
    assert server.stdout is not None
    with tempfile.TemporaryDirectory() as folder:
        outputs = [str(Path(folder) / name) for name in ("stdout", "stderr")]
        request = {"arguments": arguments, "cwd": str(cwd), "env": dict(os.environ if env is None else env),
                   "timeout": timeout, "stdout": outputs[0], "stderr": outputs[1]}  # fmt: skip
        print(json.dumps(request), file=server.stdin, flush=True)
        code = json.loads(server.stdout.readline())
        texts = [Path(name).read_text(encoding="utf-8") if Path(name).exists() else "" for name in outputs]
    if code is None:
        raise subprocess.TimeoutExpired(arguments, timeout, *texts)
    return subprocess.CompletedProcess(arguments, code, *texts)

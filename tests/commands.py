"""Python programs as processes of their own, without the seconds that each takes to import torch and Lightning.

A process per worker of the tests imports them once, and each program runs in a fork of it: with a directory, an
environment, arguments, output and an exit code of its own. Tests of how commands start use :mod:`subprocess` itself.
"""

import atexit
import contextlib
import functools
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

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


def _ask(request: Mapping[str, Any]) -> Any:
    """Return the answer of the process."""
    server = _server()
    assert server.stdin is not None
    assert server.stdout is not None
    print(json.dumps(request), file=server.stdin, flush=True)
    return json.loads(server.stdout.readline())


class Program:
    """A Python program at work; used as a context manager, it is killed at the end if it is still at work.

    ``arguments`` are the program's path, or ``-m`` and a module's name, and its arguments; its environment is that of
    the tests with one thread, and without what changes scores and errors, if there is no ``env``. Its ``pid`` leads a
    group of processes; ``returncode`` is None until :meth:`communicate` has seen its end.
    """

    def __init__(self, *arguments: str, cwd: Path, env: Mapping[str, str] | None = None) -> None:
        self.arguments = arguments
        self.returncode: int | None = None
        self._folder = tempfile.TemporaryDirectory()
        self._outputs = [Path(self._folder.name) / name for name in ("stdout", "stderr")]
        stdout, stderr = map(str, self._outputs)
        environment = dict(env or {**os.environ, "OMP_NUM_THREADS": "1"})
        if env is None:
            for name in ("DSR_LPIPS_TRUNK", "HYDRA_FULL_ERROR"):
                environment.pop(name, None)
        self.pid: int = _ask({"arguments": arguments, "cwd": str(cwd), "env": environment, "stdout": stdout,
                              "stderr": stderr})  # fmt: skip
        self._handle = os.pidfd_open(self.pid)

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Kill it if it is still at work."""
        if self.returncode is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.communicate(0)

    @property
    def ended(self) -> bool:
        """Whether it has ended."""
        return self.returncode is not None or bool(select.select([self._handle], [], [], 0)[0])

    def send_signal(self, number: int) -> None:
        """Send it a signal."""
        signal.pidfd_send_signal(self._handle, number)

    def communicate(self, timeout: float = 300) -> tuple[str, str]:
        """Wait for its end, and return what it wrote to stdout and stderr; after ``timeout`` seconds it is killed."""
        self.returncode = _ask({"process": self.pid, "timeout": timeout})
        os.close(self._handle)
        stdout, stderr = (path.read_text(encoding="utf-8") if path.exists() else "" for path in self._outputs)
        self._folder.cleanup()
        if self.returncode is None:
            self.returncode = -signal.SIGKILL
            raise subprocess.TimeoutExpired(self.arguments, timeout, stdout, stderr)
        return stdout, stderr


def run_python(
    *arguments: str, cwd: Path, env: Mapping[str, str] | None = None, timeout: float = 300
) -> subprocess.CompletedProcess[str]:
    """Run a Python program to its end, see :class:`Program`; it is killed after ``timeout`` seconds."""
    program = Program(*arguments, cwd=cwd, env=env)
    outputs = program.communicate(timeout)
    assert program.returncode is not None
    return subprocess.CompletedProcess(arguments, program.returncode, *outputs)

"""Signals end a process in one line; each case is a process of its own without torch."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dsr.utils import interruption
from dsr.utils.interruption import MESSAGE

READY = "print('ready', flush=True)"
WORK = f"{READY}\ntime.sleep(60)"
STEP = (
    f"with deferred() as noted:\n    {READY}\n    until = time.monotonic() + SECONDS\n"
    "    while not noted and time.monotonic() < until: time.sleep(0.01)\n"
    "    time.sleep(0.3)\n    print('saved', file=sys.stderr)\nsignal.raise_signal(noted[0])"
)


def run(folder: Path, body: str, *numbers: int) -> tuple[int, str]:
    """Run a command, send signals once it is ready; return its exit code and its stderr."""
    lines = body.replace("\n", "\n    ")
    (folder / "case.py").write_text(
        f"import signal, sys, time\nfrom dsr.utils.interruption import deferred\ndef main():\n    {lines}\n"
    )
    code = "from dsr.utils.interruption import start; start('case', 'main')"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509 - background jobs ignore it
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        for number in numbers:
            process.send_signal(number)
            time.sleep(0.1)
        _, errors = process.communicate(timeout=20)
        return process.returncode, errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_the_process_in_one_line(number: int, tmp_path: Path) -> None:
    assert run(tmp_path, WORK, number) == (128 + number, f"{MESSAGE}\n")


def test_signal_meets_a_step_only_at_its_end_and_a_second_one_kills(tmp_path: Path) -> None:
    step = STEP.replace("SECONDS", "20")
    assert run(tmp_path, step, signal.SIGTERM) == (143, f"saved\n{MESSAGE}\n")
    code, errors = run(tmp_path, step, signal.SIGINT)
    assert (code, errors.splitlines()[1:]) == (130, ["saved", MESSAGE])
    assert run(tmp_path, step, signal.SIGTERM, signal.SIGTERM) == (-signal.SIGTERM, "")


def test_output_that_nobody_reads_ends_the_command_without_a_word(tmp_path: Path) -> None:
    (tmp_path / "case.py").write_text("def main():\n    for _ in range(30000): print('a line')\n")
    program = "from dsr.utils.interruption import start; start('case', 'main')"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    line = f"set -o pipefail; '{sys.executable}' -c \"{program}\" | true"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr) == (1, "")


def test_signals_of_the_host_process_are_its_own_again_after_a_deferral() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with interruption.deferred() as noted:
        assert not noted
        signal.raise_signal(signal.SIGTERM)
        assert noted == [signal.SIGTERM]
    assert signal.getsignal(signal.SIGTERM) is before


def test_job_of_a_scheduler_saves_before_it_is_requeued() -> None:
    requeues: list[int] = []
    before = signal.signal(signal.SIGUSR2, lambda number, _: requeues.append(number))
    try:
        with interruption.deferred() as noted:
            signal.raise_signal(signal.SIGTERM)  # as some clusters do before
            assert not noted
            signal.raise_signal(signal.SIGUSR2)
            assert (noted, requeues) == ([signal.SIGUSR2], [])
        signal.raise_signal(noted[0])
        assert requeues == [signal.SIGUSR2]
    finally:
        signal.signal(signal.SIGUSR2, before)


def test_processes_started_as_workers_do_not_get_ctrl_c_but_their_parent_does() -> None:
    code = "import os, signal; os.kill(os.getpid(), signal.SIGINT); print('alive')"

    def start() -> None:
        with interruption.starting_workers():
            assert subprocess.check_output([sys.executable, "-c", code], text=True) == "alive\n"
            signal.raise_signal(signal.SIGINT)  # of this thread alone

    with pytest.raises(KeyboardInterrupt):
        start()


def test_worker_ends_with_its_parent() -> None:
    worker = "import os, time; from dsr.utils.interruption import end_with; end_with(os.getppid()); time.sleep(60)"
    parent = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen([sys.executable, '-c', {worker!r}])\n"
        "print(child.pid, flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        status = Path(f"/proc/{int(process.stdout.readline())}/stat")
        time.sleep(0.5)
        process.kill()
    deadline = time.monotonic() + 5
    while status.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not status.exists() or status.read_text().rpartition(")")[2].split()[0] == "Z"

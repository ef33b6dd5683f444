"""Signals end a process in one line, wherever they come; each case is a process of its own without torch."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dsr.utils import interruption
from dsr.utils.interruption import MESSAGE

READY = "import sys, time; print('ready', flush=True); "
CASES = {
    "at work": "READY\nwith working(): time.sleep(60)",
    "before the work": "READY\ntime.sleep(60)",
    "in an import": "import slow",
    "in a callback whose exceptions are dropped": (
        "import weakref\nclass Thing: pass\ndef gone(_):\n    READY\n    time.sleep(60)\n"
        "with working():\n    thing = Thing(); r = weakref.ref(thing, gone); del thing\n    time.sleep(60)"
    ),
    "where everything is caught": (
        "READY\ninterruption._GRACE = 0.3\nwith working():\n    while True:\n"
        "        try: time.sleep(60)\n        except BaseException: pass"
    ),
    "while cleaning up for too long": (
        "READY\ninterruption._GRACE = 0.3\nwith working():\n    try: time.sleep(60)\n    finally: time.sleep(60)"
    ),
    "deferred, and not acted upon": (
        "interruption._GRACE = 0.3\nwith working(), deferred(lambda: 'see the checkpoint'):\n"
        "    READY\n    while True: time.sleep(0.01)"
    ),
}


def script_of(case: str) -> str:
    """Return a module that runs a case, or other lines, in its function ``main``."""
    body = CASES.get(case, case).replace("READY", READY).replace("\n", "\n    ")
    return (
        "import time\nfrom dsr.utils import interruption\nfrom dsr.utils.interruption import deferred, working\n"
        f"def main():\n    {body}\n"
    )


def run(folder: Path, main: str, *numbers: int) -> tuple[int, str, float]:
    """Run a module, send signals once it is ready; return its exit code, its stderr and the seconds that it took."""
    (folder / "case.py").write_text(main)
    (folder / "slow.py").write_text(f"{READY}\ntime.sleep(60)")
    code = "from dsr.utils.interruption import start; start('case', 'main')"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509 - background jobs ignore it
    ) as process:  # fmt: skip
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        before = time.monotonic()
        for number in numbers:
            process.send_signal(number)
            time.sleep(0.05)
        _, errors = process.communicate(timeout=20)
        return process.returncode, errors, time.monotonic() - before


@pytest.mark.parametrize("case", CASES)
def test_signal_ends_the_process_in_one_line(case: str, tmp_path: Path) -> None:
    number = signal.SIGTERM if case.startswith(("in an import", "deferred")) else signal.SIGINT
    code, errors, seconds = run(tmp_path, script_of(case), number)
    assert code == 128 + number
    assert errors == ("see the checkpoint\n" if case.startswith("deferred") else f"{MESSAGE}\n")
    assert seconds < 5


def test_second_signal_ends_the_process_at_once(tmp_path: Path) -> None:
    script = script_of("while cleaning up for too long").replace("_GRACE = 0.3", "_GRACE = 30")
    code, errors, seconds = run(tmp_path, script, signal.SIGINT, signal.SIGTERM)
    assert (code, errors) == (130, f"{MESSAGE}\n")
    assert seconds < 5


def test_deferred_signal_is_acted_upon_by_the_work(tmp_path: Path) -> None:
    script = (
        "import sys, time\nfrom dsr.utils.interruption import deferred, stop, working\ndef main():\n"
        "    with working(), deferred(lambda: 'late') as noted:\n        print('ready', flush=True)\n"
        "        while not noted.requested: time.sleep(0.01)\n        stop('saved')\n"
    )
    assert run(tmp_path, script, signal.SIGTERM)[:2] == (143, "saved\n")


def test_step_that_ctrl_c_has_met_is_done_however_long_it_takes(tmp_path: Path) -> None:
    step = (
        "interruption._GRACE = 0.2\n"
        "interruption._SILENCE = 0.5\n"
        "with working(), deferred(lambda: 'late') as noted:\n"
        "    READY\n"
        "    until = time.monotonic() + 2\n"
        "    while time.monotonic() < until: pass\n"
        "    interruption.stop('saved' if noted.requested else 'not reported')"
    )
    reported = "stopping after this step (Ctrl-C again stops at once)\n"
    script = script_of(step)
    assert run(tmp_path, script, signal.SIGINT)[:2] == (130, f"{reported}saved\n")
    code, errors, seconds = run(tmp_path, script.replace("+ 2", "+ 60"), signal.SIGINT, signal.SIGINT)
    assert (code, errors) == (130, "late\n")
    assert seconds < 5


def test_cleaning_up_after_a_step_that_ctrl_c_has_met_takes_only_seconds(tmp_path: Path) -> None:
    step = (
        "interruption._GRACE = 0.3\n"
        "with working():\n"
        "    with deferred(lambda: 'late') as noted:\n"
        "        READY\n"
        "        while not noted.requested: pass\n"
        "    time.sleep(60)"
    )
    code, errors, seconds = run(tmp_path, script_of(step), signal.SIGINT)
    assert (code, errors) == (130, f"{MESSAGE}\n")
    assert seconds < 5


def test_exit_code_and_output_of_a_command_are_kept(tmp_path: Path) -> None:
    script = "def main():\n    import sys\n    print('ready')\n    sys.exit(7)\n"
    assert run(tmp_path, script)[:2] == (7, "")


SPEAKING = """
import sys
def main():
    warning = "import numpy; numpy.float32(1) * numpy.float64(1e308).astype(numpy.float32)"
    exec(warning, dict(__name__="dsr.case"))
    try:
        for _ in range(3000): print("a line of what the command has to say")
        sys.stdout.flush()
    except OSError as error:
        print("error:", error.strerror, file=sys.stderr)
        return 2
    if {problem}:
        print("error: a problem", file=sys.stderr)
        return 2
    print("done", file=sys.stderr)
"""


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(
    ("streams", "problem", "code", "errors"),
    [
        ("| true", False, 0, "done\n"),
        ("| true", True, 2, "error: a problem\n"),
        ("2>&1 | true", True, 2, ""),
        (">/dev/null 2>/dev/full", False, 0, ""),
        (">/dev/null 2>/dev/full", True, 2, ""),
        (">/dev/full", False, 2, "error: No space left on device\n"),
    ],
)
def test_what_nobody_reads_changes_no_exit_code(tmp_path, streams, problem, code, errors, unbuffered):
    (tmp_path / "case.py").write_text(SPEAKING.format(problem=problem))
    program = "from dsr.utils.interruption import start; start('case', 'main')"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path]),
                   "PYTHONUNBUFFERED": unbuffered}  # fmt: skip
    line = f"set -o pipefail; '{sys.executable}' -c \"{program}\" {streams}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr) == (code, errors)


def test_signal_that_comes_while_a_worker_is_started_is_acted_upon_after_that(tmp_path: Path) -> None:
    step = (
        "with working():\n    with interruption.starting_workers():\n        READY\n        time.sleep(1)\n"
        "        print('started', file=sys.stderr)\n    time.sleep(60)"
    )
    code, errors, seconds = run(tmp_path, script_of(step), signal.SIGINT)
    assert (code, errors) == (130, f"started\n{MESSAGE}\n")
    assert seconds < 10


def test_signals_of_the_host_process_are_its_own_again_after_a_deferral() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with interruption.deferred(lambda: "not shown") as noted:
        assert not noted.requested
        signal.raise_signal(signal.SIGTERM)
        assert noted.requested
    assert signal.getsignal(signal.SIGTERM) is before


def test_worker_ends_with_its_parent(tmp_path: Path) -> None:
    worker = "import os, time; from dsr.utils.interruption import end_with; end_with(os.getppid()); time.sleep(60)"
    parent = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen([sys.executable, '-c', {worker!r}])\n"
        "print(child.pid, flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        child = int(process.stdout.readline())
        time.sleep(0.5)
        process.kill()
    deadline = time.monotonic() + 5
    while Path(f"/proc/{child}").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not _is_running(child)


def test_worker_that_outlasts_a_signal_to_the_whole_group_ends_some_seconds_later() -> None:
    worker = (
        "import os, signal, time\nfrom dsr.utils import interruption\n"
        "interruption._GRACE = 0.5\ninterruption.outlast_group()\nos.kill(os.getpid(), signal.SIGTERM)\n"
        "time.sleep(0.2)\nprint('at work', flush=True)\ntime.sleep(60)\n"
    )
    done = subprocess.run([sys.executable, "-c", worker], capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (143, "at work\n", "")


def test_forked_process_leaves_signals_to_its_parent(tmp_path: Path) -> None:
    script = (
        "import os, signal\ndef main():\n    print('ready', flush=True)\n    child = os.fork()\n    if child == 0:\n"
        "        kept = signal.getsignal(signal.SIGINT) == signal.SIG_IGN and signal.set_wakeup_fd(-1) == -1\n"
        "        kept = kept and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL\n        os._exit(kept)\n"
        "    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])\n"
    )
    assert run(tmp_path, script)[:2] == (1, "")


def test_processes_started_as_workers_do_not_get_ctrl_c_but_their_parent_does() -> None:
    code = "import os, signal; os.kill(os.getpid(), signal.SIGINT); print('alive')"

    def start() -> None:
        with interruption.starting_workers():
            assert subprocess.check_output([sys.executable, "-c", code], text=True) == "alive\n"
            signal.raise_signal(signal.SIGINT)

    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    with pytest.raises(KeyboardInterrupt):
        start()
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before


def _is_running(process: int) -> bool:
    """Return whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False

"""A claim has one owner at a time, and is taken over when its owner is gone, but never before."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dsr.evaluation import claims as claims_module
from dsr.evaluation.claims import Claims
from dsr.utils.temporary import birth, machine


def claim_files(folder):
    return sorted(path for path in (folder / ".claims").iterdir() if not path.name.startswith("member-"))


@pytest.fixture
def ended():
    """The number of a process that was there and has ended, and when it was started."""
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        started = birth(process.pid)
        process.communicate(b"\n")
    return process.pid, started


def written_by(path, *, host=None, process=1, started="0", age=0.0):
    """Make a claim look like that of another process."""
    path.write_text(json.dumps({"machine": host or machine(), "process": process, "birth": started}))
    os.utime(path, (time.time() - age,) * 2)


def test_claim_is_refused_until_it_is_given_back(tmp_path):
    with Claims(tmp_path) as claims:
        first = claims.take("scene a")
        assert first is not None
        with first:
            assert claims.take("scene a") is None
            assert claims.take("scene b") is not None
        assert claims.take("scene a") is not None


def test_last_one_to_leave_deletes_claims_and_records(tmp_path):
    with Claims(tmp_path) as claims:
        claims.write_record("a", {"x": [0.1, float("nan")]})
        assert claims.record("a")["x"][0] == 0.1
        assert claims.record("b") is None
    assert list(tmp_path.iterdir()) == []


def test_directory_stays_while_another_command_takes_part(tmp_path):
    with Claims(tmp_path) as claims:
        other = tmp_path / ".claims" / f"member-{machine()}-1"
        written_by(other, process=os.getppid(), started=birth(os.getppid()))
        claims.write_record("a", {})
    assert other.is_file()
    assert not (tmp_path / ".claims" / f"member-{machine()}-{os.getpid()}").exists()


@pytest.mark.parametrize("case", ["ended", "number used again", "other machine silent", "empty and old"])
def test_claim_without_an_owner_is_taken_over(tmp_path, ended, case):
    with Claims(tmp_path) as claims:
        claims.take("a")
        [path] = claim_files(tmp_path)
        if case == "ended":
            written_by(path, process=ended[0], started=ended[1])
        elif case == "number used again":
            written_by(path, process=os.getppid(), started="12")
        elif case == "other machine silent":
            written_by(path, host="other", age=claims_module.LOST + 30)
        else:
            path.write_text("")
            os.utime(path, (time.time() - claims_module.LOST - 30,) * 2)
        second = claims.take("a")
        assert second is not None
        assert claims.take("a") is None
        with second:
            pass
        assert claim_files(tmp_path) == []


@pytest.mark.parametrize("case", ["this machine", "other machine", "not yet written"])
def test_claim_of_a_living_owner_is_not_taken_over(tmp_path, case):
    with Claims(tmp_path) as claims:
        claims.take("a")
        [path] = claim_files(tmp_path)
        if case == "this machine":  # however long it has been silent, such as a stopped process
            written_by(path, process=os.getppid(), started=birth(os.getppid()), age=claims_module.LOST + 30)
        elif case == "other machine":
            written_by(path, host="other", age=claims_module.LOST - 30)
        else:
            path.write_text("")
        assert claims.take("a") is None


def test_time_of_a_claim_is_not_one_that_was_remembered(tmp_path, monkeypatch):
    with Claims(tmp_path) as claims:
        claims.take("a")
        [path] = claim_files(tmp_path)
        written_by(path, host="other", age=claims_module.LOST + 30)
        remembered, stat = path.stat(), Path.stat
        written_by(path, host="other")
        monkeypatch.setattr(Path, "stat", lambda each, **_: remembered if each == path else stat(each))  # as NFS does
        assert claims.take("a") is None


def test_claim_is_kept_fresh(tmp_path, monkeypatch):
    monkeypatch.setattr(claims_module, "BEAT", 0.01)
    with Claims(tmp_path) as claims, claims.take("a"):
        [path] = claim_files(tmp_path)
        os.utime(path, (1.0, 1.0))
        deadline = time.monotonic() + 10
        while path.stat().st_mtime < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert path.stat().st_mtime > 2


def _race(folder, start, queue):
    with Claims(folder) as claims:
        start.wait()
        queue.put([name for name in map(str, range(40)) if claims.take(name) is not None])
        start.wait()


def test_processes_that_race_for_claims_get_different_ones(tmp_path, ended):
    context = multiprocessing.get_context("fork")
    with Claims(tmp_path) as claims:
        for name in map(str, range(20)):  # these have to be taken over
            claims.take(name)
        for path in claim_files(tmp_path):
            written_by(path, process=ended[0], started=ended[1])
        start, queue = context.Barrier(3), context.Queue()
        racers = [context.Process(target=_race, args=(tmp_path, start, queue)) for _ in range(3)]
        for racer in racers:
            racer.start()
        taken = [name for _ in racers for name in queue.get(timeout=60)]
        for racer in racers:
            racer.join(60)
    assert sorted(taken, key=int) == list(map(str, range(40)))


def test_birth_tells_an_ended_process_even_before_it_is_collected(ended):
    assert birth(os.getpid()) not in (None, "")
    assert birth(ended[0]) != ended[1]
    with subprocess.Popen(["sleep", "60"]) as process:
        os.kill(process.pid, signal.SIGKILL)
        deadline = time.monotonic() + 10
        while birth(process.pid) is not None and time.monotonic() < deadline:
            time.sleep(0.01)
        assert birth(process.pid) is None

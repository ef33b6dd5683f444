"""A claim has one owner at a time, and is taken over when its owner is gone, but never before."""

import contextlib
import json
import multiprocessing
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from dsr.evaluation import sharing as claims_module
from dsr.evaluation.sharing import LOST, Claims, InUseError
from dsr.utils.files import birth, machine

FORK = multiprocessing.get_context("fork")
NAMES = list(map(str, range(40)))


class Command:
    """A process that takes part, and claims what it is asked for, until it is asked to leave or is killed."""

    def __init__(self, folder, host, settings=None, begin=None):
        self._here, there = FORK.Pipe()
        self.process = FORK.Process(target=self._run, args=(folder, host, settings, begin, there), daemon=True)
        self.process.start()
        there.close()
        self.takes_part = self._here.recv() if begin is None else None

    @staticmethod
    def _run(folder, host, settings, begin, connection):
        claims_module.machine = lambda: host
        claims_module.BEAT = 0.02
        if begin is not None:
            begin.wait(30)
        try:
            claims = Claims(folder, settings).__enter__()
        except InUseError:
            connection.send(False)
            return
        with contextlib.closing(contextlib.ExitStack()) as stack:
            stack.push(claims)
            connection.send(True)
            while names := connection.recv():
                taken = {name: claim for name in names if (claim := claims.take(name)) is not None}
                connection.send(list(taken))
        connection.send([])

    def ask(self, *names):
        self._here.send(names)

    def answer(self):
        return self._here.recv()

    def take(self, *names):
        self.ask(*names)
        return self.answer()

    def leave(self):
        self.ask()
        self.answer()
        self.process.join()

    def send(self, number):
        os.kill(self.process.pid, number)
        if number == signal.SIGKILL:
            self.process.join()
        else:
            os.waitpid(self.process.pid, os.WUNTRACED)


@pytest.fixture
def start(tmp_path):
    """Return a function that starts a process that takes part, on this machine or on another."""
    commands = []

    def begin(host=None, settings=None, begin=None):
        commands.append(Command(tmp_path / "run", host or machine(), settings, begin))
        return commands[-1]

    yield begin
    for command in commands:
        command.process.kill()
        command.process.join()


def claim_file(folder):
    [path] = (path for path in (folder / ".claims").iterdir() if not path.name.startswith("member-"))
    return path


def make_old(path, age=LOST + 30):
    os.utime(path, (time.time() - age,) * 2)


def written_by(path, process, started):
    path.write_text(json.dumps({"machine": machine(), "process": process, "birth": started}))


def test_claim_is_refused_until_it_is_given_back(tmp_path, start):
    other = start()
    with Claims(tmp_path / "run") as claims:
        with claims.take("scene a"):
            assert claims.take("scene a") is None
            assert other.take("scene a", "scene b") == ["scene b"]
            assert claims.take("scene b") is None
        assert other.take("scene a") == ["scene a"]


def test_claim_of_a_killed_process_is_taken_over_at_once_by_one(tmp_path, start):
    killed, other = start(), start()
    assert killed.take("a") == ["a"]
    with Claims(tmp_path / "run") as claims:
        killed.send(signal.SIGKILL)
        with claims.take("a"):
            assert claims.take("a") is None
            assert other.take("a") == []
        assert other.take("a") == ["a"]


def test_claim_of_a_process_that_is_stopped_is_its_own(tmp_path, start):
    stopped = start()
    stopped.take("a")
    stopped.send(signal.SIGSTOP)
    with Claims(tmp_path / "run") as claims:
        make_old(claim_file(tmp_path / "run"))
        assert claims.take("a") is None


def test_claim_of_another_machine_is_its_own_while_it_is_kept_fresh(tmp_path, start):
    start("elsewhere").take("a")
    make_old(path := claim_file(tmp_path / "run"))
    deadline = time.monotonic() + 30
    while path.stat().st_mtime < time.time() - LOST and time.monotonic() < deadline:
        time.sleep(0.01)
    with Claims(tmp_path / "run") as claims:
        assert claims.take("a") is None


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
def test_claim_of_another_machine_is_taken_over_once_it_is_silent_for_long(tmp_path, start, end):
    silent, other = start("elsewhere"), start()
    silent.take("a")
    silent.send(end)
    assert other.take("a") == []
    make_old(claim_file(tmp_path / "run"), LOST - 30)
    assert other.take("a") == []
    make_old(claim_file(tmp_path / "run"))
    assert other.take("a") == ["a"]


def test_last_one_to_leave_deletes_claims_and_records(tmp_path, start):
    other, killed = start(), start()
    killed.take("b")
    killed.send(signal.SIGKILL)
    with Claims(tmp_path / "run") as claims:
        claims.write_record("a", {"x": [0.1, float("nan")]})
        assert claims.record("a")["x"][0] == 0.1
        assert claims.record("b") is None
    assert len(list((tmp_path / "run" / ".claims").glob("*-record.json"))) == 1
    other.leave()
    assert not (tmp_path / "run" / ".claims").exists()


@pytest.mark.parametrize("case", ["number used again", "killed before it was written"])
def test_claim_of_no_process_is_taken_over(tmp_path, case):
    with Claims(tmp_path / "run") as claims:
        claims.take("a")
        path = claim_file(tmp_path / "run")
        if case == "number used again":
            written_by(path, os.getppid(), "12")
        else:
            path.write_text("")
            assert claims.take("a") is None
            make_old(path)
        with claims.take("a"):
            assert claims.take("a") is None
        assert claims.take("a") is not None


HOSTILE = {
    "no text": b"\xff\xfe",
    "nested": b"[" * 100_000,
    "a process without end": json.dumps({"machine": machine(), "process": 10**30, "birth": "1"}).encode(),
    "an infinite process": b'{"machine": "%s", "process": Infinity, "birth": "1"}' % machine().encode(),
    "endless": b" " * (1 << 22),
}


@pytest.mark.parametrize("case", [*HOSTILE, "a pipe", "a folder"])
def test_claim_that_a_stranger_left_keeps_nobody_from_the_work_for_long(tmp_path, case):
    with Claims(tmp_path) as claims:
        claims.take("a").pop_all()  # is not given back
        [path] = (path for path in (tmp_path / ".claims").iterdir() if not path.name.startswith("member-"))
        path.unlink()
        if case == "a pipe":
            os.mkfifo(path)
        elif case == "a folder":
            path.mkdir()
        else:
            path.write_bytes(HOSTILE[case])
        if case not in ("a process without end",):  # which has ended
            assert claims.take("a") is None
        os.utime(path, (time.time() - LOST - 1,) * 2)
        assert claims.take("a") is not None


def test_time_of_a_claim_is_not_one_that_was_remembered(tmp_path, start, monkeypatch):
    silent = start("elsewhere")
    silent.take("a")
    silent.send(signal.SIGSTOP)
    with Claims(tmp_path / "run") as claims:
        make_old(path := claim_file(tmp_path / "run"))
        remembered, stat = path.stat(), Path.stat
        make_old(path, 0)
        monkeypatch.setattr(Path, "stat", lambda each, **_: remembered if each == path else stat(each))  # as NFS does
        assert claims.take("a") is None


def test_processes_that_race_for_claims_get_different_ones(start):
    killed, racers = start(), [start() for _ in range(3)]
    killed.take(*NAMES[:20])  # these have to be taken over
    killed.send(signal.SIGKILL)
    for racer in racers:
        racer.ask(*NAMES)
    assert sorted((name for racer in racers for name in racer.answer()), key=int) == NAMES


def test_directory_is_that_of_one_set_of_settings_while_somebody_is_at_work(tmp_path, start):
    first, second = start(settings="a"), start(settings="a")
    with pytest.raises(InUseError, match=f"process {first.process.pid} of |process {second.process.pid} of "):
        Claims(tmp_path / "run", "b").__enter__()
    with Claims(tmp_path / "run"):  # a part of a command that takes part
        pass
    first.leave()
    assert not start(settings="b").takes_part
    second.send(signal.SIGKILL)
    assert start(settings="b").takes_part
    assert not start(settings="a").takes_part


def test_one_of_many_that_begin_at_once_has_the_directory(start):
    for _ in range(5):
        begin = FORK.Barrier(6)
        rivals = [start(settings=str(number), begin=begin) for number in range(6)]
        won = [rival for rival in rivals if rival.answer()]
        assert len(won) == 1
        won[0].leave()


@pytest.mark.parametrize(("silent", "refused"), [("killed", False), ("stopped", False), ("at work", True)])
def test_sign_of_life_of_another_machine_is_waited_for(start, monkeypatch, silent, refused):
    monkeypatch.setattr(claims_module, "LOST", 1.0)
    other = start("elsewhere", "a")
    if silent != "at work":
        other.send(signal.SIGKILL if silent == "killed" else signal.SIGSTOP)
    assert start(settings="b").takes_part is not refused


def test_stopped_process_of_this_machine_keeps_the_directory(tmp_path, start, monkeypatch):
    monkeypatch.setattr(claims_module, "LOST", 0.1)
    start(settings="a").send(signal.SIGSTOP)
    assert not start(settings="b").takes_part


def test_member_that_was_taken_for_lost_comes_back(tmp_path, start):
    start(settings="a")
    [member] = (tmp_path / "run" / ".claims").glob("member-*")
    member.unlink()
    deadline = time.monotonic() + 30
    while not member.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    while not member.stat().st_size and time.monotonic() < deadline:  # until it is written
        time.sleep(0.01)
    assert not start(settings="b").takes_part


def test_directory_that_was_made_for_claims_is_gone_with_them_unless_it_is_used(tmp_path):
    with Claims(tmp_path / "new" / "run", "a"):
        assert (tmp_path / "new" / "run" / ".claims").is_dir()
    assert list(tmp_path.iterdir()) == []
    with Claims(tmp_path / "new" / "run", "a"):
        (tmp_path / "new" / "run" / "file").touch()
    assert [path.name for path in (tmp_path / "new" / "run").iterdir()] == ["file"]


def test_birth_identifies_an_ended_process_even_before_it_is_collected():
    assert birth(os.getpid()) not in (None, "")
    with subprocess.Popen(["sleep", "60"]) as process:
        started = birth(process.pid)
        os.kill(process.pid, signal.SIGKILL)
        deadline = time.monotonic() + 10
        while birth(process.pid) is not None and time.monotonic() < deadline:
            time.sleep(0.01)
        assert birth(process.pid) is None
    assert birth(process.pid) != started

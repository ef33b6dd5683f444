"""Worker processes and locks: each item once, also where a worker is killed; settings keep a folder for themselves."""

import functools
import os
import signal
import threading
import time

import pytest
import torch

from dsr.report.worker_pool import WorkerPool
from dsr.utils.files import replacing
from dsr.utils.processes import LOCKS, InUseError, Pool, at_work, free_first


def answer(kill, item):
    """Return an item in capitals, the process, its threads and signals; it is killed at "k" as often as told."""
    folder, times = kill
    if item == "k" and len(list(folder.iterdir())) < times:
        (folder / str(os.getpid())).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    return item.upper(), os.getpid(), torch.get_num_threads(), signal.SIGINT in blocked


def draw(results, number):
    return None if number is None else results[number]


def test_items_of_a_killed_worker_are_done_by_others_and_threads_are_those_asked_for(tmp_path):
    lines = []
    with Pool(2, threads=1, say=lines.append) as pool:
        found = dict(pool.results(functools.partial(answer, (tmp_path, 1)), list("ijklm")))
    assert {item: value[0] for item, value in found.items()} == {item: item.upper() for item in "ijklm"}
    assert {value[2:] for value in found.values()} == {(1, True)}  # Ctrl-C is left to the parent
    assert len(lines) == 1
    for process in {value[1] for value in found.values()}:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


def test_workers_that_are_killed_twice_are_an_error(tmp_path):
    with Pool(1) as pool, pytest.raises(ChildProcessError, match="killed"):
        list(pool.results(functools.partial(answer, (tmp_path, 2)), ["k", "l"]))


def test_parts_of_a_report_come_in_their_order():
    with WorkerPool([7, 8, 9], 2) as work:
        values, others = work.map(draw, [None, 0, 1, 2]), work.map(draw, [2, 1])
        assert list(others) == [9, 8]
        assert list(values) == [None, 7, 8, 9]


def write_half(folder, name):
    with replacing(folder / name) as temporary:
        temporary.write_bytes(b"half")
        time.sleep(60)


def test_workers_that_are_ended_while_they_write_leave_no_temporary_file(tmp_path):
    def interrupt():
        while not list(tmp_path.iterdir()):
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt), Pool(1) as pool:
        list(pool.results(functools.partial(write_half, tmp_path), ["file.png"]))
    assert list(tmp_path.iterdir()) == []


def test_folder_is_for_commands_of_the_same_settings_and_kept_without_the_locks(tmp_path):
    with at_work(tmp_path / "new" / "run", "its"):
        with pytest.raises(InUseError, match=f"process {os.getpid()} of "), at_work(tmp_path / "new" / "run", "others"):
            pass
        assert (tmp_path / "new" / "run" / LOCKS).is_dir()
        assert list(free_first(tmp_path / "new" / "run", ["a", "b"])) == ["a", "b"]
        (tmp_path / "new" / "run" / "file").touch()
    assert [path.name for path in (tmp_path / "new" / "run").iterdir()] == ["file"]

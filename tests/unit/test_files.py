"""Files are written whole or not at all, say when the disk is full, and what killed processes leave is removed."""

import errno
import os
import pickle
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from dsr.utils import files
from dsr.utils.files import FullDiskError, replacing, replacing_folder, silence_threads, write_text


@pytest.fixture(autouse=True)
def fresh():
    """Look after abandoned files in every test, as in a process of its own."""
    files.remove_abandoned.cache_clear()


def abandoned(folder: Path) -> Path:
    """Let a process that is killed leave a temporary file."""
    code = (
        "import os, sys; from pathlib import Path; from dsr.utils.files import replacing\n"
        "with replacing(Path(sys.argv[1])): os._exit(9)"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run([sys.executable, "-c", code, str(folder / "s2.png")], check=False, env=environment)
    [left] = folder.iterdir()
    return left


def test_temporary_file_of_a_killed_process_is_removed_by_the_next_write(tmp_path: Path) -> None:
    left = abandoned(tmp_path)
    assert left.name.startswith(".s2-")
    write_text(tmp_path / "other.txt", "text")
    assert [path.name for path in tmp_path.iterdir()] == ["other.txt"]


def test_temporary_files_of_running_processes_and_of_others_are_kept(tmp_path: Path) -> None:
    machine = files.owner().partition("-")[0]
    names = [f".a-{files.owner()}-abcdefgh.png", f".a-{machine}-1-abcdefgh", ".a-000000-99999999-abcdefgh.png",
             ".hidden", "a-b-c.png"]  # fmt: skip
    for name in names:
        (tmp_path / name).write_text("")
    write_text(tmp_path / "new.txt", "text")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*names, "new.txt"])


def test_temporary_directory_of_a_killed_process_is_removed(tmp_path: Path) -> None:
    machine = files.owner().partition("-")[0]
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    (tmp_path / f".report-{machine}-{dead.pid}-abcdefgh" / "tables").mkdir(parents=True)
    with replacing_folder(tmp_path / "report") as folder:
        (folder / "index.html").write_text("new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report"]


def test_folder_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    with replacing_folder(tmp_path / "report") as folder:
        (folder / "old.html").write_text("old")
    with pytest.raises(FileNotFoundError), replacing_folder(tmp_path / "report") as folder:
        (folder / "missing.html").read_text()
    assert [path.name for path in (tmp_path / "report").iterdir()] == ["old.html"]
    with replacing_folder(tmp_path / "report") as folder:
        (folder / "new.html").write_text("new")
    assert [path.name for path in (tmp_path / "report").iterdir()] == ["new.html"]
    assert [path.name for path in tmp_path.iterdir()] == ["report"]


def test_full_disk_names_the_file_and_the_space_and_keeps_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "scores.csv"
    path.write_text("before")
    with pytest.raises(FullDiskError) as caught, replacing(path):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert str(caught.value).startswith(f"{path}: expected space to write the file, got a device with ")
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_full_disk_is_recognised_where_a_library_only_says_that_it_failed(tmp_path: Path, monkeypatch) -> None:
    def write() -> None:
        with replacing(tmp_path / "a.exr"):
            raise RuntimeError("could not write")

    with pytest.raises(RuntimeError):
        write()
    monkeypatch.setattr(files, "_LITTLE", 1 << 62)
    with pytest.raises(FullDiskError):
        write()


def test_full_disk_of_a_worker_keeps_its_message(tmp_path: Path) -> None:
    error = FullDiskError(tmp_path / "a.png")
    again = pickle.loads(pickle.dumps(error))
    assert isinstance(again, FullDiskError)
    assert str(again) == str(error)


def test_threads_say_nothing_of_a_full_disk_alone(monkeypatch, capsys) -> None:
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)
    silence_threads()
    for number, silent in ((errno.ENOSPC, True), (errno.EACCES, False)):
        thread = threading.Thread(target=open, args=("nowhere/a",), kwargs={"opener": _failing(number)})
        thread.start()
        thread.join()
        assert ("Traceback" not in capsys.readouterr().err) == silent


def _failing(number: int):
    """Return what opens no file."""

    def fail(*_: object) -> int:
        raise OSError(number, os.strerror(number))

    return fail


def test_other_errors_stay_as_they_are(tmp_path: Path) -> None:
    with pytest.raises(PermissionError), replacing(tmp_path / "a.txt"):
        raise PermissionError(errno.EACCES, "Permission denied", "a.txt")

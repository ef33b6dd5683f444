"""Files are written whole or not at all, and say when the disk is full."""

import errno
import os
import pickle
import re
import socket
import stat
from pathlib import Path

import captures
import pytest

from dsr.cli import main
from dsr.utils.files import FullDiskError, TargetError, expect_own, replacing, replacing_folder, write_text


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


def test_full_disk_of_a_worker_keeps_its_message(tmp_path: Path) -> None:
    error = FullDiskError(tmp_path / "a.png")
    again = pickle.loads(pickle.dumps(error))
    assert isinstance(again, FullDiskError)
    assert str(again) == str(error)


def test_other_errors_stay_as_they_are(tmp_path: Path) -> None:
    with pytest.raises(PermissionError), replacing(tmp_path / "a.txt"):
        raise PermissionError(errno.EACCES, "Permission denied", "a.txt")


def device(path: Path) -> None:
    """Make a device where the system lets us, or a link to one, which is refused as well."""
    try:
        os.mknod(path, 0o600 | stat.S_IFCHR, os.makedev(1, 3))
    except PermissionError:
        path.symlink_to(os.devnull)


def unix_socket(path: Path) -> None:
    """Make a socket; its address would be too long in some temporary directories."""
    here = os.open(path.parent, os.O_RDONLY)
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(f"/proc/self/fd/{here}/{path.name}")
    os.close(here)


def link(path: Path) -> None:
    """Make a link to a file."""
    path.with_name("mine").write_text("precious")
    path.symlink_to("mine")


NO_FILES = {
    "a device": device,
    "a pipe": os.mkfifo,
    "a socket": unix_socket,
    "a link": link,
    "a link to nothing": lambda path: path.symlink_to("nothing"),
    "a folder": Path.mkdir,
}


@pytest.fixture(params=NO_FILES)
def taken(tmp_path: Path, request) -> Path:
    """A path where something is that is no file."""
    path = tmp_path / "taken.ply"
    NO_FILES[request.param](path)
    return path


def test_target_that_is_no_file_is_refused_and_stays_as_it_is(taken: Path) -> None:
    before = (taken.lstat(), sorted(taken.parent.iterdir()))
    with pytest.raises(TargetError) as caught, replacing(taken):
        pytest.fail("the work has begun")
    assert str(caught.value).startswith(f"{taken}: expected a file to write, got ")
    assert (taken.lstat(), sorted(taken.parent.iterdir())) == before


def test_target_that_becomes_a_link_during_the_work_stays_one(tmp_path: Path) -> None:
    with pytest.raises(TargetError), replacing(tmp_path / "a.txt"):
        (tmp_path / "a.txt").symlink_to("nothing")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


COMMANDS = {
    "fuse": ("fuse", "runs", "-o"),
    "export": ("export", "--onnx"),
    "view": ("view", "runs", "--no-open", "-o"),
    "study collect": ("study", "collect", "runs", "runs", "-o"),
    "report": ("report", "runs", "-o"),
    "study build": ("study", "build", "runs", "-o"),
    "upsample": ("upsample", "--rgb", "a.png", "--depth", "b.png", "-o"),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_refuse_a_target_that_is_no_file_before_they_read_anything(taken, command, capsys, monkeypatch):
    monkeypatch.chdir(taken.parent)  # where nothing that is named is there
    if taken.is_dir() and command in ("report", "study build", "upsample"):
        return  # a folder is what they expect
    before = sorted(taken.parent.iterdir())
    assert main([*COMMANDS[command], str(taken)]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert re.match(r"error: (-o|--onnx): expected a (file|folder) to write, got a ", line)
    assert line.endswith(f": {taken}")
    assert sorted(taken.parent.iterdir()) == before


def test_folders_may_be_links_and_stay_links(tmp_path: Path) -> None:
    (tmp_path / "disk" / "outputs").mkdir(parents=True)
    (tmp_path / "outputs").symlink_to("disk/outputs")
    write_text(tmp_path / "outputs" / "run" / "a.txt", "a")
    with replacing_folder(tmp_path / "outputs") as folder:
        (folder / "index.html").write_text("new")
    assert (tmp_path / "outputs").is_symlink()
    assert [path.name for path in (tmp_path / "disk" / "outputs").iterdir()] == ["index.html"]


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077, 0o002])
def test_new_files_and_folders_follow_the_umask(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        write_text(tmp_path / "a" / "b.txt", "text")
        with replacing_folder(tmp_path / "report") as folder:
            (folder / "index.html").write_text("new")
    finally:
        os.umask(before)
    made = {path.relative_to(tmp_path).as_posix(): stat.S_IMODE(path.stat().st_mode) for path in tmp_path.rglob("*")}
    file, directory = 0o666 & ~umask, 0o777 & ~umask
    assert made == {"a": directory, "a/b.txt": file, "report": directory, "report/index.html": file}


def test_folder_of_a_stranger_may_link_within_itself_alone(tmp_path: Path) -> None:
    (tmp_path / "run" / "wandb" / "run-1").mkdir(parents=True)
    (tmp_path / "run" / "wandb" / "latest-run").symlink_to("run-1")
    expect_own(tmp_path / "run")
    (tmp_path / "run" / "wandb" / "run-1" / "a").symlink_to(tmp_path / "mine")
    with pytest.raises(TargetError, match=r"run-1/a: expected .*, got a link to .*/mine"):
        expect_own(tmp_path / "run")


@pytest.mark.parametrize("name", ["depth_metres.tiff", "info.json", "renderings", "transforms.json", "exports.json"])
def test_upsampling_replaces_no_link_in_the_folder_of_its_results(tmp_path, capsys, name):
    captures.save(tmp_path / "photo.png", captures.photo())
    captures.save(tmp_path / "depth.png", captures.millimetres())
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).symlink_to(tmp_path / "elsewhere" if name == "renderings" else tmp_path / "nothing")
    inputs = ["--rgb", str(tmp_path / "photo.png"), "--depth", str(tmp_path / "depth.png")]
    given = ["upsample", *inputs, "-o", str(tmp_path / "out"), "--method", "nearest", "--with", "rgbd,nerfstudio"]
    assert main(given) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert str(tmp_path / "out") in line
    assert ("got a link to" in line) == (name != "renderings")
    assert [path.name for path in (tmp_path / "out").iterdir()] == [name]
    assert not list((tmp_path / "elsewhere").iterdir())


def test_evaluation_writes_through_no_link_in_the_directory_of_its_run(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "disk").mkdir()
    (tmp_path / "outputs").symlink_to("disk")  # of the user's own, on another disk
    given = ["eval", "dataset=procedural", "dataset.count=1", "dataset.size=32", "scale=2", "method=nearest",
             "metrics.lpips=false", "device=cpu", "output_dir=outputs/run"]  # fmt: skip
    assert main(given) == 0
    for name, place in (("scores.csv", "mine"), ("predictions", "elsewhere"), ("extra", "/dev/null")):
        path = tmp_path / "disk" / "run" / name
        kept = path.rename(tmp_path / place) if path.exists() else None
        path.symlink_to(tmp_path / place)
        for more in ([], ["overwrite=true"]):
            with pytest.raises(SystemExit):
                main([*given, *more])
            line = capsys.readouterr().err.splitlines()[-1]
            assert line.startswith(f"error: output_dir: outputs/run/{name}: expected ")
        path.unlink()
        if kept is not None:
            kept.rename(path)
    assert main(given) == 0
    for target in ("/dev/null", "nothing"):
        (tmp_path / "link").unlink(missing_ok=True)
        (tmp_path / "link").symlink_to(target)
        with pytest.raises(SystemExit):
            main([*given[:-1], "output_dir=link"])
        assert f"output_dir: link: expected a folder to write, got a link to {target}" in capsys.readouterr().err

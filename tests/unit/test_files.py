"""Files are written whole or not at all, and neither written nor read outside of the folder that they belong to."""

import errno
import os
import pickle
import re
import shutil
import stat
from pathlib import Path

import captures
import pytest

from dsr.cli import main
from dsr.evaluation.run_files import load_results
from dsr.sample import DepthSample
from dsr.utils.files import FullDiskError, TargetError, expect_own, replacing, replacing_folder, write_text
from dsr.utils.guards import OutsideError, path_within


def refused(capsys, *arguments):
    """Return the one line of a command that is refused."""
    assert main([str(argument) for argument in arguments]) == 2
    [line] = capsys.readouterr().err.splitlines()
    return line.removeprefix("error: ")


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
    again = pickle.loads(pickle.dumps(caught.value))  # as from a worker
    assert isinstance(again, FullDiskError)
    assert str(again) == str(caught.value)


def link(path: Path) -> None:
    """Make a link to a file."""
    path.with_name("mine").write_text("precious")
    path.symlink_to("mine")


NO_FILES = {
    "a pipe": os.mkfifo,
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
    line = refused(capsys, *COMMANDS[command], taken)
    assert re.match(r"(-o|--onnx): expected a (file|folder) to write, got a ", line)
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
    inputs = "--rgb", tmp_path / "photo.png", "--depth", tmp_path / "depth.png"
    given = "upsample", *inputs, "-o", tmp_path / "out", "--method", "nearest", "--with", "rgbd,nerfstudio"
    line = refused(capsys, *given)
    assert str(tmp_path / "out") in line
    assert ("got a link to" in line) == (name != "renderings")
    assert [path.name for path in (tmp_path / "out").iterdir()] == [name]
    assert not list((tmp_path / "elsewhere").iterdir())


EVALUATION = ("eval", "dataset=procedural", "dataset.count=1", "dataset.size=32", "scale=2", "method=nearest",
              "metrics.lpips=false", "device=cpu")  # fmt: skip


def test_evaluation_writes_through_no_link_in_the_directory_of_its_run(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "disk").mkdir()
    (tmp_path / "outputs").symlink_to("disk")  # of the user's own, on another disk
    given = [*EVALUATION, "output_dir=outputs/run"]
    assert main(given) == 0
    path = tmp_path / "disk" / "run" / "predictions"
    path.symlink_to(path.rename(tmp_path / "elsewhere"))
    (tmp_path / "link").symlink_to("nothing")
    for more, said in (
        ([], "outputs/run/predictions: expected "), (["overwrite=true"], "outputs/run/predictions: expected "),
        (["output_dir=link"], "link: expected a folder to write, got a link to nothing"),
    ):  # fmt: skip
        with pytest.raises(SystemExit):
            main([*given, *more])
        assert capsys.readouterr().err.splitlines()[-1].startswith(f"error: output_dir: {said}")


# Names that a file gives lead to no file outside of its folder


UP = "../private/x"
OUTSIDE = (
    UP, "..", "a/../../x", "/etc/passwd", "//server/share/x", "\\\\server\\share\\x", "..\\private\\x", "a\\..\\..\\x",
    "\\x", "C:\\x", "C:x", "c:/x", "x\0y",
)  # fmt: skip
INSIDE = ("x", "a/b/x.png", "..x", "x..", "a b/é.png", "1305031102.175304.png", "living_room_traj2/0120")


@pytest.fixture
def folder(tmp_path):
    """A folder beside a private one that has the file x."""
    (tmp_path / "private").mkdir()
    (tmp_path / "private" / "x").touch()
    path = tmp_path / "capture"
    path.mkdir()
    return path


@pytest.mark.parametrize("name", OUTSIDE)
def test_name_that_leads_outside_on_any_system_is_refused(folder, name):
    with pytest.raises(OutsideError, match=r"^list\.txt: line 3: expected a name within ") as caught:
        path_within(folder, name, "list.txt: line 3")
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("name", INSIDE)
def test_name_that_stays_within_its_folder_is_a_path_there(folder, name):
    assert path_within(folder, name, "list.txt") == folder / name


@pytest.mark.parametrize("kind", ["file", "folder", "loop"])
def test_links_count_with_where_they_lead_but_that_of_the_folder_itself(folder, tmp_path, kind):
    (tmp_path / "named").symlink_to(folder)
    (folder / "own").mkdir()
    (folder / "near").symlink_to("own")
    assert path_within(tmp_path / "named", "near/x", "list.txt") == tmp_path / "named" / "near" / "x"
    (folder / "far").symlink_to({"file": "../private/x", "folder": "../private", "loop": "far"}[kind])
    if kind == "loop":  # leads nowhere
        assert path_within(folder, "far", "list.txt") == folder / "far"
        return
    with pytest.raises(OutsideError, match=r"a link to .*/private/x"):
        path_within(folder, "far" if kind == "file" else "far/x", "list.txt")


@pytest.mark.parametrize("kind", ["rgb", "depth"])
@pytest.mark.parametrize("name", ["absolute", "../private/1.png", "C:\\private\\1.png", "link/1.png"])
def test_lists_of_tum_name_no_pictures_outside(folder, tmp_path, capsys, kind, name):
    captures.tum(folder, "{}".format)
    (folder / kind / "1.png").rename(tmp_path / "private" / "1.png")
    (folder / "link").symlink_to(tmp_path / "private")
    path = folder / f"{kind}.txt"
    given = str(tmp_path / "private" / "1.png") if name == "absolute" else name
    path.write_text(path.read_text().replace(f"{kind}/1.png", given))
    reported = refused(capsys, "upsample", folder, "-o", tmp_path / "out", "--dry-run")
    assert reported.startswith(f"{path}: line 2: expected a name within {folder}, got {given!r}")
    assert ("name the folder that has the files themselves" in reported) == (name == "link/1.png")
    assert not (tmp_path / "out").exists()


def test_recording_of_ros_takes_no_files_outside(folder, tmp_path, capsys):
    pytest.importorskip("rosbags")
    scan = captures.ros(folder / "scan", 2)
    [file] = scan.glob("*.db3")
    file.rename(tmp_path / "private" / file.name)
    file.symlink_to(tmp_path / "private" / file.name)
    reported = refused(capsys, "upsample", scan, "-o", tmp_path / "out", "--dry-run")
    assert reported.startswith(f"{scan}/metadata.yaml: relative_file_paths: expected a name within {scan}, got")


def hostile_run(make_run, tmp_path, name, *, file):
    """Write a run of which one file names a scene outside, whose prediction and sample are there; and a sound one."""
    make_run(tmp_path / "runs" / "sound", label="Other")
    run = make_run(tmp_path / "runs" / "run")
    for kind in ("scenes", "predictions"):
        for target in (run / kind / f"{name}.npz", tmp_path / "private" / "x.npz"):
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(run / kind / "cube_no_texture.npz", target)
    path = run / file
    path.write_text(path.read_text().replace("cube_no_texture", name))
    return run


@pytest.mark.parametrize("command", [("report",), ("study", "build")])
@pytest.mark.parametrize(
    ("file", "place"), [("summary.json", "summary.json: seconds"), ("scores.csv", "scores.csv: line 2")]
)
def test_run_that_names_scenes_outside_is_neither_read_nor_published(make_run, tmp_path, capsys, command, file, place):
    run = hostile_run(make_run, tmp_path, "../../../private/x", file=file)
    reported = refused(capsys, *command, tmp_path / "runs", "-o", tmp_path / "out")
    assert reported == f"{run}/{place}: expected a name within {run}, got '../../../private/x'"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("place", ["predictions", "predictions/cube_no_texture.npz", "scenes"])
def test_run_whose_scenes_are_links_to_outside_is_refused(make_run, tmp_path, place):
    run = make_run(tmp_path / "run")
    (run / place).rename(tmp_path / "elsewhere")
    (run / place).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutsideError, match=r"summary\.json: seconds: .* a link to .*/elsewhere"):
        load_results([run])


def test_evaluation_draws_no_picture_where_a_stored_sample_says(tmp_path, capsys):
    arguments = [*EVALUATION, f"output_dir={tmp_path / 'run'}"]
    assert main(arguments) == 0
    path = tmp_path / "run" / "scenes" / "00000.npz"
    sample = DepthSample.load(path)
    object.__setattr__(sample, "scene", "../../evil")
    sample.save(path)
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert f"{path}: expected the scene 00000, got '../../evil'" in capsys.readouterr().err
    assert not list(tmp_path.glob("evil*"))

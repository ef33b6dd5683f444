"""Names that a file gives lead to no file outside of its folder: every reader refuses them in one line."""

import json
import shutil

import captures
import numpy as np
import pytest

from dsr.cli import main
from dsr.evaluation.results import prediction_path, sample_path
from dsr.evaluation.run_files import load_results
from dsr.sample import DepthSample
from dsr.utils.guards import OutsideError, path_within

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


def refused(capsys, *arguments):
    """Return the one line of a command that is refused."""
    assert main([str(argument) for argument in arguments]) == 2
    [line] = capsys.readouterr().err.splitlines()
    return line.removeprefix("error: ")


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


def write_tum(folder):
    """Write two frames in TUM's layout."""
    for kind, values in (("rgb", captures.photo), ("depth", captures.millimetres)):
        lines = ["# timestamp filename"]
        for number in range(2):
            captures.save(folder / kind / f"{number}.png", values(number))
            lines.append(f"{number}.5 {kind}/{number}.png")
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("kind", ["rgb", "depth"])
@pytest.mark.parametrize("name", ["absolute", "../private/1.png", "C:\\private\\1.png", "link/1.png"])
def test_lists_of_tum_name_no_pictures_outside(folder, tmp_path, capsys, kind, name):
    write_tum(folder)
    (folder / kind / "1.png").rename(tmp_path / "private" / "1.png")
    (folder / "link").symlink_to(tmp_path / "private")
    path = folder / f"{kind}.txt"
    given = str(tmp_path / "private" / "1.png") if name == "absolute" else name
    path.write_text(path.read_text().replace(f"{kind}/1.png", given))
    reported = refused(capsys, "upsample", folder, "-o", tmp_path / "out", "--dry-run")
    assert reported.startswith(f"{path}: line 3: expected a name within {folder}, got {given!r}")
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


@pytest.mark.parametrize("path", [prediction_path, sample_path])
def test_files_of_a_scene_that_leads_outside_have_no_path(folder, path):
    with pytest.raises(OutsideError, match=r"scene: expected a name within"):
        path(folder, UP)


def test_evaluation_draws_no_picture_where_a_stored_sample_says(tmp_path, capsys):
    scene = tmp_path / "scenes" / "room"
    captures.save(scene / "rgb.png", captures.photo())
    fx, fy, cx, cy = captures.INTRINSICS
    (scene / "camera.json").write_text(json.dumps({"width": 64, "height": 48, "fx": fx, "fy": fy, "cx": cx, "cy": cy}))
    np.save(scene / "depth.npy", np.kron(captures.depth(), np.ones((4, 4))).astype(np.float32))
    run = tmp_path / "run"
    arguments = ["eval", "dataset=folder", f"dataset.root={scene.parent}", "method=nearest", "metrics.lpips=false",
                 "device=cpu", f"output_dir={run}"]  # fmt: skip
    assert main(arguments) == 0
    path = run / "scenes" / "room.npz"
    sample = DepthSample.load(path)
    object.__setattr__(sample, "scene", "../../evil")
    sample.save(path)
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert f"{path}: expected the scene room, got '../../evil'" in capsys.readouterr().err
    assert not list(tmp_path.glob("evil*"))

"""Exports of ``dsr upsample``: what is asked for is written, numbers are said, and refusals write nothing."""

import json
import struct

import numpy as np
import pytest
import trimesh
from small_frames import write_frames
from upsampling import refused_line, upsample

from dsr.app.upsample import run
from dsr.io.depth_files import read_depth_file


@pytest.fixture
def capture(tmp_path):
    return write_frames(tmp_path / "capture", 2, holes=0)


@pytest.fixture
def poses(tmp_path):
    """Poses of the frames, one metre to the right of each other."""
    (tmp_path / "poses.txt").write_text("".join(f"{number} {number} 2 3 0 0 0 1\n" for number in range(2)))
    return ("--poses", tmp_path / "poses.txt")


def names_in(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_exports_are_written_beside_the_frames_and_again_after_a_resumption(capture, poses, tmp_path, capsys):
    out = tmp_path / "out"
    assert upsample(capture, *poses, "--only", "open3d,stereo,rgbd_picture", "-o", out) == 0
    said = capsys.readouterr().out
    assert f"open3d: 2 frames -> {out / 'open3d'}" in said
    frame = {"info.json", "depth.png", "depth_metres.tiff", "rgbd/color.png", "rgbd/depth.png", "rgbd/intrinsic.json"}
    assert names_in(out / "000") == {*frame, "stereo_2x1.jpg", "rgbd_2x1.png"}
    assert upsample(capture, *poses, "--only", "open3d,nerfstudio,gaussian", "-o", out) == 0
    assert "2 complete already" in capsys.readouterr().out
    assert "open3d/trajectory.log" in names_in(out)
    frames = json.loads((out / "transforms.json").read_text())["frames"]
    assert [entry["file_path"] for entry in frames] == ["nerfstudio/images/000.png", "nerfstudio/images/001.png"]
    assert [entry["transform_matrix"][0][3] for entry in frames] == [0, 1]
    recorded = json.loads((out / "exports.json").read_text())["exports"]
    assert set(recorded) == {"open3d", "gaussian", "transforms.json"}
    assert all((out / name).is_file() for names in recorded.values() for name in names)


@pytest.mark.parametrize("part", ["nerfstudio", "gaussian"])
def test_frames_without_poses_are_refused_before_anything_is_computed(capture, tmp_path, capsys, part):
    (tmp_path / "one.txt").write_text("0 0 0 0 0 0 0 1\n7 0 0 0 0 0 0 1\n")
    for more, missing in (((), "2 of 2, such as 000"), (("--poses", tmp_path / "one.txt"), "1 of 2, such as 001")):
        code = upsample(capture, "--only", f"depth,open3d,{part}", *more, "-o", tmp_path / "out")
        line = refused_line(capsys, code)
        assert line.startswith(f"{part}: expected a pose of each frame, got none for {missing}")
    assert not (tmp_path / "out").exists()


def test_poses_of_a_file_are_those_of_the_exports_whichever_frame_ends_first(capture, poses, tmp_path, monkeypatch):
    in_order = run.work_through
    monkeypatch.setattr(run, "work_through", lambda *arguments: reversed(list(in_order(*arguments))))
    out = tmp_path / "out"
    assert upsample(capture, "--only", "open3d,nerfstudio,gaussian", *poses, "-o", out) == 0
    rows = (out / "open3d/trajectory.log").read_text().splitlines()  # the n-th is that of the n-th photo
    assert [row.split()[3] for row in (rows[1], rows[6])] == ["0", "1"]
    frames = json.loads((out / "transforms.json").read_text())["frames"]
    assert [[row[3] for row in entry["transform_matrix"][:3]] for entry in frames] == [[0, 2, 3], [1, 2, 3]]
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= names_in(out / "gaussian/sparse/0")


def test_points_for_splatting_are_pixels_that_are_expected_to_be_right(capture, poses, tmp_path):
    options, out = ("--method", "bicubic", "--max-error", 0.5, "--only", "confidence,gaussian"), tmp_path / "out"
    assert upsample(capture, *poses, *options, "-o", out) == 0
    certain = 0
    for frame in (out / "000", out / "001"):
        depth = read_depth_file(frame / "depth_metres.tiff")
        certain += int((np.load(frame / "confidence.npz")["depth_error"].astype(np.float32) <= 0.005 * depth).sum())
    assert 0 < certain < 2 * 24 * 32
    assert (out / "gaussian/sparse/0/points3D.bin").read_bytes()[:8] == struct.pack("<Q", certain)


@pytest.mark.parametrize("name", ["open3d", "normals_from_pretrain"])
def test_foreign_file_or_folder_in_place_of_an_export_is_left_alone(capture, poses, tmp_path, capsys, name):
    """Also beside the files of an older export."""
    out, options = tmp_path / "out", ("--only", "open3d,nerfstudio", "--method", "bicubic", *poses)
    (out / name).mkdir(parents=True)
    (out / name / "thesis.txt").write_text("mine")
    (out / "transforms.json").write_text("{}")
    (out / "exports.json").write_text(json.dumps({"exports": {"transforms.json": ["transforms.json"]}}))
    assert f"{name}: is there already" in refused_line(capsys, upsample(capture, *options, "-o", out))
    assert (out / name / "thesis.txt").read_text() == "mine"


def test_mesh_and_cloud_beyond_limits_are_said_and_recorded(capture, tmp_path, capsys):
    pytest.importorskip("fast_simplification", reason="pip install -e '.[mesh]'")
    out = tmp_path / "out"
    limits = ("--keep", "all", "--max-faces", 500, "--max-points", 500)
    assert upsample(capture, "--only", "depth,mesh,cloud", *limits, "-o", out) == 0
    said = capsys.readouterr().out
    entries = json.loads((out / "000" / "info.json").read_text())
    faces = trimesh.load(out / "000" / "mesh.glb", process=False, force="mesh").faces
    points = trimesh.load(out / "000" / "cloud.ply").vertices
    assert entries["mesh"] == {"before": 2 * 23 * 31, "after": len(faces), "how": "quadric decimation"}
    assert entries["cloud"]["before"] == 24 * 32
    assert entries["cloud"]["after"] == len(points) <= 500
    assert "the mesh has fewer triangles than the depth map gives (--max-faces)" in said
    assert "the cloud has fewer points than the depth map gives (--max-points)" in said

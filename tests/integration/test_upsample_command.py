"""``dsr upsample`` on people's own pictures: results, what was assumed, resuming, and every refusal."""

import shutil

import cv2
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from upsampling import info, refused_line, upsample

from dsr.geometry.camera import Camera
from dsr.io.depth_files import read_depth_file, write_depth_file
from dsr.synthetic.simgeo import render_scene

PARTS = {
    "depth": ("depth.png", "depth_metres.tiff"),
    "renderings": tuple(f"renderings/e{number}.png" for number in range(1, 5)), "normals": ("normals.png",),
    "mesh": ("mesh.glb",), "before_after": ("before_after.png",),
    "confidence": ("confidence.png", "confidence.npz"), "filled": ("filled.png",), "input": ("input.npz",),
}  # fmt: skip
BICUBIC = ("--method", "bicubic")
DEPTH_ONLY = (*BICUBIC, "--only", "depth")


@pytest.fixture(scope="module")
def cube():
    return render_scene("cube_no_texture", 64)


@pytest.fixture
def pair(tmp_path, cube):
    """A photo of 64 x 64 and its depth, a quarter as large, in whole millimetres with a hole of 2 x 3."""
    coarse = cube.depth.reshape(16, 4, 16, 4).mean((1, 3))
    values = np.round(coarse * 1000).astype(np.uint16)
    values[5:7, 3:6] = 0
    Image.fromarray(cube.rgb).save(tmp_path / "photo.png")
    Image.fromarray(values).save(tmp_path / "depth.png")
    return tmp_path / "photo.png", tmp_path / "depth.png", values


def of(pair, folder, *arguments):
    return upsample("--rgb", pair[0], "--depth", pair[1], "-o", folder, *arguments)


def files_in(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_two_files_are_enough_and_all_assumptions_are_printed(pair, cube, tmp_path, capsys):
    out = tmp_path / "out"
    assert of(pair, out) == 0
    said = capsys.readouterr().out
    for text in ("60 degrees of horizontal view", "read as millimetres (median ", "zeros count as holes (2.3%)"):
        assert text in said
    assert files_in(out) == {*sum(PARTS.values(), ()), "info.json"}
    metres = read_depth_file(out / "depth_metres.tiff")
    assert (metres.shape, metres.dtype) == ((64, 64), np.float32)
    assert np.abs(metres - cube.depth).mean() < 0.05
    stored = np.asarray(Image.open(out / "depth.png"))
    assert stored.dtype == np.uint16
    np.testing.assert_array_equal(stored, np.round(metres.astype(float) * 1000))
    reported = info(out)
    assert (reported["complete"], reported["scale"]) == (True, 4)
    assert reported["method"] == reported["settings"]["method"] == "facets"
    assert reported["photo_size"] == [64, 64]
    assert Camera(**reported["camera"]).fx == pytest.approx(32 / np.tan(np.pi / 6))
    assert 0 <= reported["noise"]["deviation"] < 0.02
    assert reported["noise"]["extent"] >= 1
    errors = np.load(out / "confidence.npz")
    assert all(errors[name].shape == (64, 64) and (errors[name] > 0).all() for name in ("depth_error", "angle_error"))
    assert reported["files"] == [name for names in PARTS.values() for name in names]


def test_pixels_that_a_mask_leaves_out_are_a_hole_that_stays_if_it_is_wide(pair, tmp_path):
    mask = np.full((16, 16), 255, np.uint8)
    mask[2:10, 2:10] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    options = (*DEPTH_ONLY, "--mask", tmp_path / "mask.png")
    assert of(pair, tmp_path / "small", *options) == 0
    assert (np.asarray(Image.open(tmp_path / "small" / "depth.png"))[20:28, 20:28] == 0).all()
    for name, extra in (("wide", ("--max-hole", "90")), ("all", ("--fill", "all"))):
        assert of(pair, tmp_path / name, *options, *extra) == 0
        assert np.asarray(Image.open(tmp_path / name / "depth.png")).min() > 0


def test_outliers_are_holes_and_counted(pair, tmp_path):
    clean, out, counted = tmp_path / "clean", tmp_path / "out", {"pixels": 2, "patches": 2}
    assert of(pair, clean, *DEPTH_ONLY) == 0
    values = pair[2].copy()
    values[10, 9], values[3, 12] = 25, 64000  # mm
    Image.fromarray(values).save(pair[1])
    assert of(pair, out, *DEPTH_ONLY) == 0
    assert (info(clean)["outliers"], info(out)["outliers"]) == ({"pixels": 0, "patches": 0}, counted)
    before, after = (read_depth_file(folder / "depth_metres.tiff") for folder in (clean, out))
    np.testing.assert_allclose(after, before, rtol=0.1)
    assert of(pair, out, *BICUBIC, "--only", "depth,normals") == 0
    assert info(out)["outliers"] == counted


def test_robot_gets_no_depth_of_glass(pair, tmp_path, monkeypatch):
    def half(photo, _):
        glass = torch.zeros(1, *photo.shape[-2:])
        glass[..., :16] = 0.06
        return glass

    monkeypatch.setattr("dsr.inference.any_ratio.expect_glass", half)
    assert of(pair, tmp_path / "out", *BICUBIC, "--for", "robot", "--max-error", "5") == 0
    assert info(tmp_path / "out")["shares"]["glass"] == 0.25
    depth = np.asarray(Image.open(tmp_path / "out" / "depth.png"))
    assert not depth[:, :16].any()
    assert depth[:, 16:].any()


@pytest.mark.parametrize(("suffix", "factor", "dtype"), [("exr", 1000, "f4"), ("npz", 1, "f8"), ("exr", 1, "f4")])
def test_result_has_the_inputs_format_type_unit_and_holes(pair, tmp_path, suffix, factor, dtype):
    metres = np.where(pair[2] == 0, np.nan, pair[2] / 1000)
    depth, out, options = tmp_path / f"d.{suffix}", tmp_path / "out", (*DEPTH_ONLY, "--fill", "none")
    write_depth_file(depth, (metres * factor).astype(dtype))
    assert of((pair[0], depth), out, *options) == 0
    result = read_depth_file(out / "depth_metres.tiff")
    assert np.isnan(result[22:26, 14:22]).all()
    assert 0 < np.isnan(result).mean() < 0.1
    if (factor, dtype) == (1, "f4"):  # metres are written once
        assert files_in(out) == {"depth_metres.tiff", "info.json"}
        assert of((pair[0], depth), out, *options, "--overwrite", "--format", "exr") == 0
    stored = read_depth_file(out / f"depth.{suffix}")
    assert (stored.dtype, stored.shape) == (np.dtype(dtype), (64, 64))
    np.testing.assert_allclose(stored / factor, result, rtol=1e-6)


def test_what_was_measured_and_what_was_filled_is_distinguished(pair, tmp_path):
    assert of(pair, tmp_path / "out", *BICUBIC, "--only", "depth,filled,cloud") == 0
    filled = np.asarray(Image.open(tmp_path / "out" / "filled.png"))
    expected = np.kron(pair[2] == 0, np.ones((4, 4), bool))
    np.testing.assert_array_equal(filled, np.where(expected, 255, 0))
    shares = info(tmp_path / "out")["shares"]
    assert shares["filled"] == pytest.approx(6 / 256, abs=1e-6)
    assert shares["measured"] == pytest.approx(250 / 256, abs=1e-6)
    assert shares["open"] == 0
    (tmp_path / "out" / "filled.png").unlink()
    assert of(pair, tmp_path / "out", *BICUBIC, "--only", "depth,filled,cloud") == 0  # of the stored depth
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "out" / "filled.png")), filled)
    assert info(tmp_path / "out")["shares"] == shares
    assert of(pair, tmp_path / "kept", *DEPTH_ONLY, "--fill", "none") == 0
    assert info(tmp_path / "kept")["shares"]["filled"] == 0
    assert info(tmp_path / "kept")["shares"]["open"] == pytest.approx(6 / 256, abs=1e-6)


def test_result_for_a_robot_has_millimetres_of_certain_measured_depth_alone(pair, tmp_path, capsys):
    values = pair[2]
    np.save(tmp_path / "metres.npy", np.where(values == 0, np.nan, values / 1000).astype(np.float32))
    floats, parts = (pair[0], tmp_path / "metres.npy"), ("--only", "depth,confidence,filled")
    assert of(floats, tmp_path / "all", *DEPTH_ONLY) == 0
    for given in (pair, floats):
        out = tmp_path / given[1].suffix[1:]
        assert of(given, out, *BICUBIC, *parts, "--for", "robot", "--max-error", "1") == 0
        depth = np.asarray(Image.open(out / "depth.png"))
        assert depth.dtype == np.uint16
        metres = read_depth_file(tmp_path / "all" / "depth_metres.tiff")
        errors = np.load(out / "confidence.npz")["depth_error"].astype(np.float32)
        certain = (errors <= 0.0099 * metres) & ~np.kron(values == 0, np.ones((4, 4), bool))
        dubious = (errors > 0.0101 * metres) | np.kron(values == 0, np.ones((4, 4), bool))
        assert 100 < certain.sum() < certain.size - 100
        np.testing.assert_allclose(depth[certain], 1000 * metres[certain], atol=1.5)
        assert not depth[dubious].any()
        assert not np.asarray(Image.open(out / "filled.png")).any()
    for more in (("--fill", "all"), ("--format", "exr")):
        code = of(pair, tmp_path / "no", *BICUBIC, "--for", "robot", *more)
        assert f"--for robot: expected {more[0]}" in refused_line(capsys, code)
    assert not (tmp_path / "no").exists()


def test_disparity_becomes_disparity_of_the_high_resolution_pixels(pair, cube, tmp_path):
    coarse = cube.depth.reshape(16, 4, 16, 4).mean((1, 3))
    depth = tmp_path / "disparity.npy"
    np.save(depth, (0.1 * cube.camera.fx / 4 / coarse).astype(np.float32))
    numbers = [getattr(cube.camera, name) for name in ("fx", "fy", "cx", "cy")]
    out = tmp_path / "out"
    assert of((pair[0], depth), out, *DEPTH_ONLY, "--baseline", 0.1, "--intrinsics", *numbers) == 0
    metres = read_depth_file(out / "depth_metres.tiff")
    assert np.abs(metres - cube.depth).mean() < 0.05
    np.testing.assert_allclose(np.load(out / "depth.npy"), 0.1 * cube.camera.fx / metres, rtol=1e-5)


def test_repeated_command_does_nothing_and_new_outputs_need_no_new_depth(pair, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    assert of(pair, out, *DEPTH_ONLY) == 0
    times = {name: (out / name).stat().st_mtime_ns for name in files_in(out)}
    assert of(pair, out, *DEPTH_ONLY) == 0
    assert "photo: complete already" in capsys.readouterr().out
    assert times == {name: (out / name).stat().st_mtime_ns for name in files_in(out)}
    monkeypatch.setattr("dsr.inference.any_ratio.AnyRatio.upsample", None)
    assert of(pair, out, *BICUBIC, "--only", "normals") == 0
    assert files_in(out) == {"depth.png", "depth_metres.tiff", "normals.png", "info.json"}
    assert files_in(out) == {*info(out)["files"], "info.json"}
    assert of(pair, out, *BICUBIC, "--only", "normals,depth") == 0
    assert "photo: complete already" in capsys.readouterr().out


def test_result_of_other_settings_or_inputs_is_kept_unless_overwritten(pair, tmp_path, capsys):
    out = tmp_path / "out"
    assert of(pair, out, *DEPTH_ONLY) == 0
    before = (out / "depth.png").read_bytes()
    message = refused_line(capsys, of(pair, out, *DEPTH_ONLY, "--fov", 70))
    assert message.startswith(f"{out}: holds a result of other settings: no fov")
    Image.fromarray(pair[2] + np.uint16(100)).save(pair[1])
    message = refused_line(capsys, of(pair, out, *DEPTH_ONLY))
    assert message.startswith(f"{out}: holds a result of other inputs: photo.png, depth.png")
    assert (out / "depth.png").read_bytes() == before
    assert of(pair, out, *DEPTH_ONLY, "--overwrite", "--format", "npy") == 0
    assert files_in(out) == {"depth.npy", "depth_metres.tiff", "info.json"}


def test_interrupted_run_resumes_and_keeps_no_part_of_other_settings(pair, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    assert of(pair, out, *BICUBIC, "--only", "depth,filled", "--fov", "70") == 0

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("dsr.app.upsample.outputs.write_normals", interrupt)
        assert of(pair, out, *BICUBIC, "--only", "depth,normals", "--overwrite") == 130
    assert "the same command continues from there" in capsys.readouterr().err
    assert info(out)["complete"] is False
    assert of(pair, out, *BICUBIC, "--only", "depth,normals") == 0
    assert info(out)["complete"] is True
    assert files_in(out) == {"depth.png", "depth_metres.tiff", "normals.png", "info.json"}


def test_result_overwrites_neither_its_input_nor_foreign_files(pair, tmp_path, capsys):
    for more in ((), ("--overwrite",)):
        message = refused_line(capsys, of(pair, tmp_path, *DEPTH_ONLY, *more))
        assert "depth.png: the result would overwrite its input" in message
    out = tmp_path / "out"
    out.mkdir()
    (out / "mesh.ply").write_text("mine")
    assert "mesh.ply: is there already and not of an earlier run" in refused_line(capsys, of(pair, out, *DEPTH_ONLY))
    (out / "info.json").write_text("{}")
    assert "info.json: expected a file of `dsr upsample`" in refused_line(capsys, of(pair, out, *DEPTH_ONLY))
    assert files_in(out) == {"mesh.ply", "info.json"}


def test_broken_picture_does_not_stop_the_others(pair, tmp_path, capsys):
    frames = tmp_path / "frames"
    for number in range(3):
        for kind, path in (("rgb", pair[0]), ("depth", pair[1])):
            (frames / kind).mkdir(parents=True, exist_ok=True)
            shutil.copy(path, frames / kind / f"{number:06}.png")
    (frames / "depth" / "000001.png").write_bytes(pair[1].read_bytes()[:60])
    (frames / "rgb" / "000007.png").touch()
    out = tmp_path / "out"
    assert upsample(frames, "-o", out, *DEPTH_ONLY) == 2
    reported = capsys.readouterr()
    [line] = reported.err.splitlines()
    assert line.startswith(f"error: 000001: {frames}/depth/000001.png: expected a picture")
    assert "left out: 000007.png" in reported.out
    assert reported.out.count("degrees of horizontal view assumed") == 1
    assert "3 pictures: 2 done, 1 failed in 0:00:" in reported.out
    assert sorted(path.name for path in out.iterdir()) == ["000000", "000002"]
    shutil.copy(pair[1], frames / "depth" / "000001.png")
    assert upsample(frames, "-o", out, *DEPTH_ONLY) == 0
    assert "3 pictures: 2 complete already, 1 done in 0:00:" in capsys.readouterr().out


def test_sensor_is_recognised_by_the_depth_values_and_must_not_contradict_them(tmp_path, capsys):
    v, u = np.mgrid[:240, :320]
    waves = cv2.GaussianBlur(np.random.default_rng(0).standard_normal(v.shape), (0, 0), 2.7)
    counts = np.round(1024 * (0.15 + 0.85 * (0.7 * u / 320 + 0.3 * v / 240) + 0.004 * waves / waves.std()))
    cv2.imwrite(str(tmp_path / "depth.png"), np.round(1e4 * 1024 / counts).astype(np.uint16))
    cv2.imwrite(str(tmp_path / "rgb.png"), np.full((240, 320, 3), 128, np.uint8))
    given = ("--rgb", tmp_path / "rgb.png", "--depth", tmp_path / "depth.png", "--depth-unit", "0.0001", *DEPTH_ONLY)
    assert upsample(*given, "-o", tmp_path / "out") == 0
    said = "sensor (RealSense D435, by its depth in steps of disparity with f B / step = 1024 m"
    assert said in capsys.readouterr().out
    assert any(said in each for each in info(tmp_path / "out")["assumptions"])
    message = refused_line(capsys, upsample(*given, "-o", tmp_path / "other", "--sensor", "Xtion"))
    assert "--sensor: expected depth in steps of disparity with f B / step = 342 m, as of a Xtion" in message
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--method", "magic"), "--method: "),
        (("--format", "jpg"), "--format: "),
        (("--only", "depth,film"), "--only: "),
        (("--only", ","), "left to write"),
        (("--range-type", "disparity"), "depth.png: "),
        (("--method", "facets", "--noise", "-1"), "--noise: "),
        (("--method", "facets", "--smooth", "3"), "--smooth: "),
        (("--noise", "0.1", "--method", "tgv"), "--noise: "),
        (("some_folder",), "--rgb and --depth"),
    ],
)
def test_invalid_arguments_are_refused_in_one_line(pair, tmp_path, capsys, arguments, message):
    assert message in refused_line(capsys, of(pair, tmp_path / "out", *BICUBIC, *arguments))
    assert not (tmp_path / "out").exists()


def test_photos_and_depth_maps_in_two_arguments_are_refused_with_the_options_for_them(pair, tmp_path, capsys):
    places = tmp_path / "color", tmp_path / "depth"
    for file, place in zip(pair, places, strict=False):
        place.mkdir()
        shutil.copy(file, place)
    message = refused_line(capsys, upsample(*places, "-o", tmp_path / "out", "--dry-run"))
    assert message.startswith(f"{places[0]}: ")
    assert message.endswith("--rgb PHOTOS --depth MAPS")


def test_pictures_that_do_not_fit_each_other_are_refused_in_one_line(pair, tmp_path, capsys):
    photo, depth, _ = pair
    for name, array in (
        ("large.png", np.ones((128, 128), np.uint16)), ("wide.png", np.full((9, 16), 1000, np.uint16)),
        ("eight.png", np.full((16, 16), 7, np.uint8)), ("holes.png", np.zeros((16, 16), np.uint16)),
        ("one.png", np.full((1, 1), 1000, np.uint16)),
    ):  # fmt: skip
        Image.fromarray(array).save(tmp_path / name)
        assert f"{name}: " in refused_line(capsys, of((photo, tmp_path / name), tmp_path / "out", *DEPTH_ONLY))
    cv2.imwrite(str(tmp_path / "mask.png"), np.ones((64, 64), np.uint8))
    code = of(pair, tmp_path / "out", *DEPTH_ONLY, "--mask", tmp_path / "mask.png")
    assert "mask.png: " in refused_line(capsys, code)
    (tmp_path / "photo.heic").touch()
    assert "photo.heic: " in refused_line(capsys, of((tmp_path / "photo.heic", depth), tmp_path / "out", *DEPTH_ONLY))
    assert "--rgb: " in refused_line(capsys, of((tmp_path / "none.jpg", depth), tmp_path / "out", *DEPTH_ONLY))
    assert not (tmp_path / "out").exists()


def test_what_is_likely_to_be_wrong_is_left_out_of_the_mesh(pair, tmp_path, capsys):
    assert of(pair, tmp_path / "all", "--only", "mesh,depth", "--max-error", "1000") == 0
    assert of(pair, tmp_path / "sure", "--only", "mesh,depth", "--max-error", "1e-9") == 0
    assert "no mesh" in capsys.readouterr().out
    assert (tmp_path / "all" / "mesh.glb").stat().st_size > 3_000
    assert not (tmp_path / "sure" / "mesh.glb").exists()


def test_dry_run_reads_all_and_says_what_would_be_done(tmp_path, capsys):
    folder = tmp_path / "in"
    folder.mkdir()
    for number in range(3):
        cv2.imwrite(str(folder / f"{number}_rgb.png"), np.full((48, 64, 3), 128, np.uint8))
        cv2.imwrite(str(folder / f"{number}_depth.png"), np.full((24, 32), 2000, np.uint16))
    assert upsample(folder, "-o", tmp_path / "out", *DEPTH_ONLY, "--dry-run") == 0
    assert "3 pictures: 3 to do " in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    assert upsample(folder, "-o", tmp_path / "out", *DEPTH_ONLY) == 0
    shutil.rmtree(tmp_path / "out" / "2_rgb")
    (folder / "1_depth.png").write_bytes(b"no picture")
    capsys.readouterr()
    assert upsample(folder, "-o", tmp_path / "out", *DEPTH_ONLY, "--dry-run") == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1
    assert "3 pictures: 1 complete already, 1 to do, 1 failed " in said.out


def test_parts_that_are_added_later_are_those_of_a_single_run(pair, tmp_path):
    """Depth and expected errors are read back to the bit."""
    whole, later = tmp_path / "whole", tmp_path / "later"
    assert of(pair, whole, "--only", "depth,confidence,mesh,normals") == 0
    took = info(whole)["seconds"]
    assert took["total"] == pytest.approx(took["reading"] + took["upsampling"] + took["writing"], abs=1e-6)
    assert of(pair, later, "--only", "depth,confidence") == 0
    assert of(pair, later, "--only", "mesh,normals") == 0
    for name in ("mesh.glb", "depth_metres.tiff", "confidence.npz", "normals.png"):
        assert (later / name).read_bytes() == (whole / name).read_bytes(), name


def test_keep_all_writes_every_pixel_and_the_files_of_other_programs(pair, tmp_path):
    out = tmp_path / "out"
    assert of(pair, out, *BICUBIC) == 0
    usual = files_in(out)
    few = info(out)["mesh"]
    assert of(pair, out, *BICUBIC, "--keep", "all") == 0
    assert files_in(out) == usual | {"mesh.ply", "cloud.ply"}
    shape = info(out)["mesh"]
    assert shape["after"] == shape["before"] == few["before"] > few["after"]
    for name in ("mesh.ply", "mesh.glb"):
        assert len(trimesh.load(out / name, process=False, force="mesh").faces) == shape["after"]

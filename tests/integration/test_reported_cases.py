"""Situations that people reported of programs like this one, each with the values that must come out."""

from __future__ import annotations

import re
import shutil
import struct
import tomllib
import zlib
from importlib.metadata import distribution
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile
import torch
from PIL import Image

import dsr
from dsr.cli import main
from dsr.data import detection
from dsr.evaluation.run_files import load_results
from dsr.io.depth_files import read_depth_file
from dsr.io.encoding import far_marks
from dsr.io.photos import read_photo
from dsr.metrics.boundaries import METRICS
from dsr.metrics.catalogue import score_image
from dsr.report.leaderboard import standings
from dsr.report.page.content import problem_data
from dsr.report.tables import build_tables
from dsr.utils import versions

WIDTH, HEIGHT, FOCAL = 320, 240, 288.0
CAMERA = ["--intrinsics", "288", "288", "159.5", "119.5"]


def scene(width=WIDTH, height=HEIGHT, focal=FOCAL, shift=0.0):
    """Return the exact depth (height, width) in metres and the photo (height, width, 3), uint8 RGB.

    A chequered slanted wall with a box and a ball in front of it, seen by a camera ``shift`` metres to the right.
    """
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    x, y = (u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal
    depth = (3.2 - 0.15 * shift) / (1 + 0.15 * x)
    squares = np.floor(4 * (shift + x * depth)) + np.floor(4 * y * depth)
    photo = np.stack([150 + 50 * (squares % 2)] * 3, -1) * (1.0, 0.9, 0.75)
    box = (np.abs(shift + 1.7 * x + 0.6) < 0.3) & (np.abs(1.7 * y - 0.2) < 0.4)
    depth, photo = np.where(box, 1.7, depth), np.where(box[..., None], (60, 90, 200), photo)
    centre, radius = np.array([0.45 - shift, 0.3, 2.0]), 0.45
    along = x * centre[0] + y * centre[1] + centre[2]
    norm = x * x + y * y + 1
    root = along**2 - norm * (centre @ centre - radius**2)
    near = (along - np.sqrt(np.maximum(root, 0))) / norm
    depth, photo = np.where(root > 0, near, depth), np.where((root > 0)[..., None], (220, 60, 50), photo)
    return depth, photo.astype(np.uint8)


def coarse(depth, by=4):
    """Return the means of squares of ``by`` pixels."""
    height, width = depth.shape
    return depth.reshape(height // by, by, width // by, by).mean((1, 3))


def millimetres(depth):
    return np.round(1000 * depth).astype(np.uint16)


def write(path: Path, picture):
    """Write a depth map, or a photo in RGB, in the format that the name has."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture[..., ::-1] if picture.ndim == 3 else picture)
    return path


def upsample(out: Path, *options, method="bicubic"):
    """Run ``dsr upsample`` and return its exit code."""
    return main(["upsample", *map(str, options), "-o", str(out), "--method", method, "--only", "depth"])


def mean_error(out: Path, truth):
    """Return the mean absolute error in millimetres of the pixels that both know, and the known fraction."""
    depth = cv2.imread(str(next(out.rglob("depth_metres.tiff"))), cv2.IMREAD_UNCHANGED)
    assert depth.shape == truth.shape
    known = np.isfinite(depth) & np.isfinite(truth)
    return 1000 * np.abs(depth - truth)[known].mean(), np.isfinite(depth).mean()


def whole_exr(path, depth, window):
    """Write depth as the data window (left, top, right, bottom) of a display of 80 x 60 pixels."""
    left, top, right, bottom = window
    corners = {"dataWindow": ((left, top), (right, bottom)), "displayWindow": ((0, 0), (79, 59))}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header |= {name: tuple(np.array(each, np.int32) for each in ends) for name, ends in corners.items()}
    with OpenEXR.File(header, {"Z": np.ascontiguousarray(depth, np.float32)}) as file:
        file.write(str(path))
    return path


def result_of(tmp_path, depth_file, *options, photo=None):
    """Return the depth in metres that comes of a depth file, and the mean absolute error in mm."""
    rgb = write(tmp_path / "rgb.png", scene()[1]) if photo is None else photo
    out = tmp_path / "out"
    assert upsample(out, "--rgb", rgb, "--depth", depth_file, *CAMERA, *options, "--fill", "none") == 0
    depth = cv2.imread(str(next(out.rglob("depth_metres.tiff"))), cv2.IMREAD_UNCHANGED)
    return depth, mean_error(out, scene()[0])[0]


def error_of(capsys, tmp_path, depth_file, *options, photo=None):
    """Return the line with which a pair is refused."""
    rgb = write(tmp_path / "rgb.png", scene()[1]) if photo is None else photo
    assert upsample(tmp_path / "refused", "--rgb", rgb, "--depth", depth_file, *CAMERA, *options) == 2
    return next(line for line in capsys.readouterr().err.splitlines() if line.startswith("error: "))


SKY = np.arange(60)[:, None] + np.zeros(80) < 20
MARKS = {
    "half.exr": (1.0, 65504), "far.npy": (1.0, 1000), "far.tiff": (1.0, 1e4), "nines.npy": (1.0, 9999),
    "near.npy": (1.0, 50), "nines.png": (1000, 9999), "short.png": (1000, 32767), "bits.tiff": (1000, 16383),
}  # fmt: skip


@pytest.mark.parametrize("name", MARKS)
def test_one_value_far_beyond_all_others_is_a_hole(tmp_path, name):
    steps, mark = MARKS[name]
    path, exact = tmp_path / name, coarse(scene()[0])
    values = np.where(SKY, mark, exact * steps).round(0 if steps > 1 else 9).astype(np.uint16 if steps > 1 else "f4")
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".exr":
        whole_exr(path, values, (0, 0, 79, 59))
    else:
        write(path, values)
    depth, error = result_of(tmp_path, path)
    assert np.isnan(depth[:76]).all()
    assert np.isfinite(depth[84:]).all()
    assert error < 50


@pytest.mark.parametrize(
    "depth",
    [
        np.where(SKY, 6.0, coarse(scene()[0])),  # a wall
        np.minimum(coarse(scene()[0]) * 3.2, 10),  # the end of a sensor
        np.where(SKY, 30.0, np.where(np.arange(80) < 40, 1.0, 8.0)),  # exact boards
    ],
)
def test_far_values_that_may_be_surfaces_are_kept(depth):
    assert far_marks(depth.astype(np.float32), depth > 0) == []


def test_far_marks_are_read_alike_by_the_python_interface_and_hole_value_0_keeps_them(tmp_path):
    values = np.where(SKY, 1000, coarse(scene()[0])).astype(np.float32)
    np.save(tmp_path / "depth.npy", values)
    assert np.array_equal(np.isnan(dsr.read_depth(tmp_path / "depth.npy", "m")), SKY)
    assert dsr.read_depth(tmp_path / "depth.npy", "m", hole_value=0).max() == 1000
    with pytest.warns(UserWarning, match="1000 m"):
        found = dsr.upsample(scene()[1], values, dsr.Camera(320, 240, 288, 288, 159.5, 119.5), method="bicubic")
    assert np.nanmax(found) < 5


@pytest.mark.parametrize(("kind", "mark"), [("<f4", -1.5), (">f4", 5.0), ("<u2", 4000), ("<i2", -32768)])
def test_a_tiff_says_which_value_marks_holes(tmp_path, kind, mark):
    steps = 1 if "f" in kind else 1000
    values = np.where(SKY, mark, coarse(scene()[0]) * steps).astype(kind)
    tag = (42113, "s", 0, f"{mark:g}", True)
    tifffile.imwrite(tmp_path / "depth.tif", values, extratags=[tag], byteorder=kind[0], compression="zlib")
    assert np.isnan(result_of(tmp_path, tmp_path / "depth.tif")[0][:76]).all()


@pytest.mark.parametrize(("steps", "name"), [(8, "oak.png"), (16, "sgbm.tif"), (32, "oak.npy"), (16, "disparity.png")])
def test_disparities_in_steps_of_a_pixel_are_asked_for_their_unit(tmp_path, capsys, steps, name):
    exact, path = coarse(scene()[0]), tmp_path / name
    values = np.round(72 * 0.5 / exact * steps)
    values[:, :3] = -steps if name.endswith(".tif") else 0
    values = values.astype(np.int16 if name.endswith(".tif") else np.uint16)
    np.save(path, values.astype(np.float32)) if name.endswith(".npy") else write(path, values)
    options = ["--baseline", "0.5", *([] if name == "disparity.png" else ["--range-type", "disparity"])]
    line = error_of(capsys, tmp_path, path, *options)
    assert name in line
    assert f"--depth-unit 1/{steps} " in line
    depth, error = result_of(tmp_path, path, *options, "--depth-unit", f"1/{steps}")
    assert error < 60
    assert abs(np.nanmedian(depth) / np.median(exact) - 1) < 0.01


def test_disparities_that_fit_the_map_are_pixels(tmp_path):
    disparity = (72 * 0.5 / coarse(scene()[0])).astype(np.float32)
    disparity[0, :4], disparity[SKY] = 90, 9999  # outliers, and marks
    np.save(tmp_path / "depth.npy", disparity)
    depth, error = result_of(tmp_path, tmp_path / "depth.npy", "--range-type", "disparity", "--baseline", "0.5")
    assert np.isnan(depth[:76]).all()
    assert error < 50


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("depth_of_bits", [np.uint8, np.uint16])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_tiffs_are_read_as_their_pixels_are_stored(tmp_path, orientation, depth_of_bits, order):
    values = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    tag, big = (274, 3, 1, orientation, True), depth_of_bits == np.uint8
    stored = values.astype(depth_of_bits) * (1 if big else 257)
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", extratags=[tag], byteorder=order, bigtiff=big)
    assert np.array_equal(read_photo(tmp_path / "a.tif", (3, 4))[0], values)
    tifffile.imwrite(tmp_path / "d.tif", values[..., 0].astype("f4"), extratags=[tag], byteorder=order)
    assert np.array_equal(read_depth_file(tmp_path / "d.tif"), values[..., 0])


def test_thumbnails_of_a_tiff_are_passed_over_and_several_pages_are_refused(tmp_path, capsys):
    exact, photo = scene()
    small = millimetres(coarse(exact))
    tiny = cv2.resize(photo, (80, 60), interpolation=cv2.INTER_AREA)
    with tifffile.TiffWriter(tmp_path / "photo.dng") as file:
        file.write(tiny, photometric="rgb", subfiletype=1, subifds=1)
        file.write(photo, photometric="rgb")
    with tifffile.TiffWriter(tmp_path / "depth.tif") as file:
        file.write(small)
        file.write(small[::2, ::2].copy(), subfiletype=1)
    assert result_of(tmp_path, tmp_path / "depth.tif", photo=tmp_path / "photo.dng")[1] < 50
    with tifffile.TiffWriter(tmp_path / "pages.tif") as file:
        file.write(small * 0 + 40)
        file.write(np.ascontiguousarray(small[:30]))
    line = error_of(capsys, tmp_path, tmp_path / "pages.tif")
    assert "pages.tif" in line
    assert "80 x 60, 80 x 30" in line
    tifffile.imwrite(tmp_path / "raw.dng", small, photometric="cfa", extratags=[(33422, 1, 4, b"\0\1\1\2", True)])
    assert "raw.dng" in error_of(capsys, tmp_path, write(tmp_path / "d.png", small), photo=tmp_path / "raw.dng")


@pytest.mark.parametrize("window", [(10, 8, 69, 52), (-8, -6, 87, 65), (20, 10, 69, 49), (-5, 30, 40, 70)])
def test_the_data_window_of_an_exr_lies_in_its_display_window(tmp_path, window):
    left, top, right, bottom = window
    wide = coarse(scene(4 * 120, 4 * 100)[0])  # 20 pixels more on every side
    path = whole_exr(tmp_path / "depth.exr", wide[top + 20 : bottom + 21, left + 20 : right + 21], window)
    shown = np.full((60, 80), np.nan)
    rows, columns = slice(max(top, 0), min(bottom, 59) + 1), slice(max(left, 0), min(right, 79) + 1)
    shown[rows, columns] = wide[20:80, 20:100][rows, columns]
    np.testing.assert_array_equal(read_depth_file(path), shown.astype(np.float32))


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("name", ["photo.png", "photo.tif"])
def test_photos_that_use_some_of_16_bits_are_brightened(tmp_path, bits, name):
    photo = scene()[1].astype(np.uint16) << 8 >> 16 - bits
    for number, values in enumerate((photo, photo[..., 0])):
        pixels, notes = read_photo(write(tmp_path / f"{number}{name}", values), (60, 80))
        expected = scene()[1] if values.ndim == 3 else np.stack([scene()[1][..., 0]] * 3, -1)
        assert np.abs(pixels - expected.astype(int)).max() <= 1
        assert len(notes) == (bits < 16)


def unread(path: Path):
    """Write a file of a format that is not read, by its name."""
    depth, photo = coarse(scene()[0]), scene()[1]
    linear = ((photo / 255.0) ** 2.2).astype(np.float32)
    if path.name == "half.tif":
        tifffile.imwrite(path, depth.astype(np.float16))
    elif path.suffix == ".tif":
        tifffile.imwrite(path, linear, photometric="rgb")
    elif path.suffix == ".npy":
        np.save(path, photo)
    elif path.suffix == ".exr":
        with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"RGB": linear}) as file:
            file.write(str(path))
    elif path.suffix == ".hdr":
        cv2.imwrite(str(path), linear)
    else:
        Image.fromarray(photo).save(path)
    return path


@pytest.mark.parametrize(
    "name", ["half.tif", "photo.tif", *(f"photo.{end}" for end in ["npy", "exr", "hdr", "gif", "jp2", "avif"])]
)
def test_formats_that_are_not_read_are_not_called_damaged(tmp_path, capsys, name):
    path, depth = unread(tmp_path / name), write(tmp_path / "depth.png", millimetres(coarse(scene()[0])))
    files = (path, None) if name == "half.tif" else (depth, path)
    line = error_of(capsys, tmp_path, files[0], photo=files[1])
    assert name in line
    assert "damaged" not in line
    assert "not read" in line


def grey_and_opacity(path: Path, values, opacity):
    """Write a PNG of 16 bits of two channels."""
    pixels = np.dstack((values, opacity)).astype(">u2")

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", pixels.shape[1], pixels.shape[0], 16, 4, 0, 0, 0)
    rows = zlib.compress(b"".join(b"\0" + row.tobytes() for row in pixels))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b""))
    return path


def test_grey_with_opacity_is_depth_where_all_of_it_is_opaque(tmp_path, capsys):
    small = millimetres(coarse(scene()[0]))
    path = grey_and_opacity(tmp_path / "depth.png", small, small * 0 + 65535)
    assert np.array_equal(read_depth_file(path), small)
    line = error_of(capsys, tmp_path, grey_and_opacity(tmp_path / "holes.png", small, np.where(SKY, 0, 65535)))
    assert "holes.png" in line
    assert "transparent" in line


@pytest.mark.parametrize("options", [(), ("--depth-unit", "m")])
@pytest.mark.parametrize("name", ["depth.npy", "depth.exr", "depth.tiff"])
def test_a_negative_depth_map_is_called_negative(tmp_path, capsys, name, options):
    depth, path = np.where(SKY, np.nan, -coarse(scene()[0])).astype(np.float32), tmp_path / name
    if name.endswith("npy"):
        np.save(path, depth)
    elif name.endswith("exr"):
        whole_exr(path, depth, (0, 0, 79, 59))
    else:
        write(path, depth)
    line = error_of(capsys, tmp_path, path, *options)
    assert name in line
    assert "67% are negative" in line


@pytest.mark.parametrize(
    ("runs", "shared", "seeds"),
    [
        ([("One", 0, "abc"), ("One", 0, "ab"), ("Two", 0, "ab")], "ab", 1),
        ([("One", 0, "ab"), ("One", 1, "abc"), ("Two", 0, "abc")], "abc", 1),
        ([("One", 0, "ab"), ("One", 1, "abc"), ("Two", 0, "ab")], "ab", 2),
        ([("One", 0, "ab"), ("One", 1, "bc"), ("Two", 0, "bc")], "bc", 1),
        ([("One", 0, "a"), ("Two", 0, "bc")], "", 1),
    ],
)
def test_report_averages_over_the_scenes_that_all_methods_have(make_run, tmp_path, runs, shared, seeds):
    for number, (label, seed, scenes) in enumerate(runs):
        make_run(tmp_path / str(number), label=label, seed=seed, scenes=tuple(scenes))
    results = load_results([tmp_path])
    page = problem_data(results, results.problems()[0])
    average = build_tables(results)[-1].groups[-1]
    for method, mean, row in zip(("One", "Two"), page["means"], average.rows, strict=True):
        own = {each["scene"]: each["values"]["RMSE_d"][0] for each in page["rows"] if each["method"] == method}
        cell = row.cells["RMSE_d"]
        assert mean["counts"].get("RMSE_d", len(page["scenes"])) == cell.scenes == len(shared)
        assert mean["seeds"] == row.seeds == (seeds if method == "One" else 1)
        assert (cell.spread is None) == (row.seeds == 1)
        if shared:
            expected = pytest.approx(np.mean([own[scene] for scene in shared]))
            [place] = [each for each in standings(results) if each["method"] == method]
            assert mean["values"]["RMSE_d"][0] == cell.mean == place["values"]["RMSE_d"][0] == expected
        else:
            assert mean["values"] == {}


def test_nobody_is_sent_to_the_dsr_of_pypi(monkeypatch):
    root = Path(__file__).resolve().parents[2]
    texts = [path for name in ("src", "conf", "docs") for path in (root / name).rglob("*.[pym][yda]*")]
    found = [str(path) for path in (*texts, root / "README.md") if re.search(r"\bdsr\[[a-z]+[],]", path.read_text())]
    assert len(texts) > 400
    assert found == []
    name = tomllib.loads((root / "pyproject.toml").read_text())["project"]["name"]
    assert (name, distribution(name).version) == (versions.DISTRIBUTION, versions.package_versions()["dsr"])
    assert versions.how_to_install("mesh") == "pip install -e '.[mesh]' in a checkout"
    monkeypatch.setattr(versions, "__file__", "/site-packages/dsr/utils/versions.py")
    assert versions.how_to_install("onnx") == f"pip install '{name}[onnx]'"


def test_make_benchmark_runs_the_scripts_that_need_no_arguments():
    root = Path(__file__).resolve().parents[2]
    [names] = re.findall(r"for name in ([\w ]+); do \$\(BIN\)/python benchmarks/", (root / "Makefile").read_text())
    ratios = (root / "docs/speed.md").read_text().partition("## Ratios")[2].partition("\n## ")[0]
    assert set(names.split()) == set(re.findall(r"benchmarks/(\w+)_speed\.py", ratios))
    texts = [(root / f"benchmarks/{name}_speed.py").read_text() for name in names.split()]
    assert not any("required=True" in text for text in texts)


def test_doctor_knows_every_data_set_of_recorded_scenes(shared, tmp_path):
    root = Path(__file__).resolve().parents[2]
    known = {name for *_, name in detection._FRAMES}
    own = {"folder", "simgeo", "procedural", "mixture", "paper_train", "rgbdd_real"}  # of the user, rendered, of others
    choices = {path.stem for path in (root / "conf/dataset").glob("*.yaml") if not path.stem.startswith("middlebury")}
    assert choices - own <= known
    board = shared / "real/stereo_board"
    assert [name for name, _ in detection.find_scenes(board)] == ["8", "14", "19", "25", "31"]
    for folder in ("color", "depth"):  # a recording of somebody else
        (tmp_path / folder).mkdir()
        shutil.copy(board / folder / "14.png", tmp_path / folder / "8.png")
    write(tmp_path / "color/8.png", np.zeros((1080, 1920, 3), np.uint8))
    assert list(detection.find_scenes(tmp_path)) == []


def boundary_errors(prediction, truth, edges=None):
    """Return accuracy and completeness of depth boundaries as eval.py scores them."""
    maps = [torch.from_numpy(each)[None] for each in (prediction, truth)]
    regions = {} if edges is None else {"edges": torch.from_numpy(edges.astype(np.uint8))[None]}
    rays = dsr.Camera.from_fov(60, width=WIDTH, height=HEIGHT).rays()
    found = {each.metric: each.value for each in score_image(*maps, rays, METRICS, regions=regions)}
    return found["DBE_accuracy"], found["DBE_completeness"]


def test_boundary_errors_are_to_the_annotated_boundaries():
    """Executed: ``compute_depth_boundary_error`` of Koch's v0.9 in bulatko/DepthART b2bc093, 0 for holes."""
    truth, _ = scene()
    prediction = cv2.resize(coarse(truth), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    edges = np.zeros(truth.shape, bool)
    edges[:, 1:] = np.abs(np.diff(truth)) > 0.4
    edges[60, 20:200] = edges[60:200, 200] = True  # a picture on the wall
    assert boundary_errors(prediction, truth, edges) == pytest.approx((1.0701604531461808, 11.598171099980945))
    truth[:40], prediction[60:180, 60:140] = np.nan, np.nan
    assert boundary_errors(prediction, truth, edges) == pytest.approx((1.0172272469100552, 19.141785662587306))
    band = cv2.dilate(edges.astype(np.uint8), np.ones((9, 9), np.uint8))  # about outlines, as that of ClearGrasp
    for others in (band, np.zeros_like(edges)):
        assert boundary_errors(prediction, truth, others) == boundary_errors(prediction, truth)

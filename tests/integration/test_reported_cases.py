"""Situations that people reported of programs like this one, each with the values that must come out."""

import dataclasses
import importlib
import json
import math
import pickle
import pkgutil
import re
import shutil
import struct
import tomllib
import zlib
from importlib.metadata import distribution
from pathlib import Path

import captures
import cv2
import lightning
import numpy as np
import OpenEXR
import pytest
import tifffile
import torch
import torchmetrics
from PIL import Image
from pretend_cuda import pretend_cuda
from small_lpips import random_lpips
from torch.utils.data import DataLoader

import dsr
from dsr.cli import main
from dsr.data import detection
from dsr.degradation.downsampling import Downsampling
from dsr.evaluation.run_files import load_results
from dsr.geometry.camera import Camera
from dsr.geometry.planes import inverse_votes
from dsr.inference import upsampler
from dsr.inference.resizing import plan_for
from dsr.inference.working_size import left_of, limit_to_noise
from dsr.io.cameras import read_any_camera
from dsr.io.depth_files import far_marks, read_depth_file
from dsr.io.images import read_mask, read_rgb
from dsr.io.inputs import read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.pairs import Pair
from dsr.io.photos import read_photo
from dsr.io.reading import Reading
from dsr.io.trajectories import read_poses
from dsr.methods.base import MapNoise
from dsr.methods.networks.network import Answer
from dsr.methods.recipe import Run, read_recipe
from dsr.metrics import losses
from dsr.metrics.boundaries import METRICS
from dsr.metrics.catalogue import score_image
from dsr.metrics.classes import DSSIMv, LPIPSv, RMSEd, visual_metrics
from dsr.metrics.functional import SurfacePair, dssim_v
from dsr.metrics.losses import VisualLoss
from dsr.report.page import problem_data, standings
from dsr.report.tables import build_tables
from dsr.sample import DepthSample
from dsr.training.objective import DepthObjective, SurfaceObjective
from dsr.utils import versions
from dsr.utils.compute_device import pick_device

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
    if path.suffix == ".npy":
        np.save(path, picture)
    elif path.suffix == ".exr":
        whole_exr(path, picture, (0, 0, 79, 59))
    else:
        cv2.imwrite(str(path), picture[..., ::-1] if picture.ndim == 3 else picture)
    return path


def upsample(out: Path, *options, method="bicubic", only="depth"):
    """Run ``dsr upsample`` and return its exit code."""
    return main(["upsample", *map(str, options), "-o", str(out), "--method", method, "--only", only])


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
    values = np.where(SKY, mark, coarse(scene()[0]) * steps).astype(np.uint16 if steps > 1 else np.float32)
    depth = dsr.read_depth(write(tmp_path / name, values), "mm" if steps > 1 else "m")
    assert np.array_equal(np.isnan(depth), SKY)
    assert np.array_equal(depth[~SKY], (values / np.float32(steps))[~SKY])


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


def test_hole_value_0_keeps_far_marks_and_arrays_that_have_them_are_warned_of(tmp_path):
    values = np.where(SKY, 1000, coarse(scene()[0])).astype(np.float32)
    np.save(tmp_path / "depth.npy", values)
    assert dsr.read_depth(tmp_path / "depth.npy", "m", hole_value=0).max() == 1000
    np.save(tmp_path / "wall.npy", np.where(SKY, coarse(scene()[0]) / 10, 4.0).astype(np.float32))
    assert np.isfinite(dsr.read_depth(tmp_path / "wall.npy", "m")).all()  # behind something near
    with pytest.warns(UserWarning, match="1000"):
        dsr.upsample(scene()[1], values, dsr.Camera(320, 240, 288, 288, 159.5, 119.5), method="bicubic")


@pytest.mark.parametrize(("kind", "mark"), [("<f4", -1.5), (">f4", 5.0), ("<u2", 4000), ("<i2", -32768)])
def test_a_tiff_says_which_value_marks_holes(tmp_path, kind, mark):
    steps = 1 if "f" in kind else 1000
    values = np.where(SKY, mark, coarse(scene()[0]) * steps).astype(kind)
    tag = (42113, "s", 0, f"{mark:g}", True)
    tifffile.imwrite(tmp_path / "depth.tif", values, extratags=[tag], byteorder=kind[0], compression="zlib")
    assert np.array_equal(np.isnan(dsr.read_depth(tmp_path / "depth.tif", "m" if steps == 1 else "mm")), SKY)


@pytest.mark.parametrize(("steps", "name"), [(8, "oak.png"), (16, "sgbm.tif"), (32, "oak.npy"), (16, "disparity.png")])
def test_disparities_in_steps_of_a_pixel_are_asked_for_their_unit(tmp_path, capsys, steps, name):
    exact, path = coarse(scene()[0]), tmp_path / name
    values = np.round(72 * 0.5 / exact * steps)
    values[:, :3] = -steps if name.endswith(".tif") else 0
    values = values.astype(np.int16 if name.endswith(".tif") else np.uint16)
    write(path, values.astype(np.float32) if name.endswith(".npy") else values)
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


@pytest.mark.parametrize(("order", "depth_of_bits"), [("<", np.uint8), (">", np.uint16)])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_tiffs_are_read_as_their_pixels_are_stored(tmp_path, orientation, depth_of_bits, order):
    values = np.arange(6 * 8 * 3, dtype=np.uint8).reshape(6, 8, 3)
    tag, big = (274, 3, 1, orientation, True), depth_of_bits == np.uint8
    stored = values.astype(depth_of_bits) * (1 if big else 257)
    tifffile.imwrite(tmp_path / "a.tif", stored, photometric="rgb", extratags=[tag], byteorder=order, bigtiff=big)
    assert np.array_equal(read_photo(tmp_path / "a.tif", (3, 4))[0], values)
    tifffile.imwrite(tmp_path / "d.tif", values[..., 0].astype("f4"), extratags=[tag], byteorder=order)
    assert np.array_equal(read_depth_file(tmp_path / "d.tif"), values[..., 0])
    tifffile.imwrite(tmp_path / "mask.tif", values[..., 0] % 2, extratags=[tag], byteorder=order)
    assert np.array_equal(read_mask(tmp_path / "mask.tif"), values[..., 0] % 2 > 0)


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
    with tifffile.TiffWriter(tmp_path / "preview.tif") as file:
        file.write(photo, photometric="rgb")
        file.write(tiny, photometric="rgb")
    assert np.array_equal(read_photo(tmp_path / "preview.tif", (60, 80))[0], photo)
    tifffile.imwrite(tmp_path / "empty.tif", small)
    content = (
        (tmp_path / "empty.tif").read_bytes().replace(struct.pack("<HHI", 262, 3, 1), struct.pack("<HHI", 262, 3, 0))
    )
    (tmp_path / "empty.tif").write_bytes(content)
    with pytest.raises(ValueError, match=r"empty\.tif"):
        read_depth_file(tmp_path / "empty.tif")
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


def test_depth_of_an_exr_may_be_in_its_second_part(tmp_path):
    depth = coarse(scene()[0]).astype(np.float32)
    headers = [
        {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "name": name}
        for name in ("beauty", "z")
    ]
    channels = {"RGB": np.ones((60, 80, 3), np.float32)}, {"Z": depth}
    parts = [OpenEXR.Part(header, each, header["name"]) for header, each in zip(headers, channels, strict=True)]
    OpenEXR.File(parts).write(str(tmp_path / "depth.exr"))
    np.testing.assert_array_equal(read_depth_file(tmp_path / "depth.exr"), depth)


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("name", ["photo.png", "photo.tif"])
def test_photos_that_use_some_of_16_bits_are_brightened(tmp_path, bits, name):
    photo = scene()[1].astype(np.uint16) << 8 >> 16 - bits
    for number, values in enumerate((photo, photo[..., 0])):
        pixels, notes = read_photo(write(tmp_path / f"{number}{name}", values), (60, 80))
        expected = scene()[1] if values.ndim == 3 else np.stack([scene()[1][..., 0]] * 3, -1)
        assert np.abs(pixels - expected.astype(int)).max() <= 1
        assert len(notes) == (bits < 16)
        assert np.array_equal(read_rgb(tmp_path / f"{number}{name}"), pixels)


def test_arrays_that_use_some_of_16_bits_are_brightened():
    depth, photo = scene()
    camera = dsr.Camera(320, 240, 288, 288, 159.5, 119.5)
    expected = dsr.upsample(photo, coarse(depth), camera, method="guided_filter")
    with pytest.warns(UserWarning, match="12 of its 16 bits"):
        found = dsr.upsample(photo.astype(np.uint16) * 16, coarse(depth), camera, method="guided_filter")
    assert np.nanmax(np.abs(found - expected)) < 0.01


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
    else:
        Image.fromarray(photo).save(path)
    return path


@pytest.mark.parametrize("name", ["half.tif", "photo.tif", *(f"photo.{end}" for end in ["npy", "exr", "gif", "avif"])])
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
    depth = np.where(SKY, np.nan, -coarse(scene()[0])).astype(np.float32)
    line = error_of(capsys, tmp_path, write(tmp_path / name, depth), *options)
    assert name in line
    assert "negative" in line


@pytest.mark.parametrize(
    ("runs", "shared"),
    [
        ([("One", 0, "ab"), ("One", 1, "abc"), ("Two", 0, "abc")], "abc"),
        ([("One", 0, "ab"), ("One", 1, "bc"), ("Two", 0, "bc")], "bc"),
        ([("One", 0, "a"), ("Two", 0, "bc")], ""),
    ],
)
def test_page_table_and_ranking_average_over_the_scenes_that_all_methods_have(make_run, tmp_path, runs, shared):
    for number, (label, seed, scenes) in enumerate(runs):
        make_run(tmp_path / str(number), label=label, seed=seed, scenes=tuple(scenes))
    results = load_results([tmp_path])
    page = problem_data(results, results.problems()[0])
    for method, mean, row in zip(("One", "Two"), page["means"], build_tables(results)[-1].groups[-1].rows, strict=True):
        own = {each["scene"]: each["values"]["RMSE_d"][0] for each in page["rows"] if each["method"] == method}
        found = [each["values"]["RMSE_d"][0] for each in standings(results) if each["method"] == method and shared]
        found += [row.cells["RMSE_d"].mean, mean["values"]["RMSE_d"][0]] if shared else []
        assert all(each == pytest.approx(np.mean([own[scene] for scene in shared])) for each in found)
        assert bool(mean["values"]) == bool(shared)


def test_nobody_is_sent_to_the_dsr_of_pypi(monkeypatch):
    root = Path(__file__).resolve().parents[2]
    pages = [root / "README.md", *(root / "docs").rglob("*.md"), *(root / "src").rglob("*.py")]
    assert [page for page in pages if re.search(r"\bdsr\[[a-z]+[],]", page.read_text())] == []
    name = tomllib.loads((root / "pyproject.toml").read_text())["project"]["name"]
    assert (name, distribution(name).version) == (versions.DISTRIBUTION, versions.package_versions()["dsr"])
    assert "pip install -e '.[mesh]'" in versions.how_to_install("mesh")
    monkeypatch.setattr(versions, "__file__", "/site-packages/dsr/utils/versions.py")
    assert f"pip install '{name}[onnx]'" in versions.how_to_install("onnx")


def test_doctor_knows_every_data_set_of_recorded_scenes(shared, tmp_path):
    root = Path(__file__).resolve().parents[2]
    modules = [importlib.import_module(f"dsr.data.{each.name}") for each in pkgutil.iter_modules(dsr.data.__path__)]
    known = {name for each in modules for *_, name in getattr(each, "DETECTED", ())} | {"nyu"}
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


def read(place, **options):
    """Return the first frame of a folder or recording as ``dsr upsample`` reads it."""
    return read_picture(find_pairs_of_folder(place).pairs[0], Reading(**options))


def lr_error(picture, truth):
    """Return the mean absolute error of a low-resolution depth map in millimetres, and the known fraction."""
    depth = picture.depth_lr[0].numpy()
    return 1000 * np.nanmean(np.abs(depth - truth)), np.isfinite(depth).mean()


def write_bag(path, pictures, transforms=(), *, version=2, plugin="SQLITE3", extrinsics=None):
    """Write a recording of ROS: ``pictures`` by topic have a frame and fx, cx, cy, width and height, or None.

    ``transforms`` of /tf_static are parent, child, translation and quaternion; ``extrinsics`` are a topic of
    RealSense's message and its translation.
    """
    pytest.importorskip("rosbags")
    from rosbags.typesys import get_types_from_msg  # noqa: PLC0415 - an extra

    writer = captures.RosWriter(version)
    realsense = "std_msgs/Header header\nfloat64[9] rotation\nfloat64[3] translation"
    writer.store.register(get_types_from_msg(realsense, "realsense2_camera_msgs/msg/Extrinsics"))
    if version == 1:
        tree = "geometry_msgs/TransformStamped[] transforms"
        writer.store.register(get_types_from_msg(tree, "tf2_msgs/msg/TFMessage"))
    messages = {}
    for topic, (picture, frame, camera) in pictures.items():
        encoding = {"uint16": "16UC1", "float32": "32FC1", "float64": "64FC1"}.get(str(picture.dtype), "rgb8")
        messages[topic] = [writer.image(writer.header(frame), np.ascontiguousarray(picture), encoding)]
        if camera is not None:
            focal, cx, cy, width, height = camera
            info = writer.info(writer.header(frame), (height, width), (focal, focal, cx, cy),
                               p=[focal, 0, cx, 0, 0, focal, cy, 0, 0, 0, 1, 0])  # fmt: skip
            messages[topic.rpartition("/")[0] + "/camera_info"] = [info]
    if transforms:
        tree = []
        for parent, child, shift, turn in transforms:
            places = writer.make("geometry_msgs/Vector3", *shift), writer.make("geometry_msgs/Quaternion", *turn)
            motion = writer.make("geometry_msgs/Transform", *places)
            tree.append(writer.make("geometry_msgs/TransformStamped", writer.header(parent), child, motion))
        messages["/tf_static"] = [writer.make("tf2_msgs/TFMessage", tree)]
    if extrinsics is not None:
        topic, shift = extrinsics
        numbers = np.eye(3).ravel(), np.array(shift, float)
        messages[topic] = [writer.make("realsense2_camera_msgs/Extrinsics", writer.header(), *numbers)]
    writer.write(path, messages, plugin)


OPTICAL = (-0.5, 0.5, -0.5, 0.5)  # Rotation from the axes of an optical frame to those of a robot
COLOUR, DEPTH = "camera_color_optical_frame", "camera_depth_optical_frame"
PHOTO_INFO, DEPTH_INFO = (288.0, 159.5, 119.5, 320, 240), (96.0, 79.5, 59.5, 160, 120)
TREE = (
    ("camera_link", "camera_color_frame", (0, 0.03, 0), (0, 0, 0, 1)),
    ("camera_color_frame", COLOUR, (0, 0, 0), OPTICAL),
    ("camera_link", "camera_depth_frame", (0, 0, 0), (0, 0, 0, 1)),
    ("/camera_depth_frame", f"/{DEPTH}", (0, 0, 0), OPTICAL),
)  # The depth camera is 30 mm to the right of the photo's: a robot's y points to the left
EXTRINSICS = ("/camera/extrinsics/depth_to_color", (0.03, 0, 0))


@pytest.mark.parametrize(
    ("version", "plugin", "transforms", "extrinsics", "focal"),
    [(2, "SQLITE3", TREE, None, 96.0), (2, "SQLITE3", TREE, None, 144.0), (2, "MCAP", TREE, None, 96.0),
     (1, "", TREE, None, 96.0), (2, "MCAP", (), EXTRINSICS, 96.0), (1, "", (), EXTRINSICS, 96.0)],
)  # fmt: skip
def test_unregistered_depth_of_a_recording_is_warped_by_its_transform(
    tmp_path, version, plugin, transforms, extrinsics, focal
):
    """A focal length of 144 is that of the photo, as if the two were registered."""
    truth, photo = scene()
    apart = millimetres(scene(160, 120, focal, shift=0.03)[0])
    pictures = {
        "/camera/color/image_raw": (photo, COLOUR, PHOTO_INFO),
        "/camera/depth/image_rect_raw": (apart, DEPTH, (focal, *DEPTH_INFO[1:])),
    }
    bag = tmp_path / "a.bag" if version == 1 else tmp_path / "a"
    write_bag(bag, pictures, transforms, version=version, plugin=plugin, extrinsics=extrinsics)
    picture = read(bag)
    height, width = picture.depth_lr.shape[1:]
    error, known = lr_error(picture, cv2.resize(truth, (width, height), interpolation=cv2.INTER_AREA))
    assert error < 25
    assert known > 0.9


def test_depth_that_is_aligned_to_another_camera_is_not_registered(tmp_path):
    pictures = {
        "/camera/color/image_raw": (scene()[1], COLOUR, PHOTO_INFO),
        "/camera/aligned_depth_to_infra1/image_raw": (millimetres(coarse(scene()[0])), "camera_infra1_frame", None),
    }
    write_bag(tmp_path / "a", pictures)
    assert upsample(tmp_path / "out", tmp_path / "a") == 2


@pytest.mark.parametrize("info", [DEPTH_INFO, None])
def test_unregistered_depth_without_a_transform_is_refused_by_its_frames(tmp_path, capsys, info):
    truth, photo = scene()
    apart = millimetres(scene(160, 120, 96.0, shift=0.03)[0])
    pictures = {
        "/camera/color/image_raw": (photo, COLOUR, PHOTO_INFO),
        "/camera/depth/image_rect_raw": (apart, DEPTH, info),
    }
    write_bag(tmp_path / "a", pictures)
    assert upsample(tmp_path / "out", tmp_path / "a") == 2
    [error] = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert COLOUR in error
    assert DEPTH in error
    (tmp_path / "depth.txt").write_text("96 0 79.5\n0 96 59.5\n0 0 1\n")
    (tmp_path / "motion.txt").write_text("1 0 0 0.03\n0 1 0 0\n0 0 1 0\n")
    rig = ("--depth-camera", tmp_path / "depth.txt", "--extrinsics", tmp_path / "motion.txt")
    assert upsample(tmp_path / "out", tmp_path / "a", *rig) == 0
    assert mean_error(tmp_path / "out", truth)[0] < 45


@pytest.mark.parametrize(
    ("registered", "frame", "info", "other"),
    [
        ("/depth_to_rgb/image_raw", COLOUR, PHOTO_INFO, "/depth/image_raw"),
        ("/depth_to_rgb/image_raw", COLOUR, None, "/depth/image_raw"),
        ("/camera/stereo/image_raw", f"/robot/{COLOUR}", None, "/camera/aligned_depth_to_infra1/image_raw"),
        ("/camera/depth/image_raw", DEPTH, PHOTO_INFO, "/camera/a/image_raw"),
        ("/camera/aligned_depth_to_color/image_raw", DEPTH, None, "/camera/a/image_raw"),
    ],
)
def test_registered_topic_of_depth_is_taken(tmp_path, registered, frame, info, other):
    truth, photo = scene()
    pictures = {
        "/camera/color/image_raw": (photo, COLOUR, PHOTO_INFO),
        registered: (millimetres(coarse(truth)), frame, info),
        other: (millimetres(scene(160, 120, 96.0, shift=0.03)[0]), "camera_infra1_optical_frame", DEPTH_INFO),
    }
    write_bag(tmp_path / "a", pictures)
    assert lr_error(read(tmp_path / "a"), coarse(truth))[0] < 0.5


@pytest.mark.parametrize(
    ("photo_name", "raw", "registered"),
    [
        ("color/{}.png", "depth/{}.png", "aligned_depth/{}.png"),
        ("rgb/{}.png", "depth_raw/{}.png", "depth_registered/{}.png"),
        ("image/{}.png", "depth/{}.png", "depth_to_rgb/{}.png"),
        ("{}_color.png", "{}_depth.png", "{}_depth_aligned.png"),
        ("{}_rgb.png", "{}_depth_raw.png", "{}_depth_registered.png"),
        ("color.png", "depth.png", "aligned_depth.png"),
    ],
)
def test_registered_depth_of_a_folder_is_taken(tmp_path, photo_name, raw, registered):
    truth, photo = scene()
    depth = millimetres(coarse(truth))
    for number in range(2):
        write(tmp_path / "in" / photo_name.format(number), photo)
        write(tmp_path / "in" / raw.format(number), np.roll(depth, 3, 1))
        write(tmp_path / "in" / registered.format(number), depth)
    assert lr_error(read(tmp_path / "in"), coarse(truth))[0] < 0.5


def test_frames_without_registered_depth_are_left_out_beside_others(tmp_path):
    depth = millimetres(coarse(scene()[0]))
    for number in range(3):
        write(tmp_path / f"{number}_rgb.png", scene()[1])
        write(tmp_path / f"{number}_depth.png", np.roll(depth, 3, 1))
    write(tmp_path / "1_depth_aligned.png", depth)
    assert [pair.depth.stem for pair in find_pairs_of_folder(tmp_path).pairs] == ["1_depth_aligned"]


def test_depth_of_another_frame_with_a_like_camera_is_a_warning(tmp_path):
    pictures = {
        "/camera/color/image_raw": (scene()[1], COLOUR, PHOTO_INFO),
        "/camera/depth/image_rect_raw": (millimetres(coarse(scene()[0])), DEPTH, PHOTO_INFO),
    }
    write_bag(tmp_path / "a", pictures)
    assert upsample(tmp_path / "out", tmp_path / "a", "--strict") == 2
    assert upsample(tmp_path / "out", tmp_path / "a") == 0


def test_encoding_of_a_topic_that_is_not_read_is_named(tmp_path, capsys):
    truth, photo = scene()
    pictures = {
        "/camera/color/image_raw": (photo, COLOUR, PHOTO_INFO),
        "/camera/depth/image_raw": (truth, COLOUR, None),
    }
    write_bag(tmp_path / "a", pictures)
    assert upsample(tmp_path / "out", tmp_path / "a") == 2
    error = capsys.readouterr().err
    assert "64FC1" in error
    assert "16UC1" in error


POSE = np.array([[1.0, 0, 0, 0.2], [0, 1, 0, 0.1], [0, 0, 1, 0.3], [0, 0, 0, 1]])
GL = np.diag([1.0, -1, -1, 1])
OF_ALL = {"fl_x": 288.0, "fl_y": 288.0, "cx": 160.0, "cy": 120.0, "w": 320, "h": 240, "camera_model": "OPENCV"}
YAML = """%YAML:1.0
---
camera_name: "1"
image_width: 320
image_height: 240
camera_matrix:
   rows: 3
   cols: 3
   data: [ 288., 0., 159.5, 0.,
       288., 119.5, 0., 0., 1. ]
distortion_coefficients:
   rows: 1
   cols: 5
   data: [ 0., 0., 0., 0., 0. ]
"""
FOV = {name: math.degrees(2 * math.atan(side / 2 / FOCAL)) for name, side in (("fov_x", 320), ("fov_y", 240))}


@pytest.mark.parametrize(
    ("photo_name", "depth_name", "calibration", "content"),
    [
        ("images/f_1.png", "depths/f_1.png", "transforms.json", {**OF_ALL, "frames": [{}]}),
        ("images/f_1.png", "maps/other.png", "transforms.json",
         {"frames": [OF_ALL | {"depth_file_path": "maps/other.png"}]}),
        ("images/r_0.png", "depth/r_0.png", "transforms.json",
         {"camera_angle_x": math.radians(FOV["fov_x"]), "frames": [{"file_path": "./images/r_0"}]}),
        ("nerfstudio/images/f_1.png", "nerfstudio/depths/f_1.png", "transforms.json", {**OF_ALL, "frames": [{}]}),
        ("rgb/7.jpg", "depth/7.png", "calib/7.yaml", YAML),
        ("rgb/7.jpg", "depth/7.png", "color_camera_info.yaml", YAML),
        ("rgb/7.jpg", "depth/7.png", "calibration.txt", "288 288 159.5 119.5\n"),
        ("image.jpg", "depth.npy", "fov.json", FOV),
    ],
)  # fmt: skip
def test_calibration_beside_the_pictures_is_read(tmp_path, photo_name, depth_name, calibration, content):
    truth, photo = scene()
    write(tmp_path / photo_name, photo)
    write(tmp_path / depth_name, truth if depth_name.endswith("npy") else millimetres(coarse(truth)))
    if calibration == "transforms.json":
        content["frames"] = [
            {"file_path": photo_name, "transform_matrix": (POSE @ GL).tolist(), **each} for each in content["frames"]
        ]
    (tmp_path / calibration).parent.mkdir(exist_ok=True)
    (tmp_path / calibration).write_text(content if isinstance(content, str) else json.dumps(content))
    picture = read(tmp_path / "nerfstudio" if "nerfstudio" in photo_name else tmp_path)
    camera = picture.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((288, 288, 159.5, 119.5))
    assert not any("60 degrees" in str(note) for note in picture.assumptions)
    if calibration == "transforms.json":
        np.testing.assert_allclose(picture.pose, POSE)


def test_transforms_of_poses_alone_and_of_maps_that_are_gone_leave_the_pair(tmp_path):
    write(tmp_path / "images/1.png", scene()[1])
    write(tmp_path / "depth/1.png", millimetres(coarse(scene()[0])))
    frame = {"file_path": "images/1.png", "depth_file_path": "gone/1.png", "transform_matrix": (POSE @ GL).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    picture = read(tmp_path)
    np.testing.assert_allclose(picture.pose, POSE)
    assert picture.camera.width == 320


def test_scene_that_is_exported_to_nerfstudio_is_read_again(tmp_path):
    truth, photo = scene()
    write(tmp_path / "in" / "rgb.png", photo)
    write(tmp_path / "in" / "depth.png", millimetres(coarse(truth)))
    options = ("--rgb", tmp_path / "in" / "rgb.png", "--depth", tmp_path / "in" / "depth.png", *CAMERA)
    assert upsample(tmp_path / "out", *options, "--with", "nerfstudio") == 0
    for place in (tmp_path / "out", tmp_path / "out" / "nerfstudio"):
        picture = read(place)
        camera = picture.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx((288, 288, 159.5, 119.5))
        np.testing.assert_allclose(picture.pose, np.eye(4))


@pytest.mark.parametrize(
    ("name", "content"),
    [("transforms.json", "{}"), ("calibration.txt", "P0: 1 2 3"), ("calib/1.yaml", YAML.replace("[ 0.,", "[ 0.1,")),
     ("camera.xml", "<camera/>"), ("intrinsics.yaml", "fx: 3"), ("fov.json", '{"fov_x": "wide"}'),
     ("ir_camera.yaml", YAML)],
)  # fmt: skip
def test_calibration_that_is_not_read_is_named(tmp_path, name, content):
    truth, photo = scene()
    write(tmp_path / "rgb/1.png", photo)
    write(tmp_path / "depth/1.png", millimetres(coarse(truth)))
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(content)
    found = find_pairs_of_folder(tmp_path)
    notes = found.assumptions
    assert found.pairs[0].camera is None
    assert any("not read" in str(note) and name.split("/")[0] in str(note) for note in notes)


MATRIX = "288 0 159.5\n0 288 119.5\n0 0 1\n"
CAMERA_JSON = json.dumps({"width": 320, "height": 240, "fx": 288.0, "fy": 288.0, "cx": 159.5, "cy": 119.5})


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le"])
@pytest.mark.parametrize(
    ("name", "content"),
    [("camera.json", CAMERA_JSON), ("k.txt", MATRIX), ("k.txt", MATRIX.replace(".", ",")), ("k.yaml", YAML)],
)
def test_camera_of_any_encoding_is_read(tmp_path, name, content, encoding):
    (tmp_path / name).write_bytes(content.encode(encoding))
    camera = read_any_camera(tmp_path / name)
    numbers = (camera[0, 0], camera[0, 2]) if isinstance(camera, np.ndarray) else (camera.camera.fx, camera.camera.cx)
    assert numbers == (288, 159.5)


def test_camera_without_a_principal_point_is_refused(tmp_path):
    (tmp_path / "k.txt").write_text("288 0 0\n0 288 0\n0 0 1\n")
    pair = (
        "--rgb",
        write(tmp_path / "rgb.png", scene()[1]),
        "--depth",
        write(tmp_path / "d.png", millimetres(coarse(scene()[0]))),
    )
    assert upsample(tmp_path / "out", *pair, "--camera", tmp_path / "k.txt") == 2


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_lists_that_windows_wrote_are_read(tmp_path, encoding):
    truth, photo = scene()
    for kind, picture in (("rgb", photo), ("depth", 5 * millimetres(coarse(truth)))):
        write(tmp_path / kind / "1305031102.175304.png", picture)
        line = f"# list\r\n1305031102,175304 {kind}\\1305031102.175304.png\r\n"
        (tmp_path / f"{kind}.txt").write_bytes(line.encode(encoding))
    (tmp_path / "groundtruth.txt").write_bytes("1305031102.175304 0.5 0 0 0 0 0 1\r\n".encode(encoding))
    picture = read(tmp_path)
    assert lr_error(picture, coarse(truth))[0] < 0.5
    assert picture.pose[0, 3] == 0.5


LINES = [f"{number} {0.05 * number} 0 0 0 0 0 1" for number in range(3)]
BY_ID = [f"{100.5 + number} {0.05 * number} 0 0 0 0 0 1 {number}" for number in range(3)]
ROWS = [f"1 0 0 {0.05 * number} 0 1 0 0 0 0 1 0" for number in range(3)]


@pytest.mark.parametrize(
    ("lines", "known"),
    [
        (LINES, "012"),
        (["#timestamp x y z qx qy qz qw id", *(f"{line} {number + 1}" for number, line in enumerate(LINES))], "012"),
        (BY_ID, "012"),
        ([line.replace(".", ",") for line in BY_ID], "012"),
        ([line.replace(" ", ";").replace(".", ",") for line in LINES], "012"),
        ([LINES[0], "1 nan nan nan nan nan nan nan", LINES[2]], "02"),
        ([LINES[0], "1 0 0 0 0 0 0 0", LINES[2]], "02"),
        ([ROWS[0], " ".join(["-inf"] * 12), ROWS[2]], "02"),
    ],
)
def test_poses_with_ids_decimal_commas_and_lost_frames_are_read(tmp_path, lines, known):
    (tmp_path / "poses.txt").write_text("\n".join(lines) + "\n")
    pairs = [Pair(str(number), Path(f"{number:06}.png"), Path(f"{number:06}.png")) for number in range(3)]
    poses = read_poses(tmp_path / "poses.txt").assign(pairs)
    assert {name: pose[0, 3] for name, pose in poses.items()} == {each: 0.05 * int(each) for each in known}


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_camera_of_the_sensor_is_turned_with_the_photo(tmp_path, orientation):
    truth, photo = scene()
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(photo).save(tmp_path / "rgb.jpg", exif=exif)
    upright = {5: truth.T, 6: truth.T[:, ::-1], 7: truth[::-1, ::-1].T, 8: truth.T[::-1]}[orientation]
    write(tmp_path / "depth.png", millimetres(coarse(upright)))
    camera = {"width": 320, "height": 240, "fx": 288.0, "fy": 290.0, "cx": 150.0, "cy": 110.0}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    write(tmp_path / "stored" / "depth.png", millimetres(coarse(truth)))
    for name in ("rgb.jpg", "camera.json"):
        shutil.copy(tmp_path / name, tmp_path / "stored")
    upright = {**camera, "width": 240, "height": 320}  # which is not of the photo as it is stored
    (tmp_path / "stored" / "camera.json").write_text(json.dumps(upright))
    with pytest.raises(ValueError, match=r"camera\.json.*240 x 320"):
        read(tmp_path / "stored")
    camera = read(tmp_path).camera
    cx, cy = {5: (110, 150), 6: (129, 150), 7: (129, 169), 8: (110, 169)}[orientation]
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (240, 320, 290, 288, cx, cy)


def test_frames_and_notes_of_several_archives_are_those_of_each(tmp_path):
    captures.record3d(tmp_path / "b" / "1.r3d")
    captures.record3d(tmp_path / "b" / "2.r3d", poses=captures.record3d_metadata()["poses"][:1] * captures.FRAMES)
    each = [find_pairs_of_folder(tmp_path / "b" / f"{number}.r3d").assumptions for number in (1, 2)]
    assert set(find_pairs_of_folder(tmp_path / "b").assumptions) == {*each[0], *each[1]}
    captures.sens(tmp_path / "one" / "a.sens")
    for name in ("a", "b"):
        captures.sens(tmp_path / "two" / f"{name}.sens")
    one, two = ({pair.name for pair in find_pairs_of_folder(tmp_path / place).pairs} for place in ("one", "two"))
    assert one == {name for name in two if name.startswith("a/")}


LPIPS = random_lpips()
SMALL = dsr.Camera(64, 48, 58, 58, 31.5, 23.5)
HALVES = (torch.float16, torch.bfloat16)


def maps(count=2):
    """Return noisy and exact depth, (count, 1, 48, 64) float32."""
    target = torch.from_numpy(scene(64, 48, 58)[0]).float().expand(count, 1, -1, -1).clone()
    return target * (1 + 0.01 * torch.randn(target.shape, generator=torch.Generator().manual_seed(2))), target


def pair_of(prediction, target):
    return SurfacePair.of(prediction, target, SMALL)


def scores(prediction, target, *protocols):
    metrics = visual_metrics(LPIPS, protocols=protocols)
    metrics.update(prediction, target, SMALL)
    return {name: float(value) for name, value in metrics.compute().items()}


@pytest.mark.parametrize("protocols", [("paper",), ("field", "normals", "plane")])
def test_metrics_are_the_same_within_autocast_and_of_maps_of_16_bits(protocols):
    prediction, target = maps()
    expected = scores(prediction, target, *protocols)
    for kind in HALVES:
        with torch.autocast("cpu", kind):
            assert repr(scores(prediction, target, *protocols)) == repr(expected)
        half = prediction.to(kind), target.to(kind)
        assert repr(scores(*half, *protocols)) == repr(scores(*(each.float() for each in half), *protocols))


@pytest.mark.parametrize(
    "function",
    [
        losses.l1,
        losses.mse,
        losses.lap1,
        lambda *both: VisualLoss("mse_v")(pair_of(*both)),
        lambda *both: VisualLoss("dssim")(pair_of(*both)),
        lambda *both: VisualLoss("lpips", LPIPS)(pair_of(*both)),
        lambda *both: dssim_v(pair_of(*both)),
    ],
    ids=["l1", "mse", "lap1", "mse_v", "dssim", "lpips", "dssim_v"],
)
def test_losses_and_their_gradients_are_the_same_within_autocast(function):
    prediction, target = maps()
    prediction.requires_grad_()

    def value_and_gradient(kind=None):
        with torch.autocast("cpu", kind or torch.bfloat16, enabled=kind is not None):
            value = function(prediction, target)
        return value, *torch.autograd.grad(value.sum(), prediction)

    expected = value_and_gradient()
    for kind in HALVES:
        assert all(map(torch.equal, value_and_gradient(kind), expected))
        half = function(prediction.to(kind), target.to(kind))
        assert half.dtype == torch.float32
        assert torch.autograd.grad(half.sum(), prediction)[0].isfinite().all()


@pytest.mark.parametrize("objective", [DepthObjective("lap1", 0.5, shading=0.1), SurfaceObjective()])
def test_objective_is_the_same_within_autocast_and_of_answers_of_16_bits(objective):
    prediction, target = (1 / each for each in maps())
    batch = {"depth": 1 / target, "bf": torch.ones(2, 1, 1, 1), "doffs": torch.zeros(2, 1, 1, 1), "soft": torch.ones(2)}
    batch |= {"rays": SMALL.rays(dtype=torch.float32)[None], "rgb": torch.rand(2, 3, 48, 64)}
    batch["disparity_lr"] = torch.nn.functional.avg_pool2d(target, 4)
    made = [each.bfloat16() for each in (prediction, 0.1 * prediction, 0.2 * prediction)]
    expected = objective(Answer(*(each.float() for each in made), stages=(made[0].float(),)), batch)
    with torch.autocast("cpu", torch.bfloat16):
        found = objective(Answer(*made, stages=(made[0],)), batch)
    assert {name: float(each) for name, each in found.items()} == {name: float(each) for name, each in expected.items()}


class Trained(lightning.LightningModule):
    """A module of a user's, which scores batches of (prediction, target, cameras)."""

    def __init__(self):
        super().__init__()
        self.weight, self.metric = torch.nn.Parameter(torch.ones(())), RMSEd()

    def training_step(self, batch, _):
        self.value = float(self.metric(batch[0], batch[1], batch[2]))
        return self.weight * batch[0].mean()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


@pytest.mark.filterwarnings("ignore:.*LeafSpec", "ignore:.*does not have many workers", "ignore:.*logging interval")
def test_cameras_pass_through_batches():
    prediction, target = maps()
    data = DataLoader([(prediction[index], target[index], SMALL) for index in range(2)], batch_size=2)
    module = Trained()
    silent = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    lightning.Trainer(max_epochs=1, accelerator="cpu", enable_model_summary=False, **silent).fit(module, data)
    expected = float(RMSEd()(prediction, target, SMALL))
    assert module.value == expected
    several = torchmetrics.wrappers.BootStrapper(RMSEd(), num_bootstraps=3, sampling_strategy="multinomial")
    several.update(prediction, target, SMALL)
    assert float(several.compute()["mean"]) == pytest.approx(expected, rel=0.1)
    for camera in ([SMALL, SMALL], SMALL.rays().numpy()):
        assert float(RMSEd()(prediction.numpy(), target.numpy(), camera)) == expected
    other = SMALL.crop(0, 0, 48, 32).rescale(64, 48)
    both = [float(RMSEd()(prediction[:1], target[:1], each)) for each in (SMALL, other)]
    assert float(RMSEd()(prediction[[0, 0]], target[[0, 0]], [SMALL, other])) == pytest.approx(np.mean(both))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"camera": [SMALL] * 3}, "camera: expected one for each of 2 maps"),
        ({"camera": [SMALL]}, "camera: expected one for each of 2 maps"),
        ({"camera": [SMALL, SMALL.rescale(32, 24)]}, "camera: expected one for each of 2 maps"),
        ({"camera": [np.eye(3)] * 2}, "camera: expected dsr.Camera"),
        ({"target": np.ones((48, 64))}, "prediction, target: expected two depth maps"),
        ({"target": np.full((2, 1, 48, 64), 1500, np.uint16)}, "prediction, target: expected metres as floats"),
    ],
)
def test_arguments_of_metrics_that_do_not_fit_are_named(change, named):
    prediction, target = maps()
    with pytest.raises(ValueError, match=f"^{named}"):
        DSSIMv().update(**{"preds": prediction, "target": target, "camera": SMALL, **change})


def test_camera_stays_as_it_is():
    with pytest.raises(dataclasses.FrozenInstanceError):
        SMALL.fx = 60.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        SMALL.focal = 60.0
    assert pickle.loads(pickle.dumps(SMALL)) == SMALL
    assert hash(SMALL) == hash(dataclasses.replace(SMALL))


def test_metrics_are_plotted():
    pytest.importorskip("matplotlib").use("agg")
    for metric in (RMSEd(), LPIPSv(LPIPS)):
        metric.update(*maps(), SMALL)
        assert metric.plot()[1].get_ylabel() == type(metric).__name__


@pytest.mark.parametrize("pose", [(), (np.eye(4),)])
@pytest.mark.parametrize(("wrong", "place"), [(None, 2), (None, 0), ((None, None, None), 1), (5, 3)])
def test_stream_names_a_frame_that_is_none(pose, wrong, place):
    depth, photo = scene(64, 48, 58)
    frames = [(photo, coarse(depth), SMALL, *pose)] * 4
    found = []
    with pytest.raises(ValueError, match=f"^frame {place}: "):
        found.extend(dsr.Upsampler("bicubic").stream([*frames[:place], wrong, *frames[place:]], neighbours=2))
    assert len(list(dsr.Upsampler("bicubic").stream(frames, neighbours=2))) == 4


@pytest.fixture
def tf32(monkeypatch):
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", True)
    monkeypatch.delenv("DSR_DEVICE", raising=False)


@pytest.mark.usefixtures("tf32")
def test_float32_on_a_gpu_is_float32_and_methods_run_where_they_are_fast():
    def chosen(method, device="auto"):
        return torch.device(upsampler(method, device=device)._run.device).type

    assert pick_device("cpu").type == "cpu"
    assert torch.backends.cudnn.allow_tf32
    with pretend_cuda():
        assert [chosen(name) for name in ("srfs", "joint_bilateral")] == ["cpu", "cpu"]
        assert torch.backends.cudnn.allow_tf32
        assert [chosen(name, "cuda") for name in ("srfs", "joint_bilateral")] == ["cuda", "cuda"]
        assert [chosen(name) for name in ("guided_filter", "facets")] == ["cuda", "cuda"]
    assert not torch.backends.cudnn.allow_tf32


@pytest.fixture
def command(in_process, tmp_path):
    """Return a runner of train and eval with three small scenes: the exit code, the output and the error lines."""
    for number in range(3):
        depth, photo = scene(64, 48, 58, 0.1 * number)
        folder = tmp_path / "data" / f"scene{number}"
        write(folder / "rgb.png", photo)
        np.save(folder / "depth.npy", depth)
        (folder / "camera.json").write_text(json.dumps(vars(SMALL)))

    def run(name, *arguments):
        smoke = ["trainer=smoke", "model.scheduler.warmup=1"] if name == "train" else []
        given = ["dataset=folder", "dataset.root=data", "metrics.lpips=false", "device=cpu", "output_dir=out"]
        return in_process(name, *smoke, *given, *arguments)

    return run


OF_LIGHTNING = "lightning.pytorch.callbacks"


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        (["callbacks=[default,learning_rate]", "logger=[]"], "learning_rate"),
        (["callbacks=[default,early_stopping]", "callbacks.early_stopping.monitor=val/loss"], "early_stopping.monitor"),
        (["GradientAccumulationScheduler", "+callbacks.mine.scheduling={0:2}"], "mine"),
        (["RichProgressBar"], "mine"),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_callback_that_cannot_work_is_named_in_a_line(command, arguments, key):
    if "=" not in arguments[0]:
        arguments = [f"+callbacks.mine._target_={OF_LIGHTNING}.{arguments[0]}", *arguments[1:]]
    code, _, errors = command("train", *arguments)
    assert (code, len(errors)) == (2, 1)
    assert errors[0].startswith(f"error: callbacks.{key}: ")


def test_checkpoints_of_a_user_are_written_beside_those_of_dsr(command):
    given = ["trainer.max_steps=1"]
    for name, monitor in (
        ("first", []),
        ("second", ["+callbacks.second.monitor=val/RMSE_d"]),
        ("third", ["+callbacks.third.monitor=val/RMSE_d"]),
    ):
        target = f"+callbacks.{name}._target_={OF_LIGHTNING}.ModelCheckpoint"
        given += [target, f"+callbacks.{name}.dirpath={name}", *monitor]
    code, _, errors = command("train", *given)
    assert (code, errors) == (0, [])
    assert {path.name for path in Path("out/checkpoints").iterdir()} == {"best.ckpt", "last.ckpt"}
    assert [path.suffix for name in ("first", "second", "third") for path in Path(name).iterdir()] == [".ckpt"] * 3


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["train", "model.optimizer.betas=[0.9,0.99]"], "+model.optimizer.betas="),
        (["train", "trainer.limit_val_batches=1"], "+trainer.limit_val_batches="),
        (["train", "trainer.max_epochs=1"], "did you mean max_steps?"),
        (["train", "trainer.precision=16"], "precision="),
        (["train", "ckpt_path=x"], "resume="),
        (["train", "trainer.ckpt_path=x"], "resume="),
        (["eval", "ckpt_path=x"], "run="),
        (["train", "hydra/sweeper=optuna"], "pip install hydra-optuna-sweeper"),
        (["train", "hydra/launcher=ray"], "pip install hydra-ray-launcher"),
        (["eval", "metrics=[paper,depth]"], "metrics.protocols="),
        (["eval", "metrics=paper,depth"], "metrics.protocols="),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_argument_leads_to_the_one_that_is_meant(command, arguments, meant):
    code, _, errors = command(*arguments)
    assert (code, len(errors)) == (2, 1)
    assert meant in errors[0]


@pytest.mark.parametrize(
    ("alignment", "make", "given"),
    [
        ("affine_disparity", lambda depth: 17 * (1 / depth - 0.2), ["method.range_type=inverse"]),
        ("robust", lambda depth: np.round(1000 * depth).astype(np.uint16), []),
    ],
)
def test_relative_maps_need_no_scale_of_their_own_if_they_are_aligned(command, alignment, make, given):
    for number in range(3):
        depth = scene(64, 48, 58, 0.1 * number)[0]
        Path("theirs").mkdir(exist_ok=True)
        np.save(f"theirs/scene{number}.npy", make(depth))
    given = ["method=external", "method.path=theirs", *given]
    code, _, errors = command("eval", *given, f"metrics.alignment={alignment}", "metrics=depth")
    assert (code, errors) == (0, [])
    values = [line.split(",") for line in Path("out/scores.csv").read_text().splitlines()]
    place = {name: values[0].index(name) for name in ("metric", "value")}
    errors = [float(row[place["value"]]) for row in values[1:] if row[place["metric"]] == "Depth_RMSE"]
    assert len(errors) == 3
    assert max(errors) < 1e-3
    code, _, errors = command("eval", *given, "output_dir=alone")
    assert code == 2
    assert all("theirs/scene" in error for error in errors[:-1])


def boards(number, by):
    """Return exact depth (240, 320) of a wall and boards at ``number`` depths, the map that has ``by`` times coarser
    pixels, and a photo of them."""
    depth = np.full((240, 320), 3.0)
    colour = np.full((240, 320, 3), 190.0) + 30 * np.random.default_rng(1).random((240, 320, 1))
    places = ((0, 240, 140, 180), (60, 120, 30, 90), (150, 200, 200, 300))
    for (top, bottom, left, right), z in zip(places[: number - 1], (1.5, 2.2, 1.125), strict=False):
        depth[top:bottom, left:right], colour[top:bottom, left:right] = z, (40, 200 * (z > 2), 100 * z)
    return depth, depth[by // 2 :: by, by // 2 :: by], colour.astype(np.uint8)


def expected_error(folder: Path, photo, depth, name, *options):
    """Return the median expected error in millimetres."""
    files = "--rgb", write(folder / "photo.png", photo), "--depth", write(folder / name, depth), *CAMERA, *options
    assert upsample(folder / "out", *files, method="facets", only="depth,confidence") == 0
    return 1000 * float(np.nanmedian(np.load(folder / "out/confidence.npz")["depth_error"]))


@pytest.mark.parametrize(
    ("number", "by", "name"), [(2, 4, "d.png"), (3, 8, "d.npy"), (4, 4, "d.npy"), (4, 2, "d.png"), (2, 1, "d.tiff")]
)
def test_exact_boards_are_not_rounded(tmp_path, number, by, name):
    _, depth, photo = boards(number, by)
    depth = millimetres(depth) if name == "d.png" else depth.astype(np.float32)
    assert expected_error(tmp_path, photo, depth, name, "--for", "robot") < 6
    kept = cv2.imread(str(tmp_path / "out/depth_metres.tiff"), cv2.IMREAD_UNCHANGED)
    assert np.isfinite(kept).mean() > 0.9


def test_exact_boards_beside_a_tilted_one_and_in_disparity_are_not_rounded(tmp_path):
    depth, _, photo = boards(2, 4)
    depth[40:200, 200:300] = 2 / (1 + 0.2 * (np.arange(200, 300) - 250) / FOCAL)
    photo[40:200, 200:300] = 30, 160, 60
    assert expected_error(tmp_path / "tilted", photo, millimetres(depth[2::4, 2::4]), "d.png") < 8
    disparity = (72 * 0.25 / boards(2, 4)[1]).astype(np.float32)
    options = "--range-type", "disparity", "--baseline", 0.25
    assert expected_error(tmp_path / "disparity", boards(2, 4)[2], disparity, "d.tiff", *options) < 6


@pytest.mark.parametrize("depths", [(4.0, 1.0), (3.0, 2.0, 1.0), (2.4, 1.8, 1.2, 0.6)])
def test_boards_before_each_other_are_no_disparities(depths):
    depth = np.full((60, 80), depths[0])
    for number, nearer in enumerate(depths[1:]):
        depth[5 + 2 * number : 50, 10 + 20 * number : 25 + 20 * number] = nearer
    assert inverse_votes(depth).verdict is inverse_votes(1 / depth).verdict is None


@pytest.mark.parametrize("step", [0.02, 0.1, 0.2])
def test_rounded_slopes_keep_the_error_of_their_rounding(tmp_path, step):
    depth, photo = scene()
    rounded = (step * np.round(depth[2::4, 2::4] / step)).astype(np.float32)
    assert expected_error(tmp_path, photo, rounded, "d.npy") > 1000 * step / 6


@pytest.mark.parametrize(("method", "most"), [("nearest", 0), ("bilinear", 0), ("bicubic", 0), ("guided_filter", 100)])
def test_both_commands_agree_on_maps_of_the_photos_own_size(tmp_path, method, most):
    depth, photo = scene()
    files = "--rgb", write(tmp_path / "p.png", photo), "--depth", write(tmp_path / "d.png", millimetres(depth))
    assert upsample(tmp_path / "out", *files, *CAMERA, method=method) == 0
    result = torch.from_numpy(cv2.imread(str(tmp_path / "out/depth_metres.tiff"), cv2.IMREAD_UNCHANGED))
    given = torch.from_numpy(millimetres(depth) / 1000).float()
    camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, 159.5, 119.5)
    rgb = torch.from_numpy(photo).permute(2, 0, 1) / 255
    run = Run(device=torch.device("cpu"), precision="float32", seed=0, downsampling=Downsampling("box"))
    direct = read_recipe(method).build(1, run)(DepthSample("a", "b", rgb, given[None], camera, camera, 1))[0]
    assert float((1000 * (result - direct)).abs().max()) < 0.01
    assert float((1000 * (result - given)).abs().max()) < most + 0.01


def warnings_of(out: Path):
    """Return the messages of the warnings of a result, by code."""
    return {each["code"]: each["message"] for each in json.loads((out / "info.json").read_text())["warnings"]}


@pytest.mark.parametrize(("ratio", "by"), [(0.7, 4), (0.85, 2), (1.0, 4), (1.5, 4)])
def test_another_field_of_view_is_reported(tmp_path, ratio, by):
    depth, photo = scene()
    (height, width), cut = (round(each * min(ratio, 1 / ratio) / 4) * 4 for each in (HEIGHT, WIDTH)), max(ratio, 1)
    inner = slice((HEIGHT - height) // 2, (HEIGHT + height) // 2), slice((WIDTH - width) // 2, (WIDTH + width) // 2)
    depth, photo = (depth, photo[inner]) if cut > 1 else (depth[inner], photo)
    small = cv2.resize(millimetres(depth), (WIDTH // by, HEIGHT // by), interpolation=cv2.INTER_NEAREST)
    photo = cv2.resize(photo, (WIDTH, HEIGHT))
    files = "--rgb", write(tmp_path / "p.png", photo), "--depth", write(tmp_path / "d.png", small)
    assert upsample(tmp_path / "out", *files, *CAMERA) == 0
    found = warnings_of(tmp_path / "out")
    assert set(found) == ({"field-of-view"} if ratio != 1 else set())
    if ratio != 1:
        assert float(re.findall(r"looks ([\d.]+) times", found["field-of-view"])[0]) == pytest.approx(ratio, rel=0.1)


@pytest.mark.parametrize(("sign", "apart"), [(1, 0.1), (-1, 0.1), (1, -0.25), (-1, -0.25)])
def test_inverse_extrinsics_are_reported(tmp_path, sign, apart):
    depth, photo = scene(shift=apart)[0][2::4, 2::4], scene()[1]
    matrix = np.eye(4)
    matrix[0, 3] = sign * apart
    np.savetxt(tmp_path / "matrix.txt", matrix)
    np.savetxt(tmp_path / "depth.txt", [[72, 0, 39.5], [0, 72, 29.5], [0, 0, 1]])
    files = "--rgb", write(tmp_path / "p.png", photo), "--depth", write(tmp_path / "d.png", millimetres(depth))
    rig = "--depth-camera", tmp_path / "depth.txt", "--extrinsics", tmp_path / "matrix.txt"
    assert upsample(tmp_path / "out", *files, *CAMERA, *rig) == 0
    assert ("extrinsics-inverse" in warnings_of(tmp_path / "out")) == (sign < 0)


@pytest.mark.parametrize(
    ("photo", "depth", "gigabytes"),
    [((3000, 4000), (192, 256), 1.9), ((3000, 4000), (750, 1000), 2.5), ((6000, 8000), (192, 256), 3.0),
     ((6000, 8000), (750, 1000), 5.8), ((9000, 12000), (192, 256), 5.8)],
)  # fmt: skip
def test_estimated_memory_is_about_what_was_measured(photo, depth, gigabytes):
    text = plan_for(read_recipe("facets"), photo, depth).text
    assert float(re.findall(r"about ([\d.]+) GB", text)[0]) == pytest.approx(gigabytes, rel=0.25)


def test_expected_errors_of_stereo_grow_with_the_square_of_the_distance():
    inverse = 1 / torch.tensor([1.0, 2.0, 4.0]).double().repeat_interleave(64).expand(1, 64, 192)
    noise, spread = MapNoise(0.004, 8.0, 2.0), torch.full_like(inverse, 0.05)
    errors = (limit_to_noise(spread, noise, inverse, inverse) / inverse)[0, 0, 32::64]
    torch.testing.assert_close(errors, left_of(0.004) * torch.tensor([0.25, 1.0, 4.0]).double())

"""Files that declare or unpack to gigabytes are refused by their headers, in little memory and one line."""

from __future__ import annotations

import bz2
import importlib
import io
import json
import zipfile
from pathlib import Path

import bombs
import cv2
import h5py
import numpy as np
import pytest
import safetensors.torch
import torch

from dsr.app.upsample.scene import write_scene
from dsr.data.matlab import read_variables
from dsr.data.preparation import Preparation
from dsr.data.rendered import Procedural, SimGeo
from dsr.evaluation.run_files import read_run
from dsr.evaluation.store import load_prediction
from dsr.io.captures import bags, stray
from dsr.io.captures.record3d import find_record3d
from dsr.io.depth_files import read_depth_file, write_depth_file
from dsr.io.exports import read_input
from dsr.io.images import pixels_in_header, read_mask, read_pixels
from dsr.io.inputs import read_picture
from dsr.io.pairs import Pair
from dsr.io.photos import read_photo
from dsr.io.reading import Reading
from dsr.methods.classical.bilateral import Bilateral, JointBilateral
from dsr.methods.classical.edge_guided import EdgeGuided
from dsr.methods.classical.guided_filter import GuidedFilter
from dsr.methods.networks.trained import NETWORKS
from dsr.methods.networks.weight_choice import packaged_weights
from dsr.methods.networks.weight_files import load_network
from dsr.sample import DepthSample
from dsr.training.settings import PatchSettings
from dsr.utils.guards import (
    TooLargeError,
    bytes_of_archive,
    expect_stored,
    pixels_beside,
    pixels_of_file,
    read_limited,
    read_member,
)
from dsr.utils.picture_headers import picture_size
from dsr.utils.torch_files import read_torch_file

MOST = 450 << 20
"""Largest growth of memory in bytes while a file is refused; MATLAB's old files take the most."""


def memory(key):
    """Return an entry of this process's memory in bytes."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(key))
    return 1024 * int(line.split()[1])


@pytest.fixture
def watched():
    """Check that memory does not grow within the test beyond ``MOST``."""
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        before = memory("VmRSS")
    except OSError:
        pytest.skip("needs the peak of memory in Linux's /proc")
    yield
    assert memory("VmHWM") - before < MOST


def photo(path):
    return read_photo(path, (8, 8))


def capture(path):
    return [pair.capture.photo.read() for pair in find_record3d(path).pairs]


CASES = [
    (bombs.npz, "x.npz", read_depth_file, "expected at most 268435456 bytes, got 536870912"),
    (bombs.npz, "x.npz", load_prediction, "expected at most 268435456 bytes, got 536870912"),
    (bombs.npz, "x.npz", DepthSample.load, "expected at most 268435456 bytes, got 536870912"),
    (bombs.npz, "x.npz", read_input, "expected depth_lr"),
    (bombs.npz_long_header, "x.npz", read_depth_file, "expected an archive of arrays"),
    (bombs.npy, "x.npy", read_depth_file, "the array: expected at most"),
    (bombs.npy_sparse, "x.npy", read_depth_file, "the array: expected at most"),
    (bombs.png, "x.png", read_depth_file, "expected at most"),
    (bombs.png, "x.png", read_mask, "expected at most"),
    (bombs.png_huge_header, "x.png", photo, "got 2147483647 x 2147483647 (width x height)"),
    (bombs.jpeg, "x.jpg", photo, "got 65500 x 65500 (width x height)"),
    (bombs.bmp, "x.bmp", photo, "got 40000 x 40000 (width x height)"),
    (bombs.webp, "x.webp", photo, "got 16384 x 16384 (width x height)"),
    (bombs.ppm, "x.ppm", photo, "got 30000 x 30000 (width x height)"),
    (bombs.tiff, "x.tiff", read_depth_file, "got 32768 x 32768 (width x height)"),
    (bombs.tiff_tiles, "x.tiff", read_depth_file, "expected at most 536870912 bytes, got 1073741824"),
    (bombs.tiff_big, "x.tiff", read_depth_file, "got 1073741824 x 1073741824 (width x height)"),
    (bombs.pfm, "x.pfm", read_depth_file, "expected at most 1073741824 bytes"),
    (bombs.exr, "x.exr", read_depth_file, "got 16384 x 16384 (width x height)"),
    (bombs.mat5, "x.mat", read_variables, "without end, or too large"),
    (bombs.mat73, "x.mat", read_variables, "has 67108864, expected at most"),
    (bombs.mat73_block, "x.mat", read_variables, "has blocks of (16384, 16384)"),
    (bombs.r3d, "x.r3d", capture, "got a damaged one"),
]


@pytest.mark.parametrize(("write", "name", "read", "message"), CASES)
def test_bomb_is_refused_in_one_line_and_little_memory(tmp_path, watched, write, name, read, message):
    path = tmp_path / name
    write(path)
    with pytest.raises(ValueError, match=r"expected") as caught:
        read(path)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert message in text
    assert "\n" not in text


def test_depth_map_may_not_be_much_larger_than_its_photo(tmp_path, watched):
    cv2.imwrite(str(tmp_path / "rgb.png"), np.zeros((64, 64, 3), np.uint8))
    for name in ("depth.png", "depth.npz", "depth.exr"):
        {"depth.png": bombs.png_of_16_megapixels, "depth.npz": bombs.npz, "depth.exr": bombs.exr}[name](tmp_path / name)
        with pytest.raises(TooLargeError, match=rf"{name}: expected at most (4194304 pixels|33554432 bytes)"):
            read_picture(Pair("x", tmp_path / "rgb.png", tmp_path / name), Reading())


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp", ".webp", ".ppm", ".pgm"])
@pytest.mark.parametrize("colour", [True, False])
def test_header_says_the_size_that_the_decoder_finds(tmp_path, suffix, colour):
    path = tmp_path / f"x{suffix}"
    shape = (33, 57, 3) if suffix == ".ppm" or (colour and suffix != ".pgm") else (33, 57)
    assert cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8))
    assert pixels_in_header(path) == (33, 57)
    assert read_pixels(path, cv2.IMREAD_UNCHANGED).shape[:2] == (33, 57)


@pytest.mark.parametrize("dtype", [np.uint16, np.float32, np.float64])
@pytest.mark.parametrize("channels", [1, 3])
def test_header_of_a_tiff_says_the_bytes_of_its_pixels(dtype, channels):
    values = np.zeros((20, 30, channels), dtype)
    size = picture_size(io.BytesIO(cv2.imencode(".tiff", values)[1].tobytes()))
    assert (size.height, size.width, size.bytes_per_pixel) == (20, 30, channels * np.dtype(dtype).itemsize)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tiff", ".bmp", ".webp", ".ppm"])
def test_header_that_is_cut_off_is_none(suffix):
    content = cv2.imencode(suffix, np.zeros((20, 30, 3), np.uint8))[1].tobytes()
    for length in range(0, len(content), max(1, len(content) // 200)):
        picture_size(io.BytesIO(content[:length]))  # raises nothing
    assert picture_size(io.BytesIO(content[:6])) is None
    assert picture_size(io.BytesIO(b"GIF89a" + content)) is None


def test_archive_with_two_arrays_of_one_name_is_refused(tmp_path, watched):
    with zipfile.ZipFile(tmp_path / "x.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
        bombs.zeros(packed, "depth", bombs.npy_head((bombs.LARGE,), "|u1"), bombs.LARGE)
        bombs.zeros(packed, "depth.npy", bombs.npy_head((8, 8), "<f4"), 256)
    with pytest.raises(ValueError, match=r"x\.npz: expected an archive of arrays"):
        read_depth_file(tmp_path / "x.npz")


def test_photo_of_a_camera_and_an_empty_mask_are_within_the_limits():
    assert pixels_of_file(4_000_000) >= 108e6  # a phone's 108 megapixels at high compression
    assert pixels_of_file(100) >= 33e6
    assert pixels_beside(48, 64) >= 2000 * 2000
    assert bytes_of_archive(10 << 20) >= 6000 * 4000 * 8


def test_member_that_unpacks_to_more_than_the_archive_declares_is_damaged(tmp_path, watched):
    bombs.r3d(tmp_path / "x.r3d")
    with zipfile.ZipFile(tmp_path / "x.r3d") as packed, pytest.raises(zipfile.BadZipFile):
        read_member(packed, "rgbd/0.jpg")
    with zipfile.ZipFile(tmp_path / "y.zip", "w") as packed:
        packed.writestr("a", b"content")
    with zipfile.ZipFile(tmp_path / "y.zip") as packed:
        assert read_member(packed, "a") == b"content"


@pytest.mark.parametrize(("name", "compress"), [("bz2", bz2.compress), ("lz4", None), ("zstd", None)])
def test_chunk_of_a_recording_unpacks_to_no_more_than_is_allowed(monkeypatch, name, compress):
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import reader  # noqa: PLC0415 - an extra
    from rosbags.rosbag2 import storage_mcap  # noqa: PLC0415

    tables = {**storage_mcap.DECOMPRESSORS, **reader.decompressors}
    monkeypatch.setattr(reader, "decompressors", dict(reader.decompressors))
    monkeypatch.setattr(storage_mcap, "DECOMPRESSORS", dict(storage_mcap.DECOMPRESSORS))
    monkeypatch.setattr(bags, "_CHUNK", 1 << 20)
    bags._limit_chunks()
    compress = compress or {"lz4": importlib.import_module("lz4.frame"), "zstd": storage_mcap.zstd}[name].compress
    for table in (reader.decompressors, storage_mcap.DECOMPRESSORS):
        if name in table:
            assert table[name](compress(b"a" * 1000), 1000) == b"a" * 1000
            assert table[name] is not tables[name]
            with pytest.raises(ValueError, match="a chunk without end, or of more than 1048576 bytes"):
                table[name](compress(b"\0" * (1 << 24)), 1 << 24)


def test_video_of_too_large_frames_is_refused_when_it_is_opened(tmp_path, monkeypatch):
    path = str(tmp_path / "x.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    assert stray.VideoFrame(tmp_path / "x.avi", 0).read().shape == (48, 64, 3)
    (tmp_path / "x.avi").rename(tmp_path / "y.avi")
    monkeypatch.setattr(stray, "_LARGEST", 3000)
    with pytest.raises(TooLargeError, match=r"y\.avi: expected at most 3000 pixels, got 64 x 48"):
        stray.VideoFrame(tmp_path / "y.avi", 0).read()


@pytest.mark.parametrize("kind", [h5py.ExternalLink("other.h5", "/secret"), h5py.SoftLink("/other")])
def test_matrix_of_another_file_is_not_read(tmp_path, kind):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["secret"] = np.ones((4, 4))
    with h5py.File(tmp_path / "x.mat", "w") as file:
        file["other"] = np.ones((4, 4))
        file["link"] = kind
    with pytest.raises(ValueError, match="link is a link"):
        read_variables(tmp_path / "x.mat")


def test_matrix_with_values_in_another_file_is_not_read(tmp_path):
    (tmp_path / "secret").write_bytes(np.ones(16).tobytes())
    with h5py.File(tmp_path / "x.mat", "w") as file:
        file.create_dataset("depth", (4, 4), "f8", external=[(str(tmp_path / "secret"), 0, 128)])
    with pytest.raises(ValueError, match="has its values in another file"):
        read_variables(tmp_path / "x.mat")


@pytest.mark.parametrize("arguments", [{"scale": 4, "width": 4000}, {"scale": 4, "blocks": 10**9}])
def test_weights_that_ask_for_more_than_their_file_holds_are_refused(tmp_path, watched, arguments):
    header = {"format": 1, "network": "FacetsUNet", "arguments": arguments, "model": "facets", "facts": {}}
    with safetensors.safe_open(packaged_weights("facets_x4"), framework="pt") as file:
        [key] = file.metadata()
        header["format"] = json.loads(file.metadata()[key])["format"]
    safetensors.torch.save_file({"a": torch.zeros(4)}, tmp_path / "w.safetensors", {key: json.dumps(header)})
    with pytest.raises(ValueError, match=r"w\.safetensors: expected"):
        load_network(tmp_path / "w.safetensors", NETWORKS)


def test_torch_file_with_compressed_members_is_refused(tmp_path):
    torch.save({"a": torch.zeros(1 << 20)}, tmp_path / "stored.pth")
    assert read_torch_file(tmp_path / "stored.pth")["a"].shape == (1 << 20,)
    with zipfile.ZipFile(tmp_path / "stored.pth") as before, zipfile.ZipFile(tmp_path / "x.pth", "w", 8) as packed:
        for name in before.namelist():
            packed.writestr(name, before.read(name))
    with pytest.raises(ValueError, match=r"x\.pth: expected"):
        read_torch_file(tmp_path / "x.pth")


def test_large_texts_of_a_run_are_refused_unread(tmp_path):
    (tmp_path / "versions.json").write_text("{}")
    with (tmp_path / "summary.json").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(ValueError, match=r"summary\.json: expected at most 16777216 bytes, got 1099511627776"):
        read_run(tmp_path)


def test_pipe_in_the_place_of_a_file_is_refused_rather_than_waited_for(tmp_path):
    bombs.pipe(tmp_path / "x.json")
    with pytest.raises(OSError, match=r"x\.json"):
        read_limited(tmp_path / "x.json")


def test_record_of_exports_that_names_files_elsewhere_is_refused_and_nothing_removed(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    output = tmp_path / "out"
    output.mkdir()
    record = {"exports": {"transforms.json": ["transforms.json/../../mine.txt"], "open3d": ["open3d/../../mine.txt"]}}
    (output / "exports.json").write_text(json.dumps(record))
    frame = output / "frame"
    (frame / "rgbd").mkdir(parents=True)
    cv2.imwrite(str(frame / "rgbd" / "color.png"), np.zeros((4, 4, 3), np.uint8))
    write_depth_file(frame / "depth_metres.tiff", np.ones((4, 4), np.float32))
    camera = {"width": 4, "height": 4, "fx": 4.0, "fy": 4.0, "cx": 1.5, "cy": 1.5}
    info = {"complete": True, "files": [], "camera": camera, "pose": np.eye(4).tolist()}
    (frame / "info.json").write_text(json.dumps(info))
    result = write_scene(output, {"frame": frame}, ("nerfstudio", "open3d"), overwrite=True)
    assert not result.files
    assert f"{output}/exports.json: exports.transforms.json: expected a name within {output}" in result.problems[0]
    assert (tmp_path / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("build", "name", "value"),
    [
        *((PatchSettings, name, value) for name, value in (("patch", 100_000), ("batch", 10**8), ("workers", 100_000))),
        *((kind, "size", 10**value) for kind in (Procedural, SimGeo, Preparation) for value in (6, 300)),
        *((kind, "radius", 10**9) for kind in (GuidedFilter, JointBilateral, EdgeGuided)),
        (GuidedFilter, "radius", 1e300), (Bilateral, "window", 10**9),
    ],
)  # fmt: skip
def test_what_no_memory_can_hold_is_refused_in_one_line_that_names_it(build, name, value):
    with pytest.raises(ValueError, match=rf"^{name}: expected [^\n]*\Z"):
        build(**{name: value})


def test_device_without_an_end_is_no_torch_file(tmp_path):
    (tmp_path / "last.ckpt").symlink_to("/dev/zero")
    with pytest.raises(OSError, match=r"last\.ckpt"):
        expect_stored(tmp_path / "last.ckpt")

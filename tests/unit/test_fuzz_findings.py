"""Files that the fuzz campaign found to end in a traceback, in gigabytes or in no answer; each once more, quickly."""

import io
import json
import os
import struct
import tarfile
import tracemalloc
import zipfile
import zlib
from unittest.mock import Mock

import captures
import cv2
import numpy as np
import pytest
import scipy.io
import torch

from dsr.app.entry import run_command
from dsr.app.trust import read_plain_yaml
from dsr.app.upsample.outputs import read_previous_run
from dsr.data.download.fetching import unpack
from dsr.data.tofmark import read_matrices
from dsr.geometry.planes import inverse_votes
from dsr.inference import upsampler
from dsr.io.captures.arkit import find_arkitscenes
from dsr.io.captures.stray import find_stray
from dsr.io.exports import read_input, write_input
from dsr.io.photos import read_photo
from dsr.io.trajectories import read_transform
from dsr.methods.networks.weight_files import is_dsr_weights
from dsr.methods.recipe import read_recipe
from dsr.report.study.answers import files_of
from dsr.report.study.study_table import read_study
from dsr.report.surface_page import is_view
from dsr.utils.arrays import open_array
from dsr.utils.configuration import ConfigError
from dsr.utils.picture_headers import picture_size


def png_chunk(kind, content, length=None):
    size = struct.pack(">I", len(content) if length is None else length)
    return size + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(*between):
    encoded = cv2.imencode(".png", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()
    end_of_header = 8 + 12 + 13
    return encoded[:end_of_header] + b"".join(between) + encoded[end_of_header:]


def test_png_with_a_long_text_is_read_and_one_that_claims_gigabytes_is_not(tmp_path):
    sound = png(png_chunk(b"tEXt", b"comment\0" + b"x" * 5000))
    assert picture_size(io.BytesIO(sound)).height == 48
    claiming = png(png_chunk(b"tEXt", b"comment\0x", length=0x7FFFFFFF))
    assert picture_size(io.BytesIO(claiming)) is None
    path = tmp_path / "photo.png"
    path.write_bytes(claiming)
    with pytest.raises(ValueError, match=r"photo\.png"):
        read_photo(path, (12, 16))


def test_loop_of_links_among_answers_is_one_file_and_no_error(tmp_path):
    (tmp_path / "a.json").symlink_to(tmp_path / "b.json")
    (tmp_path / "b.json").symlink_to(tmp_path / "a.json")
    (tmp_path / "c.json").write_text("{}")
    assert tmp_path / "c.json" in files_of([tmp_path])


@pytest.mark.parametrize("time", ["nan", "inf", "x", "1_0_"])
def test_trajectory_at_a_time_that_is_no_number_is_refused(tmp_path, time):
    captures.arkitscenes(tmp_path)
    path = tmp_path / "lowres_wide.traj"
    lines = path.read_text().splitlines()
    lines[0] = " ".join([time, *lines[0].split()[1:]])
    path.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"lowres_wide\.traj: line 1: expected 7 numbers, got"):
        find_arkitscenes(tmp_path)


def test_odometry_with_a_field_longer_than_a_table_may_have_is_refused(tmp_path):
    captures.stray(tmp_path)
    path = tmp_path / "odometry.csv"
    path.write_text(path.read_text() + "x" * 200_000 + "\n")
    with pytest.raises(ValueError, match=r"odometry\.csv: expected a table of .*field larger than field limit"):
        find_stray(tmp_path)


@pytest.mark.parametrize("kind", ["zip", "tar"])
def test_damaged_lzma_is_a_damaged_archive(tmp_path, kind):
    path = tmp_path / f"data.{kind}"
    if kind == "zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as file:
            file.writestr("depth.png", bytes(range(256)) * 20)
    else:
        with tarfile.open(path, "w:xz") as file:
            file.addfile(tarfile.TarInfo("depth.png"), io.BytesIO())
    content = bytearray(path.read_bytes())
    content[50:80] = bytes(each ^ 0x5A for each in content[50:80])
    path.write_bytes(content)
    with pytest.raises(ValueError, match="expected an archive, got a damaged one"):
        unpack(path, tmp_path / "out", Mock())


def test_zip_whose_member_lies_before_its_start_is_a_damaged_archive(tmp_path):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as file:
        file.writestr("depth.png", b"x" * 100)
    content = bytearray(packed.getvalue())
    place = len(content) - 22 + 16  # of the directory's offset, which zipfile subtracts from the members'
    struct.pack_into("<L", content, place, struct.unpack_from("<L", content, place)[0] + 50)
    path = tmp_path / "data.zip"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"data\.zip: expected an archive, got a damaged one: .*Invalid argument"):
        unpack(path, tmp_path / "out", Mock())
    assert not (tmp_path / "out").exists()


def test_number_of_5000_digits_in_the_file_of_a_method_is_refused(tmp_path):
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "bad.yaml").write_text("iterations: 1" + "0" * 5000)
    with pytest.raises(ConfigError, match=r"bad\.yaml: ") as caught:
        read_recipe("bad", directories=[tmp_path])
    assert len(str(caught.value)) < 1000


def test_method_whose_aliases_stand_for_a_billion_values_is_refused_at_once(tmp_path):
    (tmp_path / "method").mkdir()
    levels = [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 10)]
    (tmp_path / "method" / "bad.yaml").write_text("\n".join(["a0: &a0 [1]", *levels]))
    with pytest.raises(ValueError, match=r"bad\.yaml: expected at most 100000 values, got more by its aliases"):
        read_recipe("bad", directories=[tmp_path])


def test_aliases_of_a_few_values_are_read(tmp_path):
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "good.yaml").write_text("name: good\nfirst: &a [1, 2]\nsecond: *a\n")
    assert read_recipe("good", directories=[tmp_path]).at(4)["second"] == [1, 2]


def test_wrong_value_in_the_file_of_a_method_is_reported_with_the_method(tmp_path):
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "mine.yaml").write_text("defaults: [tgv]\nname: mine\nsharpness: sharp\n")
    with pytest.raises(ValueError, match=r"^method=mine: sharpness: expected a number.*, got 'sharp'$"):
        upsampler("mine", settings={"iterations": 5}, directories=(tmp_path,), device="cpu").first()


@pytest.mark.parametrize("shape", ["(9223372036854775807, 2)", "(-5, 4)", "(4294967296, 4294967296)", "(1e3,)", "(("])
def test_array_of_a_shape_that_no_file_has_is_refused_without_its_memory(tmp_path, shape):
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}"
    path = tmp_path / "depth.npy"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header) + 1) + header.encode() + b"\n" + b"\0" * 64)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"depth\.npy: expected an array, got a damaged or foreign file"):
            open_array(path)
        assert tracemalloc.get_traced_memory()[1] < 5 << 20
    finally:
        tracemalloc.stop()


def test_intensities_beyond_float32_in_a_file_of_tofmark_are_refused_in_one_line(tmp_path, recwarn):
    path = tmp_path / "scene.mat"
    picture = np.full((64, 64), 1e300)
    scipy.io.savemat(path, {"intensity": picture, "depth": np.full((64, 64), 2.0), "samples": np.eye(64)})
    with pytest.raises(ValueError, match=r"scene\.mat: ") as caught:
        read_matrices(path)
    assert "\n" not in str(caught.value)
    assert not recwarn.list


@pytest.mark.parametrize("read", [open_array, read_study, is_dsr_weights, is_view], ids=lambda each: each.__name__)
def test_pipe_that_nobody_writes_to_is_not_waited_for(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises((ValueError, OSError), match="pipe"):
        read(tmp_path / "pipe")


def test_configuration_of_10000_nested_lists_is_refused_at_once(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("model: " + "[" * 10_000 + "]" * 10_000)
    with pytest.raises(ConfigError, match=r"config\.yaml: line 1: expected plain values"):
        read_plain_yaml(path)


@pytest.mark.parametrize("content", ["3.5", "name: tgv\nsharpness: !!set {a, b}\n"])
def test_unusable_file_of_a_method_is_named_by_the_commands(tmp_path, capfd, content):
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "mine.yaml").write_text(content)
    with pytest.raises(SystemExit) as ended:
        run_command("eval", Mock(), ["--config-dir", str(tmp_path), "method=mine"])
    assert ended.value.code == 2
    assert f"{tmp_path}/method/mine.yaml: expected a readable YAML file" in capfd.readouterr().err


@pytest.mark.parametrize("depth", [0.0, 4e-41, 1e12])
def test_stored_input_with_a_depth_out_of_range_is_refused(tmp_path, depth):
    depth_lr = torch.full((1, 4, 4), 2.0)
    depth_lr[0, 1, 2] = depth
    write_input(tmp_path / "input.npz", torch.rand(3, 16, 16), depth_lr)
    with pytest.raises(ValueError, match=r"input\.npz: expected depths of 1e-06 to 1e\+09 m"):
        read_input(tmp_path / "input.npz")


@pytest.mark.parametrize("wrong", [{"files": [1.5]}, {"files": "depth.png"}, {"inputs": {"rgb": 3}}])
def test_record_of_an_earlier_result_with_values_of_other_types_is_refused(tmp_path, wrong):
    entries = {"complete": True, "settings": {}, "inputs": {}, "files": ["depth.png"], **wrong}
    (tmp_path / "info.json").write_text(json.dumps(entries))
    with pytest.raises(ValueError, match=r"info\.json: expected a file of `dsr upsample`, got something else"):
        read_previous_run(tmp_path)


@pytest.mark.filterwarnings("error")
def test_translation_of_1e308_metres_is_refused_without_a_warning_of_overflow(tmp_path):
    shift = np.eye(4)
    shift[0, 3] = -1e308
    np.savetxt(tmp_path / "extrinsics.txt", shift)
    with pytest.raises(ValueError, match=r"extrinsics\.txt: expected a translation in metres, got one of 1e\+308"):
        read_transform(tmp_path / "extrinsics.txt")


@pytest.mark.filterwarnings("error")
def test_distance_of_1e_minus_310_is_looked_at_without_a_warning_of_overflow():
    values = np.add.outer(np.linspace(1, 2, 48), np.linspace(0, 1, 64))
    usual = inverse_votes(values)
    values[5, 5] = 1e-310
    assert inverse_votes(values).verdict == usual.verdict


def test_heic_file_of_gigabytes_is_not_read_for_its_exif_data(tmp_path):
    path = tmp_path / "photo.heic"
    with path.open("wb") as file:
        file.truncate(3 << 30)
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"photo\.heic"):
        read_photo(path, (12, 16))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1 << 20


def test_archive_with_a_file_without_a_name_is_refused(tmp_path):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as packed:
        packed.writestr("abc", b"depth")
    (tmp_path / "set.zip").write_bytes(nameless(content.getvalue()))
    with pytest.raises(ValueError, match=r"set\.zip: refused"):
        unpack(tmp_path / "set.zip", tmp_path / "out", lambda *_, **__: None)


def nameless(content):
    """Take the name `abc` off the central directory's only entry of an archive."""
    entry = content.index(b"PK\x01\x02")
    end = content.index(b"PK\x05\x06")
    directory = bytearray(content[entry : entry + 46] + content[entry + 49 : end])
    struct.pack_into("<H", directory, 28, 0)
    tail = bytearray(content[end:])
    struct.pack_into("<I", tail, 12, len(directory))
    return content[:entry] + bytes(directory) + bytes(tail)

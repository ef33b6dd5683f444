"""Damaged, wrong and hostile files end with one line that names the file: a table of readers and damages."""

import functools
import io
import json
import math
import os
import re
import resource
import sys
import zipfile
from unittest.mock import Mock

import bombs
import captures
import cv2
import h5py
import numpy as np
import pytest
import safetensors.torch
import scipy.io
import torch
from single_files import READERS, read_capture, read_picture_file
from small_results import write_result

from dsr.app.upsample.outputs import ResultFolder
from dsr.app.upsample.parts import Results
from dsr.app.upsample.stored import read_exports, read_info, read_result
from dsr.data import matlab
from dsr.data.download.fetching import Checksums, unpack
from dsr.data.folder import Folder
from dsr.data.matlab import read_variables
from dsr.evaluation.results import load_errors, load_prediction, prediction_path, sample_path
from dsr.evaluation.run_files import load_results, read_run
from dsr.geometry.camera import Camera
from dsr.io.captures.record3d import read_archive
from dsr.io.depth_files import read_depth_file
from dsr.io.exports import read_input, write_input
from dsr.io.inputs import read_picture
from dsr.io.pairs import Pair
from dsr.io.reading import Reading
from dsr.methods.networks.peers import read_tensors
from dsr.methods.networks.trained import NETWORKS, load_msg_weights
from dsr.methods.networks.weight_files import is_dsr_weights, load_network
from dsr.methods.recipe import read_recipe
from dsr.methods.weights import packaged_weights
from dsr.report.study.files import files_of
from dsr.report.study.percentages import read_study
from dsr.report.surface_page import is_view
from dsr.sample import DepthSample
from dsr.utils import guards
from dsr.utils.arrays import read_arrays
from dsr.utils.console import one_line, print_error, printable
from dsr.utils.guards import TooLargeError, is_number, parse_json, read_limited

HUGE = "1" + "0" * 400
NO_NUMBERS = ("true", "Infinity", HUGE, '"4"', "[]")  # as JSON; a float holds none of them
DEEP = "[" * 100_000
MOST = 450 << 20  # growth of memory in bytes while a file is refused


def refusal(path, read, *arguments):
    """Return why a file is refused, in one line without its name."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the callers look at the message
        read(*arguments)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 600 + len(str(path))
    return message.replace(str(path), "")


# Files that declare or unpack to gigabytes


@pytest.fixture
def limited():
    """Limit this process to ``MOST`` bytes more than it has, as commands limit theirs."""
    with bombs.limited_memory(MOST):
        yield


BOMBS = [
    (bombs.npz, "x.npz", read_depth_file),
    (bombs.npz, "x.npz", load_prediction),
    (bombs.npy_sparse, "x.npy", read_depth_file),
    (bombs.png, "x.png", read_depth_file),
    (bombs.jpeg, "x.jpg", read_picture_file),
    (bombs.tiff, "x.tiff", read_depth_file),
    (bombs.mat73, "x.mat", read_variables),
    (bombs.r3d, "x.r3d", read_capture),
]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return a function that writes a bomb once, however many readers are tested with it."""

    @functools.cache
    def write_once(write):
        path = tmp_path_factory.mktemp("bombs") / "bomb"
        write(path)
        return path

    return write_once


@pytest.mark.skipif(sys.platform != "linux", reason="needs limits of memory")
@pytest.mark.parametrize(("write", "name", "read"), BOMBS)
def test_bomb_is_refused_in_one_line_and_little_memory(tmp_path, limited, written, write, name, read):
    (tmp_path / name).hardlink_to(written(write))
    assert "expected" in refusal(tmp_path / name, read, tmp_path / name)


def test_archive_of_arrays_is_not_unpacked_to_more_than_its_size_explains(written):
    with pytest.raises(TooLargeError, match="expected at most 268435456 bytes"):
        read_arrays(written(bombs.npz))


@pytest.mark.skipif(sys.platform != "linux", reason="needs limits of memory")
def test_command_limits_its_memory_to_that_of_the_machine_or_of_its_container(tmp_path, monkeypatch):
    physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    set_limits = []
    monkeypatch.setattr(resource, "setrlimit", lambda kind, limits: set_limits.append(limits[0]))
    (tmp_path / "memory.max").write_text("max\n")
    monkeypatch.setattr(guards, "_CONTAINER", (str(tmp_path / "memory.max"), str(tmp_path / "nowhere")))
    guards.limit_memory()
    (tmp_path / "memory.max").write_text(f"{100 << 20}\n")
    guards.limit_memory()
    assert 100 << 20 < set_limits[0] <= physical
    assert set_limits[1] == 100 << 20
    with pytest.raises(guards.OutOfMemoryError, match="patch: expected less"):
        guards.expect_memory("patch", 4, 200 << 20)


def test_depth_map_may_not_be_much_larger_than_its_photo(tmp_path, limited, written):
    cv2.imwrite(str(tmp_path / "rgb.png"), np.zeros((64, 64, 3), np.uint8))
    (tmp_path / "d.png").hardlink_to(written(bombs.png_of_16_megapixels))
    with pytest.raises(TooLargeError, match=r"d\.png: expected at most"):
        read_picture(Pair("x", tmp_path / "rgb.png", tmp_path / "d.png"), Reading())


@pytest.mark.parametrize("arguments", [{"scale": 4, "width": 4000}, {"scale": 4, "blocks": 10**9}])
def test_weights_that_ask_for_more_than_their_file_holds_are_refused(tmp_path, limited, arguments):
    header = {"format": 1, "network": "FacetsUNet", "arguments": arguments, "model": "facets", "facts": {}}
    with safetensors.safe_open(packaged_weights("facets_x4"), framework="pt") as file:
        [key] = file.metadata()
        header["format"] = json.loads(file.metadata()[key])["format"]
    path = tmp_path / "w.safetensors"
    safetensors.torch.save_file({"a": torch.zeros(4)}, path, {key: json.dumps(header)})
    assert ": expected" in refusal(path, load_network, path, NETWORKS)


def test_large_texts_of_a_run_are_refused_unread(tmp_path):
    (tmp_path / "versions.json").write_text("{}")
    with (tmp_path / "summary.json").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(ValueError, match=r"summary\.json: expected at most 16777216 bytes, got 1099511627776"):
        read_run(tmp_path)


@pytest.mark.parametrize("read", [read_limited, read_study, is_dsr_weights, is_view])
def test_pipe_that_nobody_writes_to_is_not_waited_for(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises((ValueError, OSError), match="pipe"):
        read(tmp_path / "pipe")


# Readers and damages


DAMAGES = {
    "missing": None,
    "pipe": None,
    "empty": lambda _: b"",
    "text": lambda _: b"neither numbers nor a picture",
    "zeros": lambda _: bytes(200),
    "head": lambda content: content[: len(content) // 4],
    "half": lambda content: content[: len(content) // 2],
    "without end": lambda content: content[: int(0.95 * len(content))],
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", READERS)
def test_damaged_file_is_refused_in_one_line_that_names_it_and_nothing_is_printed(tmp_path, name, damage, capfd):
    path, (write, read) = tmp_path / name, READERS[name]
    write(path)
    read(path)
    if name == "photo.jpg" and damage in ("half", "without end"):  # of which OpenCV shows what there is
        return
    content = path.read_bytes()
    path.unlink()
    if damage == "pipe":
        os.mkfifo(path)
    elif damage != "missing":
        path.write_bytes(DAMAGES[damage](content))
    capfd.readouterr()
    with pytest.raises((ValueError, OSError)) as caught:
        read(path)
    said = one_line(caught.value)
    assert str(path) in said
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


# JSON whose values are none


def replaced(text, key, value):
    """Return a JSON text with another value of a key, as text."""
    changed = re.sub(rf'"{key}": ("[^"]*"|\[[^\]]*\]|[-\d.e]+)', lambda _: f'"{key}": {value}', text, count=1)
    assert changed != text
    return changed


@pytest.mark.parametrize("value", NO_NUMBERS)
def test_value_of_a_result_that_is_no_number_is_refused_by_its_file(tmp_path, value):
    path = write_result(tmp_path / "a") / "info.json"
    path.write_text(replaced(path.read_text(), "fx", value))
    assert "expected" in refusal(path, read_result, path.parent, "a")


@pytest.mark.parametrize(("key", "value"), [("w", True), ("K", [True] * 9), ("poses", [["60"] * 7])])
def test_metadata_of_record3d_with_a_value_that_is_no_number_are_refused(tmp_path, key, value):
    captures.record3d(tmp_path / "scan.r3d", **{key: value})
    assert key in refusal(tmp_path / "scan.r3d", read_archive, tmp_path / "scan.r3d")


RECORDS = [
    *(("info.json", read_info, text) for text in (
        "[]", "5", "{", DEEP, HUGE, '{"complete": true, "settings": 5}', '{"complete": true, "files": [1.5]}',
        '{"complete": true, "inputs": {"rgb": 3}}')),
    *(("exports.json", read_exports, text) for text in ("[]", '{"exports": 5}', '{"exports": {"a": [5]}}')),
    *(("checksums.json", Checksums, json.dumps({"set/a.zip": {"sha256": "0" * 64, "size": 1, **entry}})) for entry in (
        {"size": -1}, {"size": 1.5}, {"sha256": "0" * 63}, {"files": {"C:\\x": 1}}, {"files": {"a": True}})),
]  # fmt: skip


@pytest.mark.parametrize(("name", "read", "text"), RECORDS)
def test_record_of_earlier_files_that_is_none_is_refused(tmp_path, name, read, text):
    (tmp_path / name).write_text(text)
    refusal(tmp_path / name, read, tmp_path)


@pytest.mark.parametrize("text", ["NaN", "-Infinity", "[1e999]", "9" * 5000, DEEP, "{", ""])
def test_json_with_what_is_no_json_is_refused(text):
    with pytest.raises(ValueError):  # noqa: PT011 - of many kinds
        parse_json(text)
    assert math.isnan(parse_json("NaN", finite=False))


@pytest.mark.parametrize("value", [True, np.bool_(True), 10**400, math.inf, math.nan, "1", None])
def test_number_is_finite_and_no_boolean(value):
    assert not is_number(value)
    assert is_number(np.float32(2))
    assert is_number(np.int64(2))


# The files of a run


def with_identity(**entries):
    def change(text):
        stored = json.loads(text)
        return json.dumps({**stored, "identity": {**stored["identity"], **entries}})

    return change


def with_text(old, new):
    return lambda text: re.sub(old, lambda _: new, text)


def with_column(name, value):
    def change(text):
        head, *rows = (line.split(",") for line in text.splitlines())
        rows = [[value if column == name else cell for column, cell in zip(head, row, strict=True)] for row in rows]
        return "\n".join(",".join(row) for row in (head, *rows)) + "\n"

    return change


DAMAGED_RUNS = [
    *(("summary.json", with_text(r'"scale": \d+', f'"scale": {value}')) for value in (*NO_NUMBERS, "0", "0.5")),
    *(("summary.json", with_text(r'"seed": \d+', f'"seed": {value}')) for value in (*NO_NUMBERS, "-1", "0.5")),
    *(("summary.json", with_text(r"0\.25", value)) for value in (*NO_NUMBERS, "-1")),
    ("summary.json", with_text(r'"label": "\w+"', '"label": 0.5')),
    ("summary.json", with_text(r"^{", '{"metrics": {"RMSE_d": {"heading": "a", "factor": Infinity}}, ')),
    *((name, lambda _, content=content: content) for name, content in (
        ("summary.json", "{"), ("summary.json", "[]"), ("summary.json", "{}"), ("versions.json", "x"),
        ("scores.csv", "a,b\n1,2\n"), ("scores.csv", ""))),
    *(("versions.json", with_identity(dataset=value)) for value in (5, ["a"], None)),
    ("versions.json", with_identity(method="x")),
    ("versions.json", lambda _: '{"identity": ' + DEEP),
    *(("scores.csv", with_column("scale", value)) for value in ("inf", "true", "-4", "x")),
    *(("scores.csv", with_column("seed", value)) for value in ("1e30", "true", "-1", "")),
    *(("scores.csv", with_column("value", value)) for value in ("true", "x", "1e308")),
]  # fmt: skip


@pytest.fixture
def runs(make_run, tmp_path):
    """A folder of two runs, ``fine`` and ``damaged``, neither of which is damaged yet."""
    for name, label in (("fine", "Bicubic"), ("damaged", "MSG")):
        make_run(tmp_path / name, label=label, scenes=("s",))
    return tmp_path


@pytest.mark.parametrize(("name", "change"), DAMAGED_RUNS)
def test_damaged_run_is_left_out_with_a_line_and_the_others_are_read(runs, name, change):
    path = runs / "damaged" / name
    before = path.read_text()
    path.write_text(change(before))
    assert path.read_text() != before
    results = load_results([runs])
    assert results.methods() == ["Bicubic"]
    assert [str(path) in note for note in results.notes] == [True]


@pytest.mark.parametrize("change", [
    lambda depth: depth[:-3], lambda depth: depth > 2, lambda depth: depth.astype(int), lambda depth: depth[None],
])  # fmt: skip
def test_prediction_of_another_size_or_type_is_left_out_with_its_scores(runs, change):
    path = prediction_path(runs / "damaged", "s")
    depth = load_prediction(path)[0].numpy()
    np.savez(path, depth=change(depth), config="{}", seconds=1.0)
    results = load_results([runs])
    assert set(results.scores["label"]) == {"Bicubic"}
    (note,) = results.notes
    assert note.startswith(f"left out: {path}: expected")


@pytest.mark.parametrize("values", [
    np.ones((4, 4), bool), np.ones((1, 4, 4)), np.array([{}, None]), np.ones((4, 4), np.longdouble),
    np.ones((4, 4), ">f8"),
])  # fmt: skip
def test_arrays_that_are_no_maps_of_floats_are_no_prediction(tmp_path, values):
    path = tmp_path / "a.npz"
    np.savez(path, depth=values, depth_error=values, angle_error=values)
    refusal(path, load_prediction, path)
    refusal(path, load_errors, path)


@pytest.mark.parametrize("value", [*(each for each in NO_NUMBERS if each != '"4"'), '"four"', "0", "0.5"])
def test_stored_scene_with_a_scale_that_is_none_is_refused(runs, value):
    path = sample_path(runs / "fine", "s")
    with np.load(path) as stored:
        arrays = dict(stored)
    np.savez(path, **{**arrays, "about": replaced(str(arrays["about"]), "scale", value)})
    refusal(path, DepthSample.load, path)


@pytest.mark.parametrize(("content", "reason"), [
    (b"3.5", ""), (b"name: tgv\nsharpness: !!set {a, b}\n", ""), (b"a: \x83", "UnicodeDecodeError"),
    (b"[" * 1000, "RecursionError"),
])  # fmt: skip
def test_unusable_file_of_a_method_is_named(tmp_path, content, reason):
    path = tmp_path / "method" / "mine.yaml"
    path.parent.mkdir()
    path.write_bytes(content)
    assert reason in refusal(path, lambda: read_recipe("mine", directories=[tmp_path]))


# Maps, weights, archives and captures


FLOATS = np.full((4, 4), 2, np.float32)


@pytest.mark.parametrize("content", [
    {"other": FLOATS}, {"depth_lr": FLOATS.astype(float)}, {"photo": np.frombuffer(b"\xff\xd8 none", np.uint8)},
    *({"depth_lr": np.where(np.eye(4) == 1, FLOATS, np.float32(depth))} for depth in (0.0, 4e-41, 1e12)),
])  # fmt: skip
def test_something_else_than_the_input_beside_a_result_is_refused(tmp_path, content):
    path = tmp_path / "input.npz"
    write_input(path, torch.rand(3, 16, 16), torch.from_numpy(FLOATS)[None])
    np.savez(path, **{**read_arrays(path), **content})
    assert ": expected" in refusal(path, read_input, path)


@pytest.mark.parametrize("damage", [lambda data: data[:40], lambda data: data[:-200], lambda _: b""])
def test_damaged_depth_of_an_earlier_result_is_made_again_and_refused_where_it_is_read(tmp_path, damage):
    folder = write_result(tmp_path / "a")
    path = folder / "depth_metres.tiff"
    path.write_bytes(damage(path.read_bytes()))
    stored = ResultFolder(folder, {}, {}, Results(output=folder))
    assert stored.surface(Camera(64, 64, 80.0, 80.0, 31.0, 32.5), errors=False) is None
    assert ": expected" in refusal(path, read_result, folder, "a")


@pytest.mark.parametrize("tensor", [torch.ones(2, 3, device="meta"), torch.eye(3).to_sparse()])
def test_weights_without_plain_values_are_refused(tmp_path, tensor):
    path = tmp_path / "net.pth"
    torch.save({"a": tensor}, path)
    assert "expected a torch file" in refusal(path, read_tensors, path)
    torch.save({"model_state_dict": {"a": tensor}}, path)
    assert "expected a torch file" in refusal(path, load_msg_weights, path, 4)


def external(file, secret):
    file.create_dataset("depth", (4, 4), "f8", external=[(str(secret), 0, 128)])


def linked(file, secret):
    file["depth"] = h5py.ExternalLink(str(secret), "/secret")


@pytest.mark.parametrize("fill", [external, linked])
def test_matrix_of_another_file_is_not_read(tmp_path, fill):
    (tmp_path / "secret").write_bytes(np.ones(16).tobytes())
    with h5py.File(tmp_path / "x.mat", "w") as file:
        fill(file, tmp_path / "secret")
    assert refusal(tmp_path / "x.mat", read_variables, tmp_path / "x.mat")


def test_old_matrices_are_not_unpacked_to_more_than_a_file_may_have(tmp_path, monkeypatch):
    path = tmp_path / "x.mat"
    scipy.io.savemat(path, {name: np.zeros(600) for name in "abc"}, do_compression=True)
    assert len(read_variables(path)) == 3
    monkeypatch.setattr(matlab, "_LARGEST", 1500)
    assert "a compressed variable without end, or too large" in refusal(path, read_variables, path)


@pytest.mark.parametrize(("name", "old", "new"), [
    ("", b"", b""), ("\u00fcc", "\u00fc".encode(), b"\xcf\x20"),
    ("c", (131).to_bytes(4, "little"), (181).to_bytes(4, "little")),  # the member lies before the file's start
    ("c", bytes((20, 0, 0, 0)), bytes((20, 0, 1, 0))),  # it needs a password
])  # fmt: skip
def test_archive_with_a_member_that_cannot_be_read_is_refused_and_nothing_unpacked(tmp_path, name, old, new):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as file:
        file.writestr(zipfile.ZipInfo(name), b"x" * 100)
    path = tmp_path / "data.zip"
    path.write_bytes(packed.getvalue().replace(old, new))
    refusal(path, unpack, path, tmp_path / "out", Mock())
    assert not (tmp_path / "out").exists()


def test_name_that_is_not_utf8_is_refused_unless_other_scenes_are_named(tmp_path):
    for name in (b"bad\xff", b"good"):
        (tmp_path / name.decode(errors="surrogateescape")).mkdir()
    with pytest.raises(ValueError, match=r"^scenes: expected names in UTF-8, got 'bad\\udcff'"):
        Folder(str(tmp_path))
    assert Folder(str(tmp_path), ["good"]).scenes() == ["good"]


def test_loop_of_links_among_answers_is_one_file_and_no_error(tmp_path):
    (tmp_path / "a.json").symlink_to(tmp_path / "b.json")
    (tmp_path / "b.json").symlink_to(tmp_path / "a.json")
    (tmp_path / "c.json").write_text("{}")
    assert tmp_path / "c.json" in files_of([tmp_path])


def test_printable_replaces_what_controls_a_terminal_or_turns_text():
    assert printable("a\x1b[2Jb\x00\x85\u202e").replace("\N{REPLACEMENT CHARACTER}", "#") == "a#[2Jb###"
    assert printable("Küche 日本 \u200d\n") == "Küche 日本 \u200d\n"


def test_long_message_keeps_the_name_at_its_beginning_and_its_end(capsys):
    print_error(f"/data/camera.json: expected a number, got {'9' * 10_000} at the end")
    line = capsys.readouterr().err
    assert len(line) <= len("\n") + 1000
    assert line.startswith("error: /data/camera.json: expected a number, got 999")
    assert line.endswith("9 at the end\n")
    assert one_line(ValueError("short\nmes\x1bsage\u202e")) == "short mes#sage#".replace(
        "#", "\N{REPLACEMENT CHARACTER}"
    )
    print_error("a\x1b]0;title\x07b\x9bc\nd")
    assert capsys.readouterr().err == "error: a#]0;title#b#c d\n".replace("#", "\N{REPLACEMENT CHARACTER}")

"""What is no number, no map and no text in other people's files is refused in one line that names the file."""

import json
import math
import re

import captures
import cv2
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from small_results import SIZE, write_result

from dsr.app.training_runs import read_config
from dsr.app.upsample.outputs import kept_surface, read_previous_run
from dsr.app.upsample.scene import _read_record
from dsr.app.upsample.stored import read_result
from dsr.data.download.fetching import Checksums
from dsr.data.folder import Folder, load_scene
from dsr.evaluation.run_files import load_results
from dsr.evaluation.store import load_errors, load_prediction, prediction_path, sample_path
from dsr.geometry.camera import Camera
from dsr.io.cameras import read_any_camera
from dsr.io.captures.arkit import find_polycam
from dsr.io.captures.record3d import find_record3d
from dsr.io.images import read_camera
from dsr.io.trajectories import read_transform
from dsr.methods.networks.peers.peer_network import read_tensors
from dsr.methods.networks.trained import read_msg_weights
from dsr.report.study.answers import read_all
from dsr.report.study.key import Candidate, Key, Trial, read_key, write_key
from dsr.sample import FARTHEST, NEAREST, DepthSample, Scene
from dsr.utils.configuration import ConfigError
from dsr.utils.console import one_line, print_error
from dsr.utils.guards import is_number, parse_json, readable

HUGE = "1" + "0" * 400
NO_NUMBERS = ("true", "Infinity", "-Infinity", "NaN", HUGE, "1e400", '"4"', "[]", "null", "{}")
EYE = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, {}, 0]]"
CANDIDATES = {name: Candidate(name, name, "runs") for name in ("a", "b")}
KEY = Key("0123", "e4", 1, 0, {"s1": Trial("simgeo", "cube", 4, "box", CANDIDATES)})


def refusal(path, read, *arguments):
    """Return why a file is refused, without its name."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the callers look at the message
        read(*arguments)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 600 + len(str(path))
    return message.replace(str(path), "")


def camera_text(key="cx", value="31.5"):
    entries = {"width": "64", "height": "48", "fx": "60", "fy": "60", "cx": "31.5", "cy": "23.5", key: value}
    return "{" + ", ".join(f'"{name}": {text}' for name, text in entries.items()) + "}"


@pytest.mark.parametrize("value", [text for text in NO_NUMBERS if text != "null"])
@pytest.mark.parametrize("key", ["width", "fx", "cy", "baseline", "doffs", "depth_unit", "hole_value"])
def test_key_of_a_camera_file_that_is_no_number_is_refused(tmp_path, key, value):
    path = tmp_path / "camera.json"
    path.write_text(camera_text(key, value))
    assert refusal(path, read_camera, path).startswith(f": {key}: expected ")


@pytest.mark.parametrize("value", NO_NUMBERS)
@pytest.mark.parametrize("key", ["width", "intrinsic_matrix"])
def test_key_of_a_camera_of_open3d_that_is_no_number_is_refused(tmp_path, key, value):
    path = tmp_path / "camera.json"
    values = {"width": "64", "height": "48", "intrinsic_matrix": "[60, 0, 0, 0, 60, 0, 31.5, 23.5, 1]"}
    values[key] = value if key == "width" else f"[{value}, 0, 0, 0, 60, 0, 31.5, 23.5, 1]"
    path.write_text("{" + ", ".join(f'"{name}": {text}' for name, text in values.items()) + "}")
    assert refusal(path, read_any_camera, path).startswith(": ")


@pytest.mark.parametrize("value", [True, 10**400, math.nan, "60", None])
@pytest.mark.parametrize("field", ["width", "fx", "cx", "doffs"])
def test_camera_of_values_that_are_no_numbers_is_refused(field, value):
    fields = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, field: value}
    with pytest.raises(ValueError, match=f"^camera {field}: expected "):
        Camera(**fields)


@pytest.mark.parametrize("value", [text for text in NO_NUMBERS if text != "1e400"])
def test_transform_with_an_entry_that_is_no_number_is_refused(tmp_path, value):
    path = tmp_path / "ir_to_rgb.json"
    path.write_text(EYE.format(value))
    refusal(path, read_transform, path)
    path.write_text(EYE.format("1"))
    assert read_transform(path).shape == (4, 4)


@pytest.mark.parametrize("value", [True, "60"])
@pytest.mark.parametrize("key", ["w", "K", "poses"])
def test_metadata_of_record3d_with_a_value_that_is_no_number_are_refused(tmp_path, key, value):
    own = captures.record3d_metadata()
    changed = {"w": value, "K": [value, *own["K"][1:]], "poses": [[value, *own["poses"][0][1:]], *own["poses"][1:]]}
    captures.record3d(tmp_path / "scan.r3d", **{key: changed[key]})
    assert f"{key}" in refusal(tmp_path / "scan.r3d", find_record3d, tmp_path)


@pytest.mark.parametrize("value", NO_NUMBERS)
@pytest.mark.parametrize("key", ["width", "fx", "t_12"])
def test_camera_of_polycam_with_a_value_that_is_no_number_is_refused(tmp_path, key, value):
    captures.polycam(tmp_path)
    pair = find_polycam(tmp_path).pairs[0]
    path = pair.capture.description
    entries = {name: json.dumps(each) for name, each in json.loads(path.read_text()).items()} | {key: value}
    path.write_text("{" + ", ".join(f'"{name}": {text}' for name, text in entries.items()) + "}")
    refusal(path, pair.capture.geometry, (8, 8))


@pytest.mark.parametrize("value", ["false", "true", "-1", "1.5", '"1"', "null", HUGE, "NaN"])
@pytest.mark.parametrize("place", ["size", "files"])
def test_checksums_with_a_size_that_is_none_are_refused(tmp_path, place, value):
    path = tmp_path / "checksums.json"
    sizes = {"size": "1", "files": "1", place: value}
    entry = f'{{"sha256": "{"0" * 64}", "size": {sizes["size"]}, "files": {{"a": {sizes["files"]}}}}}'
    path.write_text(f'{{"set/a.zip": {entry}}}')
    assert "expected the checksums of the data sets" in refusal(path, Checksums, tmp_path)


@pytest.mark.parametrize("digest", ["x" * 64, "0" * 63, 5])
def test_checksums_with_a_digest_that_is_none_are_refused(tmp_path, digest):
    path = tmp_path / "checksums.json"
    path.write_text(json.dumps({"a": {"sha256": digest, "size": 1}}))
    refusal(path, Checksums, tmp_path)


STUDY_KEYS = [
    *(("repeat", text) for text in ("Infinity", HUGE, "true", "-1", "0.5")),
    *(("scale", text) for text in ("Infinity", HUGE, "true", "-4", "0")),
    *(("scenes_per_person", text) for text in ("true", "0", "1e400")),
    ("page", "true"), ("page", '"1"'), ("label", "0.5"),
]  # fmt: skip


@pytest.mark.parametrize(("key", "value"), STUDY_KEYS)
def test_key_of_a_study_with_a_value_that_is_none_is_refused(tmp_path, key, value):
    path = tmp_path / "key.json"
    write_key(path, KEY)
    assert read_key(path) == KEY
    path.write_text(re.sub(rf'"{key}": ("[^"]*"|\d+)', f'"{key}": {value}', path.read_text()))
    assert f"{key}: expected" in refusal(path, read_key, path)


@pytest.mark.parametrize("value", [*NO_NUMBERS, "-1", "1e300", "[" * 100_000])
def test_answers_with_a_time_that_is_none_are_left_out_and_the_others_count(tmp_path, value):
    trial = {"scene": "s1", "again": False, "order": ["a", "b"], "first": "a", "second": "b", "ms": 5000}
    about = {"study": KEY.study, "page": 1, "finished": "2024-05-01T12:00:00Z", "trials": [trial]}
    files = [tmp_path / f"{person}.json" for person in ("x", "y")]
    for file in files:
        file.write_text(json.dumps({**about, "participant": file.stem}))
    files[0].write_text(files[0].read_text().replace("5000", value))
    accepted, rejected = read_all(files, KEY)
    assert [each.participant for each in accepted] == ["y"]
    assert len(rejected) == 1
    assert str(files[0]) in rejected[0]


def with_text(old, new):
    return lambda text: re.sub(old, lambda _: new, text)


def with_identity(**entries):
    def change(text):
        stored = json.loads(text)
        return json.dumps({**stored, "identity": {**stored["identity"], **entries}})

    return change


def with_column(name, value):
    def change(text):
        head, *rows = (line.split(",") for line in text.splitlines())
        rows = [[value if column == name else cell for column, cell in zip(head, row, strict=True)] for row in rows]
        return "\n".join(",".join(row) for row in (head, *rows)) + "\n"

    return change


DAMAGED_RUNS = [
    *(("summary.json", with_text(r'"scale": \d+', f'"scale": {value}')) for value in (*NO_NUMBERS, "0", "-3", "0.5")),
    *(("summary.json", with_text(r'"seed": \d+', f'"seed": {value}')) for value in (*NO_NUMBERS, "-1", "0.5")),
    *(("summary.json", with_text(r"0\.25", value)) for value in (*NO_NUMBERS, "-1")),
    ("summary.json", with_text(r'"label": "\w+"', '"label": 0.5')),
    ("summary.json", with_text(r"^{", '{"metrics": {"RMSE_d": {"heading": "a", "factor": Infinity}}, ')),
    ("summary.json", with_text(r"^{", '{"metrics": {"RMSE_d": {"heading": "a", "digits": 1000000}}, ')),
    *(("versions.json", with_identity(dataset=value)) for value in (5, ["a"], None, "x", True)),
    *(("versions.json", with_identity(method=value)) for value in (5, ["a"], "x")),
    ("versions.json", lambda _: '{"identity": ' + "[" * 100_000),
    *(("scores.csv", with_column("scale", value)) for value in ("inf", "nan", "true", "0", "-4", "x")),
    *(("scores.csv", with_column("seed", value)) for value in ("inf", "1e30", "true", "-1", "")),
    *(("scores.csv", with_column("value", value)) for value in ("true", "x")),
]  # fmt: skip


_TWO_RUNS = {}
"""The files of two runs, which are written once."""


@pytest.fixture
def runs(make_run, tmp_path_factory, tmp_path):
    """Return the folder of two runs, ``fine`` and ``damaged``, neither of which is damaged yet."""
    if not _TWO_RUNS:
        folder = tmp_path_factory.mktemp("runs")
        for name, label in (("fine", "Bicubic"), ("damaged", "MSG")):
            make_run(folder / name, label=label, scenes=("s",))
        found = (path for path in folder.rglob("*") if path.is_file())
        _TWO_RUNS.update({path.relative_to(folder): path.read_bytes() for path in found})
    for path, content in _TWO_RUNS.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(content)
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


UNFIT = {
    "size": (lambda depth: depth[:-3], "expected depth of the photo's 32 x 32 pixels, got 29 x 32"),
    "bool": (lambda depth: depth > 2, "expected floating point depth (height x width), got bool of shape (32, 32)"),
    "whole": (lambda depth: depth.astype(np.int64), "got int64 of shape (32, 32)"),
    "layers": (lambda depth: depth[None], "got float64 of shape (1, 32, 32)"),
}


@pytest.mark.parametrize("case", UNFIT)
def test_prediction_of_another_size_or_type_is_left_out_with_its_scores(runs, case):
    change, message = UNFIT[case]
    path = prediction_path(runs / "damaged", "s")
    depth = load_prediction(path)[0].numpy()
    np.savez(path, depth=change(depth), config="{}", seconds=1.0)
    results = load_results([runs])
    assert results.methods() == ["Bicubic"]
    assert set(results.scores["label"]) == {"Bicubic"}
    (note,) = results.notes
    assert note.startswith(f"left out: {path}: ")
    assert message in note


@pytest.mark.parametrize("values", [np.ones((4, 4), bool), np.ones((1, 4, 4)), np.ones((4, 4), np.int32)])
def test_arrays_that_are_no_maps_of_floats_are_no_prediction(tmp_path, values):
    path = tmp_path / "a.npz"
    np.savez(path, depth=values, depth_error=values, angle_error=values)
    refusal(path, load_prediction, path)
    refusal(path, load_errors, path)


@pytest.mark.parametrize("value", [*NO_NUMBERS, "0", "0.5"])
def test_stored_scene_with_a_scale_that_is_none_is_refused(runs, value):
    path = sample_path(runs / "fine", "s")
    with np.load(path) as stored:
        arrays = dict(stored)
    if value == '"4"':  # a text of a number was written by no version
        value = '"four"'
    arrays["about"] = re.sub(r'"scale": \d+', lambda _: f'"scale": {value}', str(arrays["about"]))
    np.savez(path, **arrays)
    refusal(path, DepthSample.load, path)


@pytest.fixture
def scene_folder(tmp_path):
    """Return a scene's folder; its depth is still to be written."""
    folder = tmp_path / "scene"
    folder.mkdir()
    cv2.imwrite(str(folder / "rgb.png"), np.zeros((8, 8, 3), np.uint8))
    entries = {"width": 8, "height": 8, "fx": 9, "fy": 9, "cx": 3.5, "cy": 3.5, "baseline": 0.1}
    (folder / "camera.json").write_text(json.dumps(entries))
    return folder


@pytest.mark.parametrize("value", [1e19, 1e10, 1e-9, 1e-317])
def test_depth_that_is_no_distance_is_refused_where_a_scene_enters(scene_folder, value):
    path = scene_folder / "depth.npy"
    np.save(path, np.where(np.eye(8) == 1, value, 2.0))
    said = refusal(path, load_scene, scene_folder, "folder")
    assert said.startswith(f": expected depths of 1e-06 to 1e+09 m, got {value:g} m in 12.50% of the pixels")


def test_disparity_that_is_no_distance_is_refused_where_a_scene_enters(scene_folder):
    path = scene_folder / "disparity.npy"
    np.save(path, np.where(np.eye(8) == 1, 1e-12, 2.0))
    assert "got 9e+11 m in 12.50% of the pixels" in refusal(path, load_scene, scene_folder, "folder")


@pytest.mark.parametrize("value", [NEAREST, FARTHEST])
def test_depths_up_to_the_limits_are_those_of_a_scene(value):
    camera = Camera(4, 4, 5.0, 5.0, 1.5, 1.5)
    scene = Scene("set", "a", torch.zeros(3, 4, 4), camera, torch.full((1, 4, 4), value, dtype=torch.float64))
    assert float(scene.depth[0, 0, 0]) == value


def test_name_that_is_not_utf8_is_refused_unless_other_scenes_are_named(tmp_path):
    for name in (b"bad\xff", b"good"):
        (tmp_path / readable_path(name)).mkdir()
    with pytest.raises(ValueError, match=r"^scenes: expected names in UTF-8, got 'bad\\udcff'; rename it"):
        Folder(str(tmp_path))
    assert Folder(str(tmp_path), ["good"]).scenes() == ["good"]


def readable_path(name):
    return name.decode(errors="surrogateescape")


def test_name_that_is_not_utf8_is_shown_with_escapes():
    assert readable("bad\udcff ä") == "bad\\udcff ä"


@pytest.mark.parametrize("damage", [
    lambda data: data[:40], lambda data: data[:-200], lambda _: b"", lambda data: data[:8] + b"\xff" * 300,
])  # fmt: skip
def test_damaged_depth_of_an_earlier_result_is_made_again_and_refused_where_it_is_read(tmp_path, damage):
    folder = write_result(tmp_path / "a")
    path = folder / "depth_metres.tiff"
    camera = Camera(SIZE, SIZE, 80.0, 80.0, 31.0, 32.5)
    path.write_bytes(damage(path.read_bytes()))
    assert kept_surface(folder, camera, errors=False) is None
    assert refusal(path, read_result, folder, "a") == ": expected a map of depths, got a damaged or foreign file"


@pytest.mark.parametrize("value", NO_NUMBERS)
def test_result_whose_camera_has_a_value_that_is_no_number_is_refused(tmp_path, value):
    path = write_result(tmp_path / "a") / "info.json"
    path.write_text(path.read_text().replace('"fx": 80.0', f'"fx": {value}'))
    refusal(path, read_result, path.parent, "a")


@pytest.mark.parametrize("text", ["[]", "5", "{", "[" * 100_000, '{"complete": true, "settings": 5}', HUGE])
def test_record_of_an_earlier_result_that_is_none_is_refused(tmp_path, text):
    (tmp_path / "info.json").write_text(text)
    refusal(tmp_path / "info.json", read_previous_run, tmp_path)


@pytest.mark.parametrize("text", ["[]", '{"exports": 5}', '{"exports": {"a": "b"}}', '{"exports": {"a": [5]}}'])
def test_record_of_exports_that_is_none_is_refused(tmp_path, text):
    (tmp_path / "exports.json").write_text(text)
    refusal(tmp_path / "exports.json", _read_record, tmp_path)


@pytest.mark.parametrize("tensor", [torch.ones(2, 3, device="meta"), torch.eye(3).to_sparse()])
def test_weights_without_plain_values_are_refused(tmp_path, tensor):
    path = tmp_path / "net.pth"
    for content, read in (({"a": tensor}, read_tensors), ({"model_state_dict": {"a": tensor}}, read_msg_weights)):
        torch.save(content, path)
        assert "expected a torch file of plain tensors, got one" in refusal(path, read, path)


RUN = {
    "names": {"model": "msg_v", "dataset": "simgeo", "downsampling": "box", "noise": "none"},
    "model": {"net": {"_target_": "dsr.methods.networks.msg_net.MSGNet"}},
    "dataset": {"_target_": "dsr.data.rendered.SimGeo"},
    "downsampling": {"_target_": "dsr.degradation.downsampling.Downsampling", "kernel": "box"},
    "noise": {"_target_": "dsr.degradation.noise.no_noise"},
    "scale": 4,
    "seed": 0,
    "trainer": {"max_steps": 2, "val_check_interval": 1},
}
BAD_RUNS = {
    "seed: ": {"seed": "abc"},
    "scale: ": {"scale": None},
    "trainer: ": {"trainer": 5},
    "names.dataset: expected text, got None": {"names": {"model": "msg_v"}},
    "model: ": {"model": "msg_v"},
}


@pytest.mark.parametrize("message", BAD_RUNS)
def test_configuration_of_a_run_with_a_value_of_another_type_is_refused(tmp_path, message):
    path = tmp_path / "config.yaml"
    OmegaConf.save(OmegaConf.create(RUN), path)
    assert read_config(tmp_path)["seed"] == 0
    path.write_text(OmegaConf.to_yaml(OmegaConf.create({**RUN, **BAD_RUNS[message]})))
    with pytest.raises(ConfigError) as caught:
        read_config(tmp_path)
    assert str(caught.value).startswith(f"{path}: {message}")


@pytest.mark.parametrize(("value", "expected"), [
    (1, True), (0.5, True), (np.float32(2), True), (np.int64(2), True), (True, False), (np.bool_(True), False),
    (10**400, False), (math.inf, False), (math.nan, False), ("1", False), (None, False),
])  # fmt: skip
def test_number_is_finite_and_no_boolean(value, expected):
    assert is_number(value) is expected


@pytest.mark.parametrize("text", ["NaN", "-Infinity", "[1e999]", "9" * 5000, "[" * 100_000, "{", ""])
def test_json_with_what_is_no_json_is_refused(text):
    with pytest.raises(ValueError):  # noqa: PT011 - of many kinds
        parse_json(text)


def test_json_of_numbers_is_read():
    assert parse_json('{"a": [1, -2.5e3, true, null], "b": "NaN"}') == {"a": [1, -2500.0, True, None], "b": "NaN"}
    assert math.isnan(parse_json("NaN", finite=False))


def test_long_message_keeps_the_name_at_its_beginning_and_its_end(capsys):
    message = f"/data/scene/camera.json: expected a number, got {'9' * 10_000} at the end"
    print_error(message)
    line = capsys.readouterr().err
    assert len(line) <= len("\n") + 1000
    assert line.startswith("error: /data/scene/camera.json: expected a number, got 999")
    assert line.endswith("9 at the end\n")
    assert len(one_line(ValueError(message))) == 1000
    assert one_line(ValueError("short\nmessage")) == "short message"

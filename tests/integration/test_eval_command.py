"""The real ``python eval.py``: what it writes, re-uses, refuses and keeps."""

import csv
import json
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import run_python

from dsr.evaluation.run_files import load_results

REPOSITORY = Path(__file__).resolve().parents[2]
SIMGEO = [
    "cube_high_freq", "cube_no_texture", "sphere_cylinder_high_freq", "sphere_cylinder_low_freq",
    "sphere_cylinder_no_texture", "statue",
]  # fmt: skip


@pytest.fixture(scope="session")
def offline(tmp_path_factory, dsr_cache):
    """Return an environment without an LPIPS trunk and without a way to download one."""
    home = tmp_path_factory.mktemp("home")
    nowhere = dict.fromkeys(("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"), "http://127.0.0.1:9")
    dropped = ("DSR_LPIPS_TRUNK", "XDG_CACHE_HOME", "HYDRA_FULL_ERROR", "no_proxy", "NO_PROXY")
    kept = {key: value for key, value in os.environ.items() if key not in dropped}
    places = {"HOME": str(home), "TORCH_HOME": str(home / "torch"), "DSR_CACHE": str(dsr_cache)}
    return {**kept, **nowhere, **places, "OMP_NUM_THREADS": "2"}


def quick(arguments):
    """Return the arguments with the quickest method, unless they name or take away one themselves."""
    named = any(re.match(r"~?method(=|$)|--help", argument) for argument in arguments)
    return arguments if named else (*arguments, "method=bicubic")


def run(folder, environment, *arguments):
    """Run the command in a process of its own."""
    return run_python(str(REPOSITORY / "eval.py"), *quick(arguments), cwd=folder, env=environment)


@pytest.fixture
def within(in_process):
    """Return a runner of the command within this process, see there."""

    def call(*arguments, lpips=False):
        return in_process("eval", *quick(arguments), *([] if lpips else ["metrics.lpips=false"]))

    return call


def write_scene(folder, *, height=40, width=48, seed=0, **camera):
    """Write a scene of random photo and gentle depth in metres."""
    folder.mkdir(parents=True)
    photo = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    cv2.imwrite(str(folder / "rgb.png"), photo)
    rows, columns = np.mgrid[:height, :width]
    np.save(folder / "depth.npy", 2 + 0.01 * columns + 0.1 * np.sin(rows / 5))
    centre = {"cx": (width - 1) / 2, "cy": (height - 1) / 2}
    entries = {"width": width, "height": height, "fx": 60.0, "fy": 60.0, **centre, **camera}
    (folder / "camera.json").write_text(json.dumps(entries))
    return folder


def rows(folder):
    with (folder / "scores.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def tree(folder):
    """Return the files in a folder; that of the log ends with a time and the name of the machine."""
    files = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    return sorted(name.partition(".tfevents.")[0] for name in files)


def written(scenes):
    each = [
        f"{kind}/{scene}.{suffix}"
        for kind, suffix in (("pictures", "png"), ("predictions", "npz"), ("scenes", "npz"))
        for scene in scenes
    ]
    return sorted([*each, "config.yaml", "events.out", "scores.csv", "summary.json", "versions.json"])


def test_default_run_writes_the_documented_files_and_a_second_one_reuses_them(tmp_path, offline, within):
    done = run(tmp_path, offline, "dataset.size=64")
    [home] = (tmp_path / "outputs" / "eval").iterdir()
    assert done.returncode == 0, done.stderr
    assert home.name.startswith("bicubic_x4_simgeo_size64")
    assert done.stdout.splitlines()[-1] == f"results: outputs/eval/{home.name}"
    assert {"statue", "mean"} <= set(done.stdout.split())
    assert tree(home) == written(SIMGEO)
    assert [path.name for path in tmp_path.iterdir()] == ["outputs"]
    [line] = done.stderr.splitlines()  # nowhere to get the network of LPIPS from
    assert "LPIPS_v is left out" in line
    assert "metrics.lpips_trunk=FILE" in line
    assert "LPIPS" not in done.stdout
    before, table = {path: path.stat().st_mtime_ns for path in (home / "predictions").iterdir()}, rows(home)
    code, output, errors = within("dataset.size=64")
    assert (code, errors) == (0, [])
    assert "predictions re-used: 6 (overwrite=true computes them again)" in output.splitlines()
    assert [path.name for path in (tmp_path / "outputs" / "eval").iterdir()] == [home.name]
    assert {path: path.stat().st_mtime_ns for path in (home / "predictions").iterdir()} == before
    assert rows(home) == table


def test_bad_scene_keeps_the_others_results_and_is_added_once_it_is_repaired(tmp_path, within):
    for number, name in enumerate(("first", "bad one", "last")):
        write_scene(tmp_path / "data" / name, seed=number)
    photo = tmp_path / "data" / "bad one" / "rgb.png"
    content = photo.read_bytes()
    photo.write_bytes(b"\x89PNG\r\n\x1a\nbroken")
    arguments = ("dataset=folder", "dataset.root=data", "output_dir=out", "weights=x")
    code, _, errors = within(*arguments)
    assert (code, len(errors)) == (2, 3)
    assert errors[0] == "note: method=bicubic has no weights; weights=x is not used"
    assert errors[1].startswith("error: data/bad one/rgb.png: expected a picture")
    assert errors[2].startswith("error: 1 of 3 scenes failed: bad one")
    assert tree(tmp_path / "out") == written(["first", "last"])
    assert {row["scene"] for row in rows(tmp_path / "out")} == {"first", "last"}
    assert list(json.loads((tmp_path / "out" / "summary.json").read_text())["failures"]) == ["bad one"]
    photo.write_bytes(content)
    code, output, errors = within(*arguments)
    assert (code, errors) == (0, errors[:1])
    assert "predictions re-used: 2" in output
    assert tree(tmp_path / "out") == written(["bad one", "first", "last"])


def test_folders_of_predictions_are_judged_as_methods_are(tmp_path, within):
    for number, name in enumerate(("first", "second")):
        write_scene(tmp_path / "data" / name, seed=number)
    data = ("dataset=folder", "dataset.root=data")
    assert within(*data, "output_dir=made")[0] == 0
    for name in ("mine", "yours"):
        (tmp_path / name).mkdir()
        for scene in ("first", "second"):
            np.save(tmp_path / name / f"{scene}.npy", np.load(tmp_path / f"made/predictions/{scene}.npz")["depth"])
    (tmp_path / "yours" / "second.npy").rename(tmp_path / "yours" / "third.npy")
    code, _, errors = within("-m", *data, "method=external", "method.path=mine,yours")
    assert code == 2
    assert errors[0] == "note: yours: 1 files are of no scene: third.npy"
    assert errors[1].startswith("error: yours/second: expected a map as .png, ")
    folders = {
        name: next((tmp_path / "outputs" / "eval").glob(f"external_*path-{name}_*")) for name in ("mine", "yours")
    }
    for name, folder in folders.items():
        scenes = ("first", "second") if name == "mine" else ("first",)
        expected = [{**row, "method": "external"} for row in rows(tmp_path / "made") if row["scene"] in scenes]
        assert json.loads((folder / "summary.json").read_text())["label"] == name
        assert rows(folder) == expected
    np.save(tmp_path / "mine" / "first.npy", 1.01 * np.load(tmp_path / "mine" / "first.npy"))
    code, _, errors = within(*data, "method=external", "method.path=mine")
    assert (code, "made with another method_content" in errors[-1]) == (2, True)


def test_aligned_scores_are_a_result_of_their_own_and_say_so(tmp_path, within):
    write_scene(tmp_path / "data" / "a")
    arguments = ("dataset=folder", "dataset.root=data", "metrics=depth", "scale=8")
    assert within(*arguments)[0] == 0
    code, output, errors = within(*arguments, "metrics.alignment=affine")
    assert (code, errors) == (0, [])
    assert "(affine)" in output
    as_it_is, aligned = sorted((tmp_path / "outputs" / "eval").iterdir(), key=lambda path: "alignment" in path.name)
    assert aligned.name == as_it_is.name.replace("_seed", "_alignment-affine_seed")
    depths = [np.load(aligned / kind / "a.npz")["depth"].astype(float).ravel() for kind in ("predictions", "scenes")]
    scale, shift = np.polyfit(*depths, 1)
    expected = np.sqrt(((scale * depths[0] + shift - depths[1]) ** 2).mean())
    found = {folder: {row["metric"]: float(row["value"]) for row in rows(folder)} for folder in (as_it_is, aligned)}
    assert found[aligned]["Depth_RMSE"] == pytest.approx(expected, rel=1e-5)
    assert found[aligned]["Depth_RMSE"] < 0.999 * found[as_it_is]["Depth_RMSE"]
    code, _, errors = within(*arguments, "metrics.alignment=robust", f"output_dir={aligned}")
    assert code == 2
    assert f"output_dir: {aligned} holds a run with another alignment; " in errors[0]
    results = load_results([tmp_path / "outputs"])
    assert [run.label for run in results.runs] == ["Bicubic", "Bicubic (alignment=affine)"]
    np.testing.assert_allclose(results.runs[1].prediction("a").numpy().ravel(), scale * depths[0] + shift, rtol=1e-5)


def test_errors_that_a_method_states_are_scored(tmp_path, within):
    write_scene(tmp_path / "data" / "a", height=64, width=64)
    arguments = ("dataset=folder", "dataset.root=data", "scale=4", "metrics=calibration")
    folder = tmp_path / "out"
    assert within(*arguments, "method=facets", f"output_dir={folder}")[0] == 0
    found = {row["metric"]: row["value"] for row in rows(folder) if row["metric"].startswith("Calibration")}
    stored, truth = (np.load(folder / kind / "a.npz") for kind in ("predictions", "scenes"))
    off = np.abs(stored["depth"].astype(float) - truth["depth"])
    assert float(found["Calibration_stated"]) == pytest.approx(
        np.median(stored["depth_error"]) / np.median(off), rel=1e-3
    )


USAGE_ERRORS = {
    "method: ": ["~method"],
    "noise.std: ": ["noise=gaussian_multiplicative", "noise.std=2"],
    "downsampling.assumed: ": ["downsampling.assumed=nearest"],
    "threads: ": ["threads=0.5"],
    "metrics.alignment: ": ["metrics.alignment=median"],
    "dataset.root: ": ["dataset=folder"],
    "dataset.scenes: ": ["dataset.scenes=[mars]"],
    "weights: method=msg_v: ": ["method=msg_v", "scale=16"],
    "dataset=mixture: ": ["dataset=mixture"],
    "weights: method=msg_v: expected a file": ["method=msg_v", "weights=no.pth"],
    "file: ": ["method=msg_v", "weights=file"],
    "weights: method=pgsr: ": ["method=pgsr"],
    "metrics.lpips_trunk: ": ["metrics.lpips_trunk=no"],
    "output_dir: foreign ": ["output_dir=foreign"],
}


@pytest.mark.parametrize("start", USAGE_ERRORS)
def test_usage_error_is_one_line_with_exit_code_2_and_writes_nothing(tmp_path, within, start):
    (tmp_path / "file").write_text("no weights")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.txt").write_text("precious")
    code, output, errors = within(*USAGE_ERRORS[start], lpips="trunk" in start)
    assert (code, output, len(errors)) == (2, "", 1), errors
    assert errors[0].startswith(f"error: {start}")
    assert tree(tmp_path) == ["file", "foreign/thesis.txt"]


def test_default_method_is_msg_v_with_packaged_weights(tmp_path, in_process, within):
    arguments = ("dataset.size=64", "dataset.scenes=[statue,cube_no_texture]")
    code, _, errors = in_process("eval", *arguments, "metrics.lpips=false")
    assert (code, errors) == (0, [])
    [home] = (tmp_path / "outputs" / "eval").iterdir()
    assert home.name.startswith("msg_v_x4_simgeo_")
    assert within(*arguments, "output_dir=bicubic")[0] == 0
    ours, theirs = (
        json.loads((folder / "summary.json").read_text())["mean"] for folder in (home, tmp_path / "bicubic")
    )
    for name in ("RMSE_v", "DSSIM_v", "BadPix_v_5", "Bumpiness_d"):
        assert ours[name] < 0.9 * theirs[name], name


def test_scene_may_have_any_name(tmp_path, within):
    name = "ünï [red] $x$"
    write_scene(tmp_path / "data" / name)
    code, output, errors = within("dataset=folder", "dataset.root=data", "output_dir='o [bold]'")
    assert (code, errors) == (0, [])
    assert tree(tmp_path / "o [bold]") == written([name])
    assert f" {name} " in output
    assert "results: o [bold]" in output


@pytest.mark.parametrize(("size", "ratio"), [((15, 18), "2.667"), ((10, 12), "4")])
def test_measured_map_of_any_size_is_upsampled_at_its_own_ratio_and_no_other(tmp_path, within, size, ratio):
    write_scene(tmp_path / "data" / "a", height=40, width=48)
    arguments = ("dataset=folder", "dataset.root=data", "downsampling=measured")

    def refused(scale):
        code, _, [line] = within(*arguments, f"scale={scale}")
        return line if code == 2 else ""

    assert refused("native").startswith("error: a: downsampling=measured scale=native expects a low-resolution map")
    np.save(tmp_path / "data" / "a" / "depth_lr.npy", np.full(size, 2.0, np.float32))
    assert refused("2.5").startswith("error: a: downsampling=measured expects")
    assert refused("0.5").startswith("error: scale: expected native or")
    code, output, errors = within(*arguments, "scale=native")
    assert (code, errors) == (0, [])
    assert f"Bicubic on folder, x{ratio}, measured downsampling" in output
    (folder,) = (tmp_path / "outputs" / "eval").iterdir()
    assert folder.name.startswith(f"bicubic_x{ratio}_folder_measured_")
    assert {row["scale"] for row in rows(folder)} == {ratio}
    with np.load(folder / "predictions" / "a.npz") as kept:
        np.testing.assert_allclose(kept["depth"], 2.0, rtol=0.02)
    code, output, errors = within(*arguments, f"scale={ratio}")
    assert (code, errors) == (0, [])
    assert "predictions re-used: 1" in output


def test_several_workers_give_the_files_of_one(tmp_path, offline, within):
    scenes = ["cube_no_texture", "statue"]
    shared = ("dataset.size=64", f"dataset.scenes=[{','.join(scenes)}]", "threads=1", "method=msg_v", "device=cpu")
    assert within(*shared, "workers=1", "output_dir=one")[::2] == (0, [])
    done = run(tmp_path, offline, *shared, "metrics.lpips=false", "workers=2", "output_dir=two")
    assert (done.returncode, done.stderr) == (0, "")
    one, two = tmp_path / "one", tmp_path / "two"
    assert tree(two) == tree(one) == written(scenes)
    assert (one / "scores.csv").read_bytes() == (two / "scores.csv").read_bytes()
    for scene in scenes:
        depths = [np.load(folder / "predictions" / f"{scene}.npz")["depth"] for folder in (one, two)]
        np.testing.assert_array_equal(*depths)
    summaries = [json.loads((folder / "summary.json").read_text()) for folder in (one, two)]
    assert [list(each["seconds"]) for each in summaries] == [scenes] * 2
    assert "predictions re-used: 2" in within(*shared, "workers=1", "output_dir=two")[1]


def test_msg_v_reproduces_the_protocol_on_a_released_scene(shared, tmp_path, within):
    scene = ("dataset=folder", f"dataset.root='{shared / 'scenes'}'", "dataset.scenes=[lucy]", "output_dir=out")
    assert within(*scene, "method=msg_v", f"weights='{shared / 'weights'}'", "device=cpu")[::2] == (0, [])
    worst = {row["metric"]: float(row["value"]) for row in rows(tmp_path / "out") if row["variant"] in ("", "max")}
    expected = {
        "RMSE_d": 0.0236, "BadPix_d_5cm": 0.0162, "BadPix_v_5": 0.388, "DSSIM_v": 0.206, "Bumpiness_d": 0.82,
        "RMSE_v": 0.156,
    }  # the protocol's table, to half a digit  # fmt: skip
    assert {name: worst[name] for name in expected} == pytest.approx(expected, rel=0.004)

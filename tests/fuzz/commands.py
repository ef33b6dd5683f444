"""Commands that read what dsr wrote: runs, results of ``dsr upsample``, studies, checkpoints and configurations."""

import atexit
import contextlib
import functools
import io
import json
import re
import shutil
import tempfile
from pathlib import Path

import captures
import numpy as np
import small_results
from conftest import write_run
from small_files import written

from dsr.app.entry import run_eval, run_train
from dsr.cli import main
from dsr.report.study.files import write_key
from dsr.training.module import SuperResolution
from dsr.utils.configuration import config_directories
from fuzz.judging import Place, RefusedError
from fuzz.readers import CAMERA, Reader, command, run, unit

_EVALUATION = ("method=bicubic", "metrics.lpips=false", "device=cpu")
_TRAINING = (
    "model=msg_v", "scale=2", "trainer=smoke", "dataset=folder", "trainer.max_steps=2", "trainer.val_check_interval=1",
    "patches.scenes=2", "metrics.lpips=false", "device=cpu", "precision=float32", "logger=[tensorboard,csv]",
)  # fmt: skip


def _quietly(*arguments: object) -> None:
    """Run a command that has to succeed."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = main([str(each) for each in arguments])
    assert code == 0, said.getvalue()


def runs(folder: Path) -> None:
    """Write two runs of ``eval.py``, one of a method that expects errors."""
    write_run(folder / "bicubic")
    write_run(folder / "facets", method="facets", label="Facets", confident=True)


@functools.cache
def _elsewhere() -> Path:
    """Return a folder with a data set of three scenes, and with what is to be made once."""
    place = Path(tempfile.mkdtemp(prefix="tmp-dsr-fuzz-"))
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    for number in range(3):
        scene = place / "scenes" / f"room{number}"
        captures.save(scene / "rgb.png", captures.photo(number))
        (scene / "camera.json").write_text(json.dumps(CAMERA))
        np.save(scene / "depth.npy", small_results.waves(64, hole=False)[:48])
    return place


def _evaluation(folder: Path) -> tuple[str, ...]:
    """Return the arguments of an evaluation, which repeat it, too."""
    return ("dataset=folder", f"dataset.root={_elsewhere() / 'scenes'}", f"output_dir={folder / 'run'}", *_EVALUATION)


def evaluation(folder: Path) -> None:
    """Write the directory of an evaluation of a small data set."""
    _quietly("eval", *_evaluation(folder))


@functools.cache
def _trained() -> Path:
    """Return the directory of a training of two steps, which is made once."""
    folder = _elsewhere() / "run"
    _quietly("train", *_TRAINING, f"dataset.root={_elsewhere() / 'scenes'}", f"output_dir={folder}")
    for log in (folder / "tensorboard").rglob("events*"):
        log.unlink()
    return folder


def training(folder: Path) -> None:
    """Write the directory of a finished training."""
    shutil.copytree(_trained(), folder / "run")


def interrupted_training(folder: Path) -> None:
    """Write the directory of a training that was interrupted before its weights were written."""
    training(folder)
    (folder / "run" / "weights.safetensors").unlink()


def results(folder: Path) -> None:
    """Write two results of a sequence."""
    for number in range(2):
        small_results.write_result(folder / "out" / f"{number:06}", pose=captures.pose(number).tolist())


def _again(folder: Path) -> list[object]:
    """Return the arguments that make the stored results."""
    options = ("--method", "bicubic", "--fill", "all", "--only", "depth,normals,confidence,input,nerfstudio")
    return ["upsample", folder / "scan", "-o", folder / "out", *options]


def kept_results(folder: Path) -> None:
    """Write the pictures of a sequence with poses, and their results."""
    captures.stray(folder / "scan", video=False)
    _quietly(*_again(folder))


def study(folder: Path) -> None:
    """Write the key of a study, and answers."""
    tests = unit("test_user_study")
    write_key(folder / "key.json", tests.KEY)
    (folder / "answers").mkdir()
    tests.written(folder / "answers", *tests.FOUR[:2])


def configuration(folder: Path) -> None:
    """Write a directory of configuration files with a method, a data set and a model."""
    own = config_directories()[0]
    for group, source, name in (("method", "tgv", "mine"), ("dataset", "folder", "ours"), ("model", "pdn", "net")):
        written(folder / "conf" / group / f"{name}.yaml", (own / group / f"{source}.yaml").read_bytes())
    written(folder / "conf" / "method" / "more.yaml", b"defaults: [mine]\ndata_weight: 20\n")
    captures.save(folder / "rgb" / "photo.png", captures.photo())
    captures.save(folder / "depth" / "photo.png", captures.millimetres())


def _hydra(name: str, *arguments: str) -> None:
    """Run ``eval.py`` or ``train.py`` in this process, without ``dsr``, which catches more."""
    try:
        run(lambda: {"eval": run_eval, "train": run_train}[name](arguments))
    except RefusedError as refused:  # a line may begin with the key of a configuration
        raise RefusedError([re.sub(r"^([a-z_]+(\.\w+)*: )", r"input/ \1", line) for line in refused.lines]) from refused


def _report(parts: str) -> Reader:
    def read(place: Place) -> None:
        command("report", place.input, "-o", place.out / "report", "--only", parts)

    return Reader(f"report {parts}", runs, read, 1)


COMMANDS = (
    _report("tables,metrics"),
    _report("figures,page"),
    Reader("study build", runs,
           lambda place: command("study", "build", place.input, "-o", place.out / "study", "--light", "e1"), 1),
    Reader("study collect", study, lambda place: command(
        "study", "collect", place.input, place.input / "answers", "-o", place.out / "study.csv")),
    Reader("eval again", evaluation, lambda place: _hydra("eval", *_evaluation(place.input)), 1),
    Reader("eval run", training, lambda place: _hydra(
        "eval", f"run={place.input / 'run'}", f"output_dir={place.out / 'run'}", "metrics.lpips=false",
        "device=cpu"), 1),
    Reader("train resume", interrupted_training,
           lambda place: _hydra("train", f"resume={place.input / 'run'}", "device=cpu"), 1),
    Reader("checkpoint", training, lambda place: SuperResolution.load_from_checkpoint(
        place.input / "run" / "checkpoints" / "best.ckpt"), 2),
    Reader("view", results,
           lambda place: command("view", place.input / "out", "--no-open", "-o", place.out / "view.html")),
    Reader("fuse", results,
           lambda place: command("fuse", place.input / "out", "-o", place.out / "mesh.ply", "--voxel", "0.05"), 2),
    Reader("upsample again", kept_results, lambda place: command(*_again(place.input)), 2),
    Reader("configuration", configuration, lambda place: command(
        "upsample", place.input, "--config-dir", place.input / "conf", "--method", "more", "--set", "data_weight=30",
        "-o", place.out, "--dry-run"), 2),
)  # fmt: skip

"""Valid directories of runs, results of ``dsr upsample``, studies and configurations, from which cases are made."""

import atexit
import contextlib
import functools
import io
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any
from unittest import mock

import captures
import numpy as np
import small_results
from conftest import write_run

from dsr.cli import main
from fuzz.seeds import CAMERA, photo, unit, written


def quietly(*arguments: object) -> None:
    """Run a command that has to succeed."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = main([str(each) for each in arguments])
    assert code == 0, said.getvalue()


def runs(folder: Path) -> None:
    """Write two runs of ``eval.py``, one of a method that expects errors."""
    write_run(folder / "bicubic")
    write_run(folder / "facets", method="facets", label="Facets", confident=True)


def evaluation(folder: Path) -> None:
    """Write the directory of an evaluation of a small data set, and the data set."""
    _scenes(folder / "scenes", "room")
    quietly("eval", *evaluation_arguments(folder, folder / "run"))


def _scenes(folder: Path, *names: str) -> None:
    """Write scenes of dsr's own layout."""
    for number, name in enumerate(names):
        captures.save(folder / name / "rgb.png", captures.photo(number))
        written(folder / name / "camera.json", json.dumps(CAMERA))
        np.save(folder / name / "depth.npy", small_results.waves(64, hole=False)[:48])


def evaluation_arguments(folder: Path, run: Path) -> list[str]:
    """Return the arguments of the evaluation."""
    return [
        "dataset=folder", f"dataset.root={folder / 'scenes'}", "method=bicubic", "metrics.lpips=false", "device=cpu",
        f"output_dir={run}",
    ]  # fmt: skip


_STEPS = 2  # Steps of a training


@functools.cache
def _trained(steps: int) -> Path:
    """Return the directory of a training of two steps, which is made once; with fewer steps it was interrupted."""
    from dsr.app import train  # noqa: PLC0415

    class Interrupting(train.StepProgress):
        """Ends the training like Ctrl-C."""

        def on_train_batch_start(self, trainer: Any, *_: Any) -> None:
            """Raise at the step."""
            if trainer.global_step == steps:
                raise KeyboardInterrupt

    place = Path(tempfile.mkdtemp(prefix="tmp-dsr-fuzz-training-"))
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    _scenes(place / "scenes", "room", "hall", "shed")
    folder = place / "run"
    with mock.patch.object(train, "StepProgress", Interrupting), contextlib.suppress(SystemExit):
        quietly(
            "train", "model=msg_v", "scale=2", "trainer=smoke", "dataset=folder", f"dataset.root={place / 'scenes'}",
            f"trainer.max_steps={_STEPS}", "trainer.val_check_interval=1", "patches.scenes=2", "metrics.lpips=false",
            "device=cpu", "precision=float32", "logger=[tensorboard,csv]", f"output_dir={folder}",
        )  # fmt: skip
    assert (folder / "weights.safetensors").is_file() == (steps == _STEPS)
    for log in (folder / "tensorboard").rglob("events*"):
        log.unlink()
    return folder


def training(folder: Path) -> None:
    """Write the directory of a finished training."""
    shutil.copytree(_trained(_STEPS), folder / "run")


def training_without_weights(folder: Path) -> None:
    """Write the directory of a training that was interrupted before its weights were written."""
    training(folder)
    (folder / "run" / "weights.safetensors").unlink()


def interrupted_training(folder: Path) -> None:
    """Write the directory of a training that was interrupted after its first step."""
    shutil.copytree(_trained(1), folder / "run")


def results(folder: Path) -> None:
    """Write two results of a sequence."""
    for number in range(2):
        pose = captures.pose(number).tolist()
        small_results.write_result(folder / "out" / f"{number:06}", pose=pose)


def kept_results(folder: Path) -> None:
    """Write the pictures of a sequence with poses, and their results."""
    captures.stray(folder / "scan", video=False)
    quietly("upsample", *upsample_again(folder))


def upsample_again(folder: Path) -> list[str]:
    """Return the arguments that the results were made with, and that read them again."""
    return [
        str(folder / "scan"), "-o", str(folder / "out"), "--method", "bicubic", "--fill", "all", "--only",
        "depth,normals,confidence,input,nerfstudio",
    ]  # fmt: skip


def more_of_results(folder: Path) -> list[str]:
    """Return the arguments that make another part of the stored depth."""
    return [*upsample_again(folder)[:-1], "depth,renderings,cloud,open3d"]


def study(folder: Path) -> None:
    """Write the key of a study, and answers."""
    from dsr.report.study.key import write_key  # noqa: PLC0415

    tests = unit("test_user_study")
    write_key(folder / "key.json", tests.KEY)
    (folder / "answers").mkdir()
    tests.written(folder / "answers", *tests.FOUR[:2])


def study_table(folder: Path) -> None:
    """Write runs and the table of a study of them."""
    from dsr.report.study.percentages import COLUMNS  # noqa: PLC0415

    write_run(folder / "bicubic")
    rows = [",".join(COLUMNS)]
    for label, method in (("Bicubic", "bicubic"), ("Facets", "facets")):
        values = ["30", "20", "50", "12", *["10", "60"] * 3]
        rows.append(",".join(["simgeo", "cube_no_texture", "4", "box", method, label, *values]))
    written(folder / "study.csv", "\n".join(rows) + "\n")


def user_configuration(folder: Path) -> None:
    """Write a directory of configuration files with a method, a data set and a model."""
    from dsr.utils.configuration import config_directories  # noqa: PLC0415

    own = config_directories()[0]
    for group, source, name in (("method", "tgv", "mine"), ("dataset", "folder", "ours"), ("model", "pdn", "net")):
        written(folder / "conf" / group / f"{name}.yaml", (own / group / f"{source}.yaml").read_bytes())
    written(folder / "conf" / "method" / "more.yaml", "defaults: [mine]\nname: more\nlabel: More\n")
    photo(folder / "photo.png")
    captures.save(folder / "depth.png", captures.millimetres())

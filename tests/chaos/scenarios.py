"""The commands of the campaign, each of a few seconds, and the files that they start from."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from small_frames import in_text, walk, write_recording

from dsr.geometry.camera import Camera

Origin = Callable[[Path], None] | tuple[str, str]
"""What makes a path, or the scenario and the path in its results that it is copied from."""


class Scenario(NamedTuple):
    """Commands and what they start from, by paths.

    ``commands`` follow each other undisturbed; of a pair they run at once. ``rivals`` have different settings and one
    folder: one of them is refused, and the results are those of the other.
    """

    commands: tuple[tuple[str, ...], ...]
    needs: Mapping[str, Origin] = {}
    rivals: tuple[str, ...] = ()


def make_frames(folder: Path) -> None:
    """Write six photos and depth maps of a room, and their poses beside."""
    poses = walk(6)
    write_recording(folder, Camera.centred(32, 24, 30.0), poses)
    (folder.parent / "poses.txt").write_text(in_text(poses))


def make_answers(folder: Path) -> None:
    """Write answers of three people to the study in the folder beside."""
    key = json.loads((folder.parent / "study" / "key.json").read_text())
    folder.mkdir()
    for person in range(3):
        trials = []
        for name, trial in key["trials"].items():
            order = sorted(trial["candidates"])
            chosen = order[person % 2 :] + order[: person % 2]
            trials.append({"scene": name, "again": False, "order": order, "first": chosen[0], "second": chosen[1],
                           "ms": 4000.0 + 500 * person + len(trials)})  # fmt: skip
        content = {"study": key["study"], "page": 1, "participant": f"person {person}",
                   "finished": f"2024-05-01T12:0{person}:00Z", "trials": trials}  # fmt: skip
        (folder / f"{person}.json").write_text(json.dumps(content))


_EVAL = ("eval.py", "dataset=simgeo", "dataset.size=48", "dataset.scenes=[statue,cube_no_texture]",
         "metrics.lpips=false", "device=cpu")  # fmt: skip
_FACETS = (*_EVAL, "method=facets", "output_dir=runs/facets")
_BICUBIC = (*_EVAL, "method=bicubic", "output_dir=runs/bicubic")
_DIP = (*_EVAL, "method=dip_v", "method.steps=80", "method.widths=[8,16]", "method.skips=[2,2]",
        "method.validate_every=10", "output_dir=out")  # fmt: skip
_TRAIN = ("train.py", "trainer=smoke", "trainer.max_steps=12", "trainer.val_check_interval=3", "dataset=procedural",
          "dataset.count=3", "dataset.size=48", "metrics.lpips=false", "device=cpu", "output_dir=out")  # fmt: skip
_UPSAMPLE = ("dsr", "upsample", "frames", "-o", "out", "--poses", "poses.txt", "--depth-unit", "mm", "--method",
             "facets", "--only", "depth,confidence,mesh,before_after", "--device", "cpu")  # fmt: skip
_REPORT = ("dsr", "report", "runs", "-o", "report")
_STUDY = ("dsr", "study", "build", "runs", "-o", "study")
_PREPARE = ("dsr", "data", "prepare", "procedural", "dataset.count=5", "dataset.size=48")
_FRAMES: Mapping[str, Origin] = {"frames": make_frames}
_RUNS: Mapping[str, Origin] = {
    "runs/facets": ("eval", "runs/facets"),
    "runs/bicubic": ("eval_bicubic", "runs/bicubic"),
}

STRUCK = {
    "eval": Scenario((_FACETS,)),
    "dip": Scenario((_DIP,)),
    "train": Scenario((_TRAIN,)),
    "train_workers": Scenario(((*_TRAIN, "patches.workers=2"),)),
    "upsample": Scenario((_UPSAMPLE,), _FRAMES),
    "upsample_workers": Scenario(((*_UPSAMPLE, "--workers", "2"),), _FRAMES),
    "report": Scenario((_REPORT,), _RUNS),
    "study_build": Scenario((_STUDY,), _RUNS),
    "study_collect": Scenario(
        (("dsr", "study", "collect", "study", "answers"),),
        {"study": ("study_build", "study"), "answers": make_answers},
    ),
    "fuse": Scenario((("dsr", "fuse", "out", "-o", "mesh.ply"),), {"out": ("upsample", "out")}),
    "prepare": Scenario((_PREPARE,)),
}
"""What is struck by signals."""

OTHERS = {
    "eval_bicubic": Scenario((_BICUBIC,)),
    "eval_noise": Scenario(((*_FACETS, "noise=tof"),)),
    "train_x2": Scenario(((*_TRAIN, "scale=2", "logger=csv"),)),
    "upsample_fill": Scenario(((*_UPSAMPLE, "--fill", "all"),), _FRAMES),
}
"""What others start from, or rival with."""

AT_ONCE = {
    "two_trainings_one_cache": Scenario((_TRAIN, (*_TRAIN[:-1], "output_dir=two", "scale=2"))),
    "two_trainings": Scenario((_TRAIN, _TRAIN)),
    "two_evaluations": Scenario((_FACETS, _FACETS)),
    "two_dips": Scenario((_DIP, _DIP)),
    "two_upsamples": Scenario((_UPSAMPLE, _UPSAMPLE), _FRAMES),
    "two_reports": Scenario((_REPORT, _REPORT), _RUNS),
    "two_studies": Scenario((_STUDY, _STUDY), _RUNS),
    "two_preparations": Scenario((_PREPARE, _PREPARE)),
    "rival_trainings": Scenario((), rivals=("train", "train_x2")),
    "rival_evaluations": Scenario((), rivals=("eval", "eval_noise")),
    "rival_upsamples": Scenario((), _FRAMES, rivals=("upsample", "upsample_fill")),
    "report_while_evaluating": Scenario((_BICUBIC, _REPORT), {"runs/facets": ("eval", "runs/facets")}),
}
"""What runs at once."""

ALL = {**STRUCK, **OTHERS, **AT_ONCE}

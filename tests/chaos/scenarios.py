"""The commands of the campaign, each of a few seconds, and the files that they start from."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

REPOSITORY = Path(__file__).resolve().parents[2]
_PROGRAMS = {
    "eval": (sys.executable, str(REPOSITORY / "eval.py")),
    "train": (sys.executable, str(REPOSITORY / "train.py")),
    "dsr": (sys.executable, "-m", "dsr"),
    "python": (sys.executable,),
}


@dataclass(frozen=True)
class Scenario:
    """A command, or several that follow each other or run at once.

    Args:
        name: its name.
        commands: arguments, the first one a key of ``_PROGRAMS``.
        needs: what it starts from: paths in its folder, and what makes them, or the scenario and the path in its
            results that they are copied from.
        complete: message of a command that has nothing left to do and ends with exit code 2; empty if there is none.
        rivals: what the commands would do alone, if they have one folder and different settings: one of them has to be
            refused, and the results have to be those of the other.
        kept: patterns of files that are never made again once they are there, ``info.json`` once it says ``complete``.

    """

    name: str
    commands: tuple[tuple[str, ...], ...]
    needs: Mapping[str, Callable[[Path], None] | tuple[str, str]] = field(default_factory=dict)
    complete: str = ""
    rivals: tuple[Scenario, ...] = ()
    kept: tuple[str, ...] = ("cache/**/*.npz", "**/predictions/*.npz", "out/*/info.json")

    def arguments(self, number: int = 0) -> list[str]:
        """Return a command as arguments of a process."""
        program, *rest = self.commands[number]
        return [*_PROGRAMS[program], *rest]


def make_frames(folder: Path) -> None:
    """Write six photos and depth maps of a box before a wall, from cameras 4 cm apart."""
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:48, :64]
    for number in range(6):
        inside = (abs(u - 32 + 2 * number) < 12) & (abs(v - 24) < 9)
        photo = np.where(inside[..., None], (200, 60, 60), (60, 120, 200)).astype(np.uint8)
        Image.fromarray(photo).save(folder / "rgb" / f"{number:03}.png")
        depth = np.where(inside, 1200, 2000)[::2, ::2] + rng.normal(0, 5, (24, 32))
        Image.fromarray(depth.round().astype(np.uint16)).save(folder / "depth" / f"{number:03}.png")
    camera = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}
    (folder / "camera.json").write_text(json.dumps(camera))


def make_poses(path: Path) -> None:
    """Write the poses of the frames."""
    path.write_text("".join(f"1 0 0 {0.04 * number} 0 1 0 0 0 0 1 0\n" for number in range(6)))


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


_SCENES = "dataset.scenes=[statue,cube_no_texture]"
_EVAL = ("eval", "dataset=simgeo", "dataset.size=48", _SCENES, "metrics.lpips=false", "device=cpu")
_FACETS = (*_EVAL, "method=facets", "output_dir=runs/facets")
_BICUBIC = (*_EVAL, "method=bicubic", "output_dir=runs/bicubic")
_DIP = (
    "eval", "dataset=simgeo", "dataset.size=48", "dataset.scenes=[statue,cube_no_texture]", "metrics.lpips=false",
    "device=cpu", "method=dip_v", "method.steps=80", "method.widths=[8,16]", "method.skips=[2,2]",
    "method.validate_every=10", "output_dir=out",
)  # fmt: skip
_TRAIN = (
    "train", "trainer=smoke", "trainer.max_steps=12", "trainer.val_check_interval=3", "dataset=procedural",
    "dataset.count=3", "dataset.size=48", "metrics.lpips=false", "device=cpu",
)  # fmt: skip
_UPSAMPLE = (
    "dsr", "upsample", "frames", "-o", "out", "--poses", "poses.txt", "--depth-unit", "mm", "--method", "facets",
    "--only", "depth,confidence,mesh,before_after", "--device", "cpu",
)  # fmt: skip
_REPORT = ("dsr", "report", "runs", "-o", "report")
_STUDY = ("dsr", "study", "build", "runs", "-o", "study")
_FRAMES: Mapping[str, Callable[[Path], None]] = {"frames": make_frames, "poses.txt": make_poses}
_TRAINED = "is trained already"
_TWO_RUNS = {"runs/facets": ("eval", "runs/facets"), "runs/bicubic": ("eval_bicubic", "runs/bicubic")}

_TRAINING = Scenario("train", ((*_TRAIN, "output_dir=out"),), complete=_TRAINED)
_EVALUATION = Scenario("eval", (_FACETS,))
_UPSAMPLING = Scenario("upsample", (_UPSAMPLE,), _FRAMES)
_OTHER_TRAINING = Scenario("train_x2", ((*_TRAIN, "output_dir=out", "scale=2", "logger=csv"),), complete=_TRAINED)
_OTHER_EVALUATION = Scenario("eval_noise", ((*_FACETS, "noise=tof"),))
_OTHER_UPSAMPLING = Scenario("upsample_fill", ((*_UPSAMPLE, "--fill", "all"),), _FRAMES)

STRUCK = {
    each.name: each
    for each in (
        _EVALUATION,
        Scenario("dip", (_DIP,)),
        _TRAINING,
        Scenario("train_workers", ((*_TRAIN, "output_dir=out", "patches.workers=2"),), complete=_TRAINED),
        _UPSAMPLING,
        Scenario("upsample_workers", ((*_UPSAMPLE, "--workers", "2"),), _FRAMES),
        Scenario("report", (_REPORT,), _TWO_RUNS),
        Scenario("study_build", (_STUDY,), _TWO_RUNS),
        Scenario("study_collect", (("dsr", "study", "collect", "study", "answers"),),
                 {"study": ("study_build", "study"), "answers": make_answers}),
        Scenario("fuse", (("dsr", "fuse", "out", "-o", "mesh.ply"),), {"out": ("upsample", "out")}),
        Scenario("prepare", (("dsr", "data", "prepare", "procedural", "dataset.count=5", "dataset.size=48"),)),
    )
}  # fmt: skip
"""What is struck by signals."""

PREPARING = {each.name: each for each in (Scenario("eval_bicubic", (_BICUBIC,)),)}  # What others start from

AT_ONCE = {
    each.name: each
    for each in (
        Scenario("two_trainings_one_cache", ((*_TRAIN, "output_dir=one"), (*_TRAIN, "output_dir=two", "scale=2")),
                 complete=_TRAINED),
        Scenario("two_trainings_one_directory", ((*_TRAIN, "output_dir=out"),) * 2, complete=_TRAINED),
        Scenario("two_evaluations", (_FACETS, _FACETS)),
        Scenario("two_dips", (_DIP, _DIP)),
        Scenario("two_upsamples", (_UPSAMPLE, _UPSAMPLE), _FRAMES),
        Scenario("two_reports", (_REPORT, _REPORT), _TWO_RUNS),
        Scenario("two_studies", (_STUDY, _STUDY), _TWO_RUNS),
        Scenario("two_preparations", STRUCK["prepare"].commands * 2),
        Scenario("rival_trainings", (_TRAINING.commands[0], _OTHER_TRAINING.commands[0]),
                 rivals=(_TRAINING, _OTHER_TRAINING)),
        Scenario("rival_evaluations", (_EVALUATION.commands[0], _OTHER_EVALUATION.commands[0]),
                 rivals=(_EVALUATION, _OTHER_EVALUATION)),
        Scenario("rival_upsamples", (_UPSAMPLING.commands[0], _OTHER_UPSAMPLING.commands[0]), _FRAMES,
                 rivals=(_UPSAMPLING, _OTHER_UPSAMPLING)),
        Scenario("report_while_evaluating", (_BICUBIC, _REPORT), {"runs/facets": ("eval", "runs/facets")}),
    )
}  # fmt: skip
"""What runs at once; undisturbed, its commands follow each other."""

ALL = {**STRUCK, **PREPARING, **AT_ONCE}

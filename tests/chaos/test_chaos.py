"""Commands that are struck at random moments and go on, or run twice at once, give the files of undisturbed ones."""

import contextlib
import json
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import pytest
from chaos.results import damaged, differences
from commands import Program
from small_frames import in_text, walk, write_recording

from dsr.geometry.camera import Camera

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

REPOSITORY = Path(__file__).resolve().parents[2]
CODES = {signal.SIGKILL: -9, signal.SIGINT: 130, signal.SIGTERM: 143}
COMPLETE = "is trained already"  # The one command that refuses what is done
KEPT = ("cache/**/*.npz", "**/predictions/*.npz", "out/*/info.json")  # Files that are never made again
LIMIT, GRACE = 300, 60  # Seconds that an undisturbed command may take, and one that is struck to its end


class Scenario(NamedTuple):
    """A command, and what it starts from by paths: what makes it, or a scenario and the path in its results."""

    arguments: tuple[str, ...]
    needs: Mapping[str, Any] = MappingProxyType({})


def make_frames(folder):
    """Write six photos and depth maps of a room, and their poses beside."""
    poses = walk(6)
    write_recording(folder, Camera.centred(32, 24, 30.0), poses)
    (folder.parent / "poses.txt").write_text(in_text(poses))


def make_answers(folder):
    """Write answers of three people to the study in the folder beside."""
    key = json.loads((folder.parent / "study" / "key.json").read_text())
    folder.mkdir()
    for person in range(3):
        trials = []
        for name, trial in key["trials"].items():
            order = sorted(trial["candidates"])
            first, second = order if person % 2 else reversed(order)
            trials.append({"scene": name, "again": False, "order": order, "first": first, "second": second,
                           "ms": 4000.0 + 500 * person + len(trials)})  # fmt: skip
        content = {"study": key["study"], "page": 1, "participant": f"person {person}",
                   "finished": f"2024-05-01T12:0{person}:00Z", "trials": trials}  # fmt: skip
        (folder / f"{person}.json").write_text(json.dumps(content))


SMALL = ("metrics.lpips=false", "device=cpu")
EVAL = (str(REPOSITORY / "eval.py"), "dataset=simgeo", "dataset.size=48", "dataset.scenes=[statue,cube_no_texture]",
        *SMALL)  # fmt: skip
DIP = (*EVAL, "method=dip_v", "method.steps=80", "method.widths=[8,16]", "method.skips=[2,2]",
       "method.validate_every=10", "output_dir=out")  # fmt: skip
TRAIN = (str(REPOSITORY / "train.py"), "trainer=smoke", "trainer.max_steps=12", "trainer.val_check_interval=3",
         "dataset=procedural", "dataset.count=3", "dataset.size=48", *SMALL, "output_dir=out")  # fmt: skip
DSR = ("-m", "dsr")
UPSAMPLE = (*DSR, "upsample", "frames", "-o", "out", "--poses", "poses.txt", "--depth-unit", "mm", "--method", "facets",
            "--only", "depth,confidence,mesh,before_after", "--device", "cpu")  # fmt: skip
RUNS = {f"runs/{name}": (name, f"runs/{name}") for name in ("facets", "bicubic")}
SCENARIOS = {
    "facets": Scenario((*EVAL, "method=facets", "output_dir=runs/facets")),
    "bicubic": Scenario((*EVAL, "method=bicubic", "output_dir=runs/bicubic")),
    "dip": Scenario(DIP),
    "train": Scenario(TRAIN),
    "train_workers": Scenario((*TRAIN, "patches.workers=2")),
    "upsample": Scenario(UPSAMPLE, {"frames": make_frames}),
    "upsample_workers": Scenario((*UPSAMPLE, "--workers", "2"), {"frames": make_frames}),
    "report": Scenario((*DSR, "report", "runs", "-o", "report"), RUNS),
    "study_build": Scenario((*DSR, "study", "build", "runs", "-o", "study"), RUNS),
    "study_collect": Scenario((*DSR, "study", "collect", "study", "answers"),
                              {"study": ("study_build", "study"), "answers": make_answers}),
    "fuse": Scenario((*DSR, "fuse", "out", "-o", "mesh.ply"), {"out": ("upsample", "out")}),
    "prepare": Scenario((*DSR, "data", "prepare", "procedural", "dataset.count=5", "dataset.size=48")),
}  # fmt: skip


class Campaign:
    """Runs scenarios in one folder, ``work``, so that paths in their results are the same."""

    def __init__(self, root):
        self.root, self.work, self.seconds = root, root / "work", {}

    def begin(self, name):
        """Empty the folder of work, and put there what a scenario starts from."""
        shutil.rmtree(self.work, ignore_errors=True)
        self.work.mkdir()
        for path, origin in SCENARIOS[name].needs.items():
            (self.work / path).parent.mkdir(parents=True, exist_ok=True)
            if callable(origin):
                origin(self.work / path)
            else:
                shutil.copytree(self.root / origin[0] / origin[1], self.work / path)

    def undisturbed(self, name):
        """Run a scenario without disturbance, the first time, and return the seconds that it took."""
        if name not in self.seconds:
            for origin in SCENARIOS[name].needs.values():
                if not callable(origin):
                    self.undisturbed(origin[0])
            self.begin(name)
            began = time.monotonic()
            assert problems_of(self.start(name)) == []
            self.seconds[name] = time.monotonic() - began
            shutil.copytree(self.work, self.root / name)
        return self.seconds[name]

    def start(self, name):
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("DSR_", "HYDRA_", "PL_"))}
        environment = {**kept, "OMP_NUM_THREADS": "1", "DSR_CACHE": "cache", "GIT_OPTIONAL_LOCKS": "0"}
        return Program(*SCENARIOS[name].arguments, cwd=self.work, env=environment)

    def finish(self, name):
        """Run the command to its end, and return what differs from undisturbed results."""
        return [*problems_of(self.start(name)), *differences(self.root / name, self.work)]

    def complete(self):
        """Return the files that are never made again, ``info.json`` once it is complete, with numbers and times."""
        paths = {path for pattern in KEPT for path in self.work.glob(pattern) if not path.name.startswith(".")}
        whole = [path for path in paths if path.suffix != ".json" or json.loads(path.read_text()).get("complete")]
        return {path: (path.stat().st_ino, path.stat().st_mtime_ns) for path in whole}


def alive(session):
    """Return the processes of a session that live."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # ended meanwhile
            state, _, _, own = stat.read_text().rpartition(")")[2].split()[:4]
            if int(own) == session and state not in "ZX":
                found.append(int(stat.parent.name))
    return found


def problems_of(program, struck=None, limit=LIMIT):
    """Wait for the end of a command and of its processes, and return what is wrong with it."""
    _, errors = program.communicate(limit)
    until = time.monotonic() + limit
    while (left := alive(program.pid)) and time.monotonic() < until:
        time.sleep(0.02)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    lines = errors.splitlines()
    problems = [f"{len(left)} processes alive after the limit"] if left else []
    if (program.returncode == 2 and len(lines) == 1 and COMPLETE in errors) or (program.returncode, lines) == (0, []):
        return problems
    if struck is None or program.returncode != CODES[struck] or (struck != signal.SIGKILL and len(lines) != 1):
        problems.append(f"exit code {program.returncode}: {' | '.join(lines[-4:])}")
    return problems


def strike(program, number, moment, *, group):
    """Send a signal after some seconds, once the command catches SIGTERM, unless it has ended; return whether."""
    until, status = time.monotonic() + moment, Path(f"/proc/{program.pid}/status")
    while not program.ended:
        caught = next(line.split()[1] for line in status.read_text().splitlines() if line.startswith("SigCgt"))
        if time.monotonic() >= until and int(caught, 16) >> (signal.SIGTERM - 1) & 1:
            (os.killpg if group else os.kill)(program.pid, number)
            return True
        time.sleep(0.01)
    return False


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    return Campaign(tmp_path_factory.mktemp("chaos"))


@pytest.mark.parametrize("name", SCENARIOS)
def test_struck_command_goes_on_to_undisturbed_results(campaign, name, request):
    seconds = campaign.undisturbed(name)
    for number in range(request.config.getoption("--kills", 1)):
        draw, kept = random.Random(f"{name} {number}"), {}
        campaign.begin(name)
        for _ in range(draw.choice((1, 2, 2, 3))):
            kind, moment, group = draw.choice(list(CODES)), seconds * draw.random(), draw.random() < 1 / 2
            program = campaign.start(name)
            struck = kind if strike(program, kind, moment, group=group) else None
            assert problems_of(program, struck, GRACE) + damaged(campaign.work) == [], (number, kind, moment, group)
            kept |= campaign.complete()
        assert campaign.finish(name) == [], number
        after = campaign.complete()
        assert [path for path, stamp in kept.items() if after.get(path) != stamp] == []  # was made again


@pytest.mark.parametrize("name", SCENARIOS)
def test_same_command_twice_at_once_gives_the_results_of_one(campaign, name):
    seconds = campaign.undisturbed(name)
    campaign.begin(name)
    first = campaign.start(name)
    time.sleep(random.Random(name).choice((0.0, 0.5)) * seconds)
    for program in (first, campaign.start(name)):
        problems = problems_of(program)
        assert problems == [] or problems[0].startswith("exit code 2: error: "), problems  # refused in a line
    assert campaign.finish(name) == []

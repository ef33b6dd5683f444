"""Several workers give what one gives: each scene once, to the bit, also where one of them is killed."""

import multiprocessing
import os
import signal
import time

import pytest
import torch
from torch.utils.data import DataLoader

from dsr.degradation.downsampling import Downsampling
from dsr.evaluation.predict import Evaluation, StalePredictionError, predict
from dsr.evaluation.score import score
from dsr.evaluation.sharing import ALONE, Workers, choose_workers
from dsr.geometry.camera import Camera
from dsr.methods.base import Method, NoSolutionError
from dsr.metrics.catalogue import catalogue
from dsr.report.worker_pool import WorkerPool
from dsr.sample import Scene
from dsr.utils import interruption
from dsr.utils.files import FullDiskError, replacing
from dsr.utils.pool import Pool
from dsr.utils.progress import SILENT, Progress

SCENES = [f"scene{number}" for number in range(6)]
TWO = Workers(2, 1)
SIZE, SCALE = 16, 2
CAMERA = Camera(SIZE, SIZE, 20.0, 20.0, 7.5, 7.5)


class Scenes:
    """Random scenes in memory."""

    name = "toy"
    evaluation = True
    version = "1"

    def scenes(self):
        return list(SCENES)

    def load(self, scene):
        generator = torch.Generator().manual_seed(SCENES.index(scene))
        depth = 2 + 0.1 * torch.rand((1, SIZE, SIZE), generator=generator, dtype=torch.float64)
        return Scene("toy", scene, torch.full((3, SIZE, SIZE), 0.5), CAMERA, depth)

    def fingerprint(self, scene):
        return f"{scene}-{self.version}"


class Logged(Method):
    """Repeats low-resolution pixels, and writes which process worked on which scene; may do something first."""

    range_type = "orthogonal"

    def __init__(self, log, before=lambda scene: None):
        self.log, self.before = log, before

    def __call__(self, sample, progress=None):
        with self.log.open("a") as file:
            file.write(f"{sample.scene} {os.getpid()}\n")
        self.before(sample.scene)
        time.sleep(0.02)
        return sample.depth_lr.repeat_interleave(SCALE, 1).repeat_interleave(SCALE, 2)


class Recorded(Progress):
    """Remembers the lines of text."""

    def __init__(self):
        self.lines = []

    def say(self, line):
        self.lines.append(line)


def study_of(log, before=lambda scene: None):
    config = {"method": {"name": "toy"}}
    return Evaluation(Scenes(), Downsampling("box"), "box", SCALE, Logged(log, before), "toy_method", 7, config)


def evaluate(study, folder, workers, progress=SILENT):
    outcome = predict(study, folder, progress, workers=workers)
    score(study, folder, catalogue(), outcome, progress, lambda *_: None, workers=workers)
    return outcome


def calls(log):
    return [line.split() for line in log.read_text().splitlines()]


def test_two_workers_give_the_bytes_of_one(tmp_path):
    for name, workers in (("one", ALONE), ("two", TWO)):
        evaluate(study_of(tmp_path / f"{name}.log"), tmp_path / name, workers)
    assert (tmp_path / "one" / "scores.csv").read_bytes() == (tmp_path / "two" / "scores.csv").read_bytes()
    names = [sorted(path.name for path in (tmp_path / each).rglob("*")) for each in ("one", "two")]
    assert names[0] == names[1]
    assert sorted(scene for scene, _ in calls(tmp_path / "two.log")) == SCENES
    processes = {process for _, process in calls(tmp_path / "two.log")}
    assert len(processes) == 2
    assert str(os.getpid()) not in processes


def test_outcomes_of_workers_are_those_of_one(tmp_path):
    def before(scene):
        if scene == "scene1":
            raise NoSolutionError("nothing fits")
        if scene == "scene2":
            raise ValueError("bad values")

    outcomes = [predict(study_of(tmp_path / "log", before), tmp_path / str(w.count), workers=w) for w in (ALONE, TWO)]
    for outcome in outcomes:
        assert outcome.made == [each for each in SCENES if each not in ("scene1", "scene2")]
        assert outcome.unsolved == {"scene1": "scene1: nothing fits"}
        assert outcome.failures == {"scene2": "scene2: bad values"}


def test_stale_prediction_ends_the_work_of_all_workers(tmp_path):
    evaluate(study_of(tmp_path / "log"), tmp_path / "run", ALONE)
    study = study_of(tmp_path / "log")
    study.source.version = "2"
    with pytest.raises(StalePredictionError, match="made with another scene_content"):
        predict(study, tmp_path / "run", workers=TWO)
    assert not (tmp_path / "run" / ".claims").exists()


def test_scene_of_a_killed_worker_is_done_by_another(tmp_path):
    marker, reported = tmp_path / "killed", Recorded()

    def before(scene):
        if scene == "scene3" and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)

    outcome = evaluate(study_of(tmp_path / "log", before), tmp_path / "killed_run", TWO, reported)
    evaluate(study_of(tmp_path / "calm.log"), tmp_path / "calm", ALONE)
    assert (outcome.made, outcome.failures) == (SCENES, {})
    assert reported.lines == ["scene3: the worker was ended before it had a result; another one begins it again"]
    scores = [(tmp_path / name / "scores.csv").read_bytes() for name in ("killed_run", "calm")]
    assert scores[0] == scores[1]
    counts = [scene for scene, _ in calls(tmp_path / "log")]
    assert {scene: counts.count(scene) for scene in SCENES} == {**dict.fromkeys(SCENES, 1), "scene3": 2}
    assert not (tmp_path / "killed_run" / ".claims").exists()


def test_scene_that_kills_its_workers_fails_and_the_others_are_kept(tmp_path):
    def before(scene):
        if scene == "scene3":
            os.kill(os.getpid(), signal.SIGKILL)

    outcome = predict(study_of(tmp_path / "log", before), tmp_path / "run", workers=TWO)
    assert outcome.made == [each for each in SCENES if each != "scene3"]
    assert list(outcome.failures) == ["scene3"]
    assert outcome.failures["scene3"].startswith("scene3: two workers ended")


@pytest.mark.parametrize("overwrite", [False, True])
def test_commands_in_one_directory_share_the_scenes(tmp_path, overwrite):
    context = multiprocessing.get_context("fork")
    barrier = context.Barrier(2)

    def command(workers):
        study = study_of(tmp_path / "log")
        scenes = study.source.scenes
        study.source.scenes = lambda: (barrier.wait(30), scenes())[1]  # both have begun
        outcome = predict(study, tmp_path / "run", overwrite=overwrite, workers=workers)
        scores = score(study, tmp_path / "run", catalogue(), outcome, SILENT, lambda *_: None, workers=workers)
        os._exit(0 if len(outcome.seconds) == scores["scene"].nunique() == len(SCENES) else 1)

    commands = [context.Process(target=command, args=(workers,)) for workers in (ALONE, TWO)]
    for each in commands:
        each.start()
    for each in commands:
        each.join(60)
    assert [each.exitcode for each in commands] == [0, 0]
    assert sorted(scene for scene, _ in calls(tmp_path / "log")) == SCENES
    evaluate(study_of(tmp_path / "calm.log"), tmp_path / "calm", ALONE)
    assert (tmp_path / "run" / "scores.csv").read_bytes() == (tmp_path / "calm" / "scores.csv").read_bytes()
    assert not (tmp_path / "run" / ".claims").exists()


def test_overwriting_again_computes_again(tmp_path):
    for _ in range(2):
        predict(study_of(tmp_path / "log"), tmp_path / "run", overwrite=True, workers=TWO)
    assert len(calls(tmp_path / "log")) == 2 * len(SCENES)


def test_workers_try_again_what_somebody_else_has(tmp_path):
    def work(item):
        file = tmp_path / item
        if not file.exists():
            file.touch()
            return None
        return item.upper()

    with Pool(2, work, lambda item: "lost") as pool:
        assert sorted(pool.results(["a", "b", "c"])) == [("a", "A"), ("b", "B"), ("c", "C")]


def test_worker_that_stops_at_a_signal_ends_without_a_word_and_another_begins_again(tmp_path, capfd):
    def work(item):
        if not (tmp_path / item).exists():
            (tmp_path / item).touch()
            with interruption.deferred() as noted:
                os.kill(os.getpid(), signal.SIGTERM)  # as of a scheduler, to all processes
                assert noted.requested
            raise KeyboardInterrupt("saved")
        return item.upper()

    reported = Recorded()
    with Pool(1, work, lambda item: "lost", reported.say) as pool:
        assert list(pool.results(["a"])) == [("a", "A")]
    assert reported.lines == ["a: the worker was ended before it had a result; another one begins it again"]
    assert capfd.readouterr().err == ""


def test_worker_that_is_ended_while_it_writes_leaves_no_temporary_file(tmp_path):
    def work(item):
        if item == "full":
            while not list(tmp_path.glob(".file-*")):
                time.sleep(0.01)
            raise FullDiskError(tmp_path / "other")
        with replacing(tmp_path / "file.png") as temporary:
            temporary.write_bytes(b"half")
            time.sleep(60)
        return item

    with Pool(2, work, lambda item: "lost") as pool, pytest.raises(FullDiskError):
        list(pool.results(["file", "full"]))
    assert list(tmp_path.iterdir()) == []


def test_workers_end_with_their_context():
    with Pool(2, lambda _: os.getpid(), lambda _: 0) as pool:
        processes = {answer for _, answer in pool.results(range(8))}
    for process in processes:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


def draw(_, number):
    """Compute for a report; at 3 the first process that tries is killed."""
    if number is not None and number[0] == 3 and not number[1].exists():
        if number[1].parent.exists():
            number[1].touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return None if number is None else number[0]


def test_part_of_a_report_whose_worker_is_killed_is_drawn_by_another(tmp_path):
    items = [None, *((number, tmp_path / "killed") for number in range(6))]
    reported = Recorded()
    with WorkerPool(object(), 2, reported.say) as work:
        values, others = work.map(draw, items), work.map(draw, items[::-1])
        assert list(others) == [5, 4, 3, 2, 1, 0, None]
        assert list(values) == [None, 0, 1, 2, 3, 4, 5]
    [line] = reported.lines
    assert line == "a part of the report: the worker was ended before it had a result; another one begins it again"


def test_part_of_a_report_that_kills_its_workers_is_an_error(tmp_path):
    with WorkerPool(object(), 2) as work, pytest.raises(ChildProcessError, match="two workers ended"):
        list(work.map(draw, [(3, tmp_path / "no folder" / "mark")]))


@pytest.fixture
def threads_have_computed():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    compute()
    yield
    torch.set_num_threads(before)


def compute(*_):
    """Compute with all threads that torch has."""
    torch.linspace(0, 1, 1 << 20).sort()
    torch.nn.functional.conv2d(torch.ones(1, 8, 128, 128), torch.ones(8, 8, 3, 3))
    return torch.get_num_threads()


@pytest.mark.usefixtures("threads_have_computed")
@pytest.mark.parametrize("threads", [1, 2, None])
def test_workers_compute_where_several_threads_have_computed_before(tmp_path, threads):
    for name in ("first", "second"):  # whose workers are forked after threads were started anew
        study = study_of(tmp_path / f"{name}.log", compute)
        assert evaluate(study, tmp_path / name, Workers(2, threads)).made == SCENES
        assert len({process for _, process in calls(tmp_path / f"{name}.log")}) == 2
        assert compute() == 2


@pytest.mark.usefixtures("threads_have_computed")
def test_forks_of_the_user_and_of_data_loaders_compute_where_several_threads_have_computed_before():
    with multiprocessing.get_context("fork").Pool(2) as pool:
        assert pool.map(compute, range(4)) == [2] * 4
    compute()
    loader = DataLoader(range(4), num_workers=2, collate_fn=compute, multiprocessing_context="fork")
    assert list(loader) == [1] * 4


@pytest.mark.parametrize(
    ("given", "scenes", "cores", "together", "expected"),
    [
        ((None, None), 6, 2, True, Workers(2, 1)),
        ((None, None), 1, 16, True, Workers(1, 16)),
        ((None, None), 4, 16, True, Workers(4, 4)),
        ((None, None), 6, 2, False, Workers(1, 2)),
        ((8, None), 6, 2, True, Workers(6, 1)),
        ((1, None), 6, 2, True, Workers(1, 1)),
        ((2, 3), 6, 2, False, Workers(2, 3)),
    ],
)
def test_cores_are_shared_among_the_scenes(monkeypatch, given, scenes, cores, together, expected):
    monkeypatch.setattr("dsr.evaluation.sharing.free_memory", lambda: 1 << 40)
    assert choose_workers(*given, scenes, cores, together=together) == expected


def test_little_memory_means_fewer_workers(monkeypatch):
    monkeypatch.setattr("dsr.evaluation.sharing.free_memory", lambda: 3 << 30)
    assert choose_workers(None, None, 100, 64, together=True) == Workers(3, 1)

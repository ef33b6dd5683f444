"""Progress on the console: bars on a terminal, lines off it, with named times."""

from __future__ import annotations

import io
import re
import threading
import time

import pytest
from rich.console import Console

from dsr.app.upsample.frame import Times
from dsr.utils.console import ConsoleProgress
from dsr.utils.progress import SILENT, Progress, clock, duration, megabytes, part_of


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


@pytest.fixture
def now() -> Clock:
    return Clock()


def _progress(now: Clock, *, terminal: bool = False) -> tuple[ConsoleProgress, io.StringIO]:
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, width=120, color_system=None)
    return ConsoleProgress(console, now), text


def _rows(progress: ConsoleProgress) -> list[str]:
    """Return the rows that a terminal would show now."""
    text = io.StringIO()
    Console(file=text, width=120, color_system=None).print(progress._table())
    return [" ".join(line.split()) for line in text.getvalue().splitlines()]


def test_track_prints_a_line_for_each_item_off_a_terminal(now: Clock) -> None:
    progress, text = _progress(now)
    for _ in progress.track(["statue", "room", "plant"], "predict"):
        now.seconds += 90.5
    assert text.getvalue().splitlines() == [
        "predict statue: 1 of 3, 90.5 s, elapsed 0:01:30, remaining 0:03:01",
        "predict room: 2 of 3, 90.5 s, elapsed 0:03:01, remaining 0:01:30",
        "predict plant: 3 of 3, 90.5 s, elapsed 0:04:32, remaining 0:00:00",
    ]


def test_track_prints_no_line_for_each_of_many_short_items(now: Clock) -> None:
    progress, text = _progress(now)
    for number in progress.track(range(200), "prepare"):
        now.seconds += 3.0 if number == 7 else 0.01
    assert [line.split(",")[0] for line in text.getvalue().splitlines()] == [
        "prepare 7: 8 of 200",
        "prepare 199: 200 of 200",
    ]


def test_track_prints_no_line_where_the_caller_prints_one(now: Clock) -> None:
    progress, text = _progress(now)
    assert list(progress.track(["a"], "examine", lines=False)) == ["a"]
    assert text.getvalue() == ""


def test_track_takes_an_iterator_of_known_length(now: Clock) -> None:
    progress, text = _progress(now)
    assert list(progress.track(iter("ab"), "draw", 2, label=str.upper)) == ["a", "b"]
    assert text.getvalue().splitlines()[0].startswith("draw A: 1 of 2, 0.0 s, elapsed 0:00:00")


def test_long_task_prints_a_line_after_three_seconds_and_then_every_ten(now: Clock) -> None:
    progress, text = _progress(now)
    with progress.task("train", 1000) as task:
        for step in range(1, 401):
            now.seconds += 0.125
            task(step, remark=f"loss {1 / step:.4f}")
            progress.tick()
    assert text.getvalue().splitlines() == [
        "train: 24 of 1000, elapsed 0:00:03, remaining 0:02:02, loss 0.0417",
        "train: 104 of 1000, elapsed 0:00:13, remaining 0:01:52, loss 0.0096",
        "train: 184 of 1000, elapsed 0:00:23, remaining 0:01:42, loss 0.0054",
        "train: 264 of 1000, elapsed 0:00:33, remaining 0:01:32, loss 0.0038",
        "train: 344 of 1000, elapsed 0:00:43, remaining 0:01:22, loss 0.0029",
    ]


def test_line_about_steps_names_the_scene_that_they_belong_to(now: Clock) -> None:
    progress, text = _progress(now)
    for _ in progress.track(["statue", "room"], "predict"):
        with progress.task("steps") as step:
            now.seconds += 11
            step(50, 1000)
            progress.tick()
    assert text.getvalue().splitlines() == [
        "predict statue (0 of 2, remaining 0:07:09): steps: 50 of 1000, elapsed 0:00:11, remaining 0:03:29",
        "predict statue: 1 of 2, 11.0 s, elapsed 0:00:11, remaining 0:00:11",
        "predict room (1 of 2, remaining 0:03:29): steps: 50 of 1000, elapsed 0:00:11, remaining 0:03:29",
        "predict room: 2 of 2, 11.0 s, elapsed 0:00:22, remaining 0:00:00",
    ]


def test_long_step_is_reported_while_it_runs(now: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread prints the lines: there is nobody else while a step takes minutes."""
    monkeypatch.setattr("dsr.utils.console._TICK", 0.01)
    progress, text = _progress(now)
    with progress.task("predict", 2):
        now.seconds += 60
        limit = time.monotonic() + 10
        while not text.getvalue() and time.monotonic() < limit:
            time.sleep(0.01)
    assert text.getvalue() == "predict: 0 of 2, elapsed 0:01:00\n"


def test_thread_ends_with_the_task(now: Clock) -> None:
    progress, _ = _progress(now)
    before = threading.active_count()
    counts = []

    def fail() -> None:
        with progress.task("train", 2):
            counts.append(threading.active_count())
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        fail()
    assert (*counts, threading.active_count()) == (before + 1, before)


def test_terminal_shows_a_row_for_each_task_with_named_times(now: Clock) -> None:
    progress, _ = _progress(now, terminal=True)
    for scene in progress.track(["statue", "room"], "predict"):
        with progress.task("steps") as step:
            assert len(_rows(progress)) == 1  # until it is known how many steps there are
            now.seconds += 269
            step(65, 100, "loss 0.25")
            rows = _rows(progress)
        if scene == "statue":
            assert rows[0].endswith("0 of 2 elapsed 0:04:29 remaining 0:09:19 statue")
            assert rows[1].startswith("steps ")
            assert rows[1].endswith("65 of 100 elapsed 0:04:29 remaining 0:02:25 loss 0.25")
    assert rows[0].endswith("1 of 2 elapsed 0:08:58 remaining 0:02:25 room")


def test_terminal_keeps_one_line_of_a_pass_that_took_long(now: Clock) -> None:
    progress, text = _progress(now, terminal=True)
    for _ in progress.track(["statue"], "predict"):
        now.seconds += 75
        progress.say("statue: [about] 3 min")
    assert "statue: [about] 3 min\n" in text.getvalue()
    assert text.getvalue().endswith("predict: 1 of 1, elapsed 0:01:15\n")


def test_bytes_are_shown_with_their_speed_which_leaves_out_what_was_there_before(now: Clock) -> None:
    progress, text = _progress(now)
    with progress.task("set/a.zip", unit="bytes") as moved:
        moved(500_000_000, 800_000_000)
        now.seconds += 100
        moved(600_000_000, 800_000_000)
        progress.tick()
    assert text.getvalue() == ("set/a.zip: 600 MB of 800 MB, 1.0 MB/s, elapsed 0:01:40, remaining 0:03:20\n")


def test_work_that_starts_again_is_measured_anew(now: Clock) -> None:
    progress, text = _progress(now)
    with progress.task("scenes", 10) as task:
        now.seconds += 100
        task(9)
        task(0)
        now.seconds += 10
        task(1)
        progress.tick()
    assert text.getvalue() == "scenes: 1 of 10, elapsed 0:01:50, remaining 0:01:30\n"


def test_work_that_goes_on_counts_only_new_steps_for_the_time_that_remains(now: Clock) -> None:
    progress, text = _progress(now)
    with progress.task("train", 1000, done=900) as task:
        now.seconds += 10
        task(950)
        progress.tick()
    assert text.getvalue() == "train: 950 of 1000, elapsed 0:00:10, remaining 0:00:10\n"


@pytest.mark.parametrize("terminal", [True, False])
def test_next_pass_is_shown_after_an_error(now: Clock, *, terminal: bool) -> None:
    progress, _ = _progress(now, terminal=terminal)

    def fail() -> None:
        for _ in progress.track(["a", "b"], "predict"):
            with progress.task("steps", 10):
                raise ValueError("broken")

    for _ in range(2):
        with pytest.raises(ValueError, match="broken"):
            fail()
    assert list(progress.track(["c"], "score")) == ["c"]
    assert progress._tasks == []


def test_silent_progress_shows_nothing_and_passes_items_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(SILENT.track("ab", "predict")) == ["a", "b"]
    with SILENT.task("steps") as task:
        task(1, 2, "loss 0.1")
    SILENT.say("a line")
    assert capsys.readouterr().out == ""


def test_part_of_counts_the_steps_of_earlier_stages() -> None:
    reported: list[tuple[int, int]] = []
    stage = part_of(lambda done, total: reported.append((done, total)), 10, 30)
    assert stage is not None
    stage(5, 10)
    assert reported == [(15, 30)]
    assert part_of(None, 10, 30) is None


def test_times_and_sizes_are_written_for_readers() -> None:
    assert [clock(seconds) for seconds in (0, 269, 3600, 90061)] == ["0:00:00", "0:04:29", "1:00:00", "25:01:01"]
    assert [duration(seconds) for seconds in (40, 720, 12600)] == ["40 s", "12 min", "3.5 h"]
    assert [megabytes(size) for size in (31e3, 3.2e6, 45e6, 1.3e9)] == ["31 kB", "3.2 MB", "45 MB", "1.3 GB"]


STAGES = {"reading": 0.1, "upsampling": 0.5, "writing": 0.4}


def seconds_in(line: str, what: str) -> int | None:
    """Return a named time of a line in seconds."""
    found = re.search(rf"{what} (\d+):(\d+):(\d+)", line)
    return (
        None if found is None else sum(60**at * int(each) for at, each in zip((2, 1, 0), found.groups(), strict=True))
    )


def times_of_stages(now: Clock, *frames: tuple[int, ...]) -> list[tuple[int, int | None]]:
    """Return elapsed and remaining time of frames, whose stages take some seconds each, at each second."""
    progress, _ = _progress(now, terminal=True)
    shown = []
    for durations in progress.track(frames, "upsample", shares=STAGES):
        for name, seconds in zip(STAGES, durations, strict=True):
            progress.stage(name)
            for _ in range(seconds):
                now.seconds += 1
                [row] = _rows(progress)
                shown.append((seconds_in(row, "elapsed"), seconds_in(row, "remaining")))
    return shown


def test_elapsed_and_remaining_time_add_up_once_a_frame_is_done(now: Clock) -> None:
    shown = times_of_stages(now, *[(1, 5, 4)] * 4)
    assert all(elapsed + remaining == 40 for elapsed, remaining in shown[6:-1])
    assert shown[-1] == (40, 1)  # the last stage is not over yet


def test_usual_shares_give_the_rest_of_the_first_frame_once_most_of_it_is_over(now: Clock) -> None:
    shown = times_of_stages(now, (5, 25, 20))
    assert all(remaining is None for _, remaining in shown[:29])  # the first tenth tells too little
    assert all(elapsed + remaining == 50 for elapsed, remaining in shown[30:-1])


def test_remaining_time_does_not_stand_at_zero_while_a_stage_takes_longer_than_others_did(now: Clock) -> None:
    shown = times_of_stages(now, (1, 5, 4), (1, 5, 4), (1, 5, 60))
    assert min(remaining for _, remaining in shown if remaining is not None) >= 1
    assert shown[-1][1] == 6  # a tenth of what the stage has taken


def test_time_of_a_stage_that_is_known_before_counts(now: Clock) -> None:
    progress, _ = _progress(now, terminal=True)
    for _ in progress.track("ab", "upsample", shares=STAGES):
        progress.stage("upsampling", 10)
        now.seconds += 4
        [row] = _rows(progress)
        break
    assert seconds_in(row, "remaining") == 6 + 8 + 20


def test_stage_that_takes_longer_than_planned_makes_the_next_ones_longer(now: Clock) -> None:
    progress, _ = _progress(now, terminal=True)
    for _ in progress.track("ab", "upsample", shares=STAGES):
        progress.stage("upsampling", 10)
        now.seconds += 30
        [row] = _rows(progress)
        break
    upsampling = 30 + 2  # a tenth of what it has taken longer
    whole = upsampling / STAGES["upsampling"]
    left = 2 + STAGES["writing"] * whole
    assert seconds_in(row, "remaining") == round(left + whole)


def test_planned_seconds_grow_with_the_work_beside_a_frame() -> None:
    stages: list[tuple[str, float | None]] = []

    class Stages(Progress):
        def stage(self, name: str, seconds: float | None = None) -> None:
            stages.append((name, seconds))

    times = Times(Stages())
    times.begin("reading")
    with times.computing():  # 0.05 s of a core in 0.2 s
        until = time.thread_time() + 0.05
        while time.thread_time() < until:
            pass
        time.sleep(0.15)
    times.begin("upsampling", 10)
    times.begin("writing")
    planned = dict(stages)
    assert planned["reading"] is planned["writing"] is None
    assert planned["upsampling"] is not None
    assert planned["upsampling"] >= 35


def test_elapsed_time_counts_from_the_beginning_of_the_command(now: Clock) -> None:
    text = io.StringIO()
    progress = ConsoleProgress(Console(file=text, width=120), now, since=now())
    now.seconds += 7
    for _ in progress.track("a", "upsample"):
        now.seconds += 2
    assert text.getvalue() == "upsample a: 1 of 1, 2.0 s, elapsed 0:00:09, remaining 0:00:00\n"


def test_items_that_fail_while_they_are_read_do_not_make_the_rest_look_short(now: Clock) -> None:
    progress, text = _progress(now)
    for name in progress.track("afgb", "upsample", shares=STAGES):
        for stage, seconds in zip(STAGES, (1, 5, 4), strict=True):
            progress.stage(stage)
            now.seconds += seconds
            if name == "f":
                break
        if name == "g":
            break
    lines = text.getvalue().splitlines()
    assert [seconds_in(line, "remaining") for line in lines] == [30, 20]


def test_stage_that_is_left_out_says_nothing_about_the_others(now: Clock) -> None:
    progress, _ = _progress(now, terminal=True)
    shown = []
    for kept in progress.track((True, True, True, False, True), "upsample", shares=STAGES):
        for stage, seconds in zip(STAGES, (1, 0 if kept else 5, 4), strict=True):
            progress.stage(stage, 0.0 if stage == "upsampling" and kept else None)
            [row] = _rows(progress)
            shown.append(seconds_in(row, "remaining"))
            now.seconds += seconds
    assert shown[:6] == [None, None, None, 20, 19, 19]
    assert shown[-3:] == [10, 9, 4]

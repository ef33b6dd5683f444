"""Progress on the console: bars on a terminal, lines off it, with named times."""

import io

import pytest
from rich.console import Console

from dsr.utils.console import ConsoleProgress
from dsr.utils.progress import clock, duration, megabytes, part_of, show_length


class Clock:
    """A clock that is set by hand."""

    seconds = 100.0

    def __call__(self) -> float:
        return self.seconds


@pytest.fixture
def now() -> Clock:
    return Clock()


def progress_of(now: Clock, *, terminal: bool = False) -> tuple[ConsoleProgress, io.StringIO]:
    text = io.StringIO()
    console = Console(file=text, force_terminal=terminal, width=120, color_system=None)
    return ConsoleProgress(console, now), text


def test_track_prints_a_line_for_each_item_off_a_terminal(now: Clock) -> None:
    progress, text = progress_of(now)
    for _ in progress.track(["statue", "room", "plant"], "predict"):
        now.seconds += 90.5
    assert text.getvalue().splitlines() == [
        "predict statue: 1 of 3, 90.5 s, elapsed 0:01:30, remaining 0:03:01",
        "predict room: 2 of 3, 90.5 s, elapsed 0:03:01, remaining 0:01:30",
        "predict plant: 3 of 3, 90.5 s, elapsed 0:04:32, remaining 0:00:00",
    ]


def test_track_prints_no_line_for_each_of_many_short_items_nor_where_the_caller_prints_one(now: Clock) -> None:
    progress, text = progress_of(now)
    for number in progress.track(range(200), "prepare"):
        now.seconds += 3.0 if number == 7 else 0.01
    assert list(progress.track(iter("ab"), "examine", 2, lines=False)) == ["a", "b"]
    lines = [line.split(",")[0] for line in text.getvalue().splitlines()]
    assert lines == ["prepare 7: 8 of 200", "prepare 199: 200 of 200"]


def test_long_task_prints_a_line_after_three_seconds_and_then_every_ten(now: Clock) -> None:
    progress, text = progress_of(now)
    with progress.task("train", 1000, done=500) as task:
        for step in range(501, 701):
            now.seconds += 0.125
            task(step, remark=f"loss {1 / step:.4f}")
    assert text.getvalue().splitlines() == [
        "train: 524 of 1000, elapsed 0:00:03, remaining 0:01:00, loss 0.0019",
        "train: 604 of 1000, elapsed 0:00:13, remaining 0:00:50, loss 0.0017",
        "train: 684 of 1000, elapsed 0:00:23, remaining 0:00:40, loss 0.0015",
    ]


def test_line_about_steps_names_the_scene_that_they_belong_to(now: Clock) -> None:
    progress, text = progress_of(now)
    for _ in progress.track(["statue"], "predict"):
        with progress.task("steps") as step:
            now.seconds += 11
            step(50, 1000)
    assert text.getvalue().splitlines() == [
        "predict statue (0 of 1): steps: 50 of 1000, elapsed 0:00:11, remaining 0:03:29",
        "predict statue: 1 of 1, 11.0 s, elapsed 0:00:11, remaining 0:00:00",
    ]


def test_terminal_shows_a_bar_for_each_task_and_keeps_one_line_of_a_pass_that_took_long(now: Clock) -> None:
    progress, text = progress_of(now, terminal=True)
    for _ in progress.track(["statue"], "predict"):
        with progress.task("steps", 100) as step:
            now.seconds += 65
            step(65, remark="loss 0.25")
            progress._bars.refresh()
            progress.say("statue: [about] 3 min")
    shown = text.getvalue()
    assert "0 of 1, elapsed 0:01:05, statue" in shown
    assert "65 of 100, elapsed 0:01:05, remaining 0:00:35, loss 0.25" in shown
    assert "statue: [about] 3 min\n" in shown
    assert shown.endswith("predict: 1 of 1, elapsed 0:01:05\n")


def test_bytes_are_shown_with_their_speed_which_leaves_out_what_was_there_before(now: Clock) -> None:
    progress, text = progress_of(now)
    with progress.task("set/a.zip", unit="bytes") as moved:
        moved(500_000_000, 800_000_000)
        now.seconds += 100
        moved(600_000_000, 800_000_000)
    assert text.getvalue() == "set/a.zip: 600 MB of 800 MB, 1.0 MB/s, elapsed 0:01:40, remaining 0:03:20\n"


@pytest.mark.parametrize("terminal", [True, False])
def test_next_pass_is_shown_after_an_error(now: Clock, *, terminal: bool) -> None:
    progress, _ = progress_of(now, terminal=terminal)

    def fail() -> None:
        for _ in progress.track(["a", "b"], "predict"):
            with progress.task("steps", 10):
                raise ValueError("broken")

    for _ in range(2):
        with pytest.raises(ValueError, match="broken"):
            fail()
    assert list(progress.track(["c"], "score")) == ["c"]


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


@pytest.mark.parametrize(
    ("metres", "digits", "text"),
    [
        (0.0996, 2, "0.1 m"),
        (0.0994, 2, "99 mm"),
        (999.9, 3, "1 km"),
        (123_456, 2, "120 km"),
        (0.00123, 2, "1.2 mm"),
        (0, 3, "0 mm"),
    ],
)
def test_length_is_rounded_before_its_unit_is_chosen(metres: float, digits: int, text: str) -> None:
    assert show_length(metres, digits) == text

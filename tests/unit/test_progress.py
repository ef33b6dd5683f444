"""Progress on the console: bars on a terminal, lines off it, with named times."""

import io

from rich.console import Console

from dsr.utils.console import ConsoleProgress
from dsr.utils.progress import clock, duration, megabytes, part_of, show_length


class Clock:
    """A clock that is set by hand."""

    seconds = 100.0

    def __call__(self):
        return self.seconds


def shown(terminal=False):
    """Return a clock, progress by it, and its text."""
    now, text = Clock(), io.StringIO()
    console = Console(file=text, force_terminal=terminal, width=120, color_system=None)
    return now, ConsoleProgress(console, now), text


def test_each_item_of_a_few_gets_a_line_off_a_terminal_and_so_does_a_long_one_of_many():
    now, progress, text = shown()
    for _ in progress.track(["statue", "room", "plant"], "predict"):
        now.seconds += 90.5
    for number in progress.track(range(200), "prepare"):
        now.seconds += 3.0 if number == 7 else 0.01
    assert list(progress.track(iter("ab"), "examine", 2, lines=False)) == ["a", "b"]
    assert text.getvalue().splitlines() == [
        "predict statue: 1 of 3, 90.5 s, elapsed 0:01:30, remaining 0:03:01",
        "predict room: 2 of 3, 90.5 s, elapsed 0:03:01, remaining 0:01:30",
        "predict plant: 3 of 3, 90.5 s, elapsed 0:04:32, remaining 0:00:00",
        "prepare 7: 8 of 200, 3.0 s, elapsed 0:00:03, remaining 0:01:14",
        "prepare 199: 200 of 200, 0.0 s, elapsed 0:00:05, remaining 0:00:00",
    ]


def test_running_work_gets_a_line_after_three_seconds_and_then_every_ten_with_the_item_it_belongs_to():
    now, progress, text = shown()
    with progress.task("train", 1000, done=500) as task:
        for step in range(501, 701):
            now.seconds += 0.125
            task(step, remark=f"loss {1 / step:.4f}")
    for _ in progress.track(["statue"], "predict"):
        with progress.task("steps") as step:
            now.seconds += 11
            step(50, 1000)
    with progress.task("set/a.zip", unit="bytes") as moved:
        moved(500_000_000, 800_000_000)  # which were there before
        now.seconds += 100
        moved(600_000_000, 800_000_000)
    assert text.getvalue().splitlines() == [
        "train: 524 of 1000, elapsed 0:00:03, remaining 0:01:00, loss 0.0019",
        "train: 604 of 1000, elapsed 0:00:13, remaining 0:00:50, loss 0.0017",
        "train: 684 of 1000, elapsed 0:00:23, remaining 0:00:40, loss 0.0015",
        "predict statue (0 of 1): steps: 50 of 1000, elapsed 0:00:11, remaining 0:03:29",
        "predict statue: 1 of 1, 11.0 s, elapsed 0:00:11, remaining 0:00:00",
        "set/a.zip: 600 MB of 800 MB, 1.0 MB/s, elapsed 0:01:40, remaining 0:03:20",
    ]


def test_stages_times_sizes_and_lengths_are_written_for_readers():
    reported = []
    part_of(lambda *steps: reported.append(steps), 10, 30)(5, 10)
    assert (reported, part_of(None, 10, 30)) == ([(15, 30)], None)
    assert [clock(seconds) for seconds in (0, 269, 3600, 90061)] == ["0:00:00", "0:04:29", "1:00:00", "25:01:01"]
    assert [duration(seconds) for seconds in (40, 720, 12600)] == ["40 s", "12 min", "3.5 h"]
    assert [megabytes(size) for size in (31e3, 3.2e6, 45e6, 1.3e9)] == ["31 kB", "3.2 MB", "45 MB", "1.3 GB"]
    lengths = ((0.0996, 2), (0.0994, 2), (999.9, 3), (123_456, 2), (0.00123, 2), (0, 3))  # rounded before their unit
    assert [show_length(*each) for each in lengths] == ["0.1 m", "99 mm", "1 km", "120 km", "1.2 mm", "0 mm"]

"""Progress bars with the time left, on a terminal; elsewhere the lines alone that somebody says."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import lightning
from lightning.pytorch.callbacks import ProgressBar
from rich.console import Console
from rich.progress import Progress

from dsr.data.base import Prepared, SceneSource
from dsr.utils.console import bar, show
from dsr.utils.lightning import scores_line


class Display:
    """Bars for passes over scenes, and below them bars for the steps of the scene at hand.

    Args:
        console: where they are shown.

    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._passes: Progress | None = None

    def __call__(self, items: Iterable[str], description: str, total: int | None = None) -> Iterator[str]:
        """Yield the items, ``total`` of them; the bar names the one at hand."""
        if total is None:
            items = list(items)
            total = len(items)
        with bar(self._console) as progress:
            self._passes = progress
            task = progress.add_task(description, total=total, remark="")
            try:
                for item in items:
                    progress.update(task, remark=item)
                    yield item
                    progress.advance(task)
                progress.update(task, remark="")
            finally:
                self._passes = None

    def say(self, line: str) -> None:
        """Show a line, above the bars if there are any."""
        show(self._console, line)

    @contextlib.contextmanager
    def steps(self, name: str, total: int, done: int) -> Iterator[Callable[[int, str], None]]:
        """Show the steps of one thing; the context's value takes how many are done, and a remark."""
        own = bar(self._console) if self._passes is None else contextlib.nullcontext(self._passes)
        with own as progress:
            task = progress.add_task("steps", total=total, completed=done, remark=name)
            try:
                yield lambda now, remark: progress.update(task, completed=now, remark=remark)
            finally:
                progress.remove_task(task)

    @contextlib.contextmanager
    def parts(self, name: str = "") -> Iterator[Callable[..., None]]:
        """Show the parts of one thing that says itself how many it has: how many are done, of how many, a remark."""
        with contextlib.ExitStack() as stack:
            shown: list[Callable[[int, str], None]] = []

            def progress(done: int, total: int, remark: str = name) -> None:
                if not shown:
                    shown.append(stack.enter_context(self.steps(remark, total, done)))
                shown[0](done, remark)

            yield progress


def prepare(display: Display, source: SceneSource, names: Sequence[str]) -> None:
    """Let a data set that renders or resizes its scenes do so for some of them, with a bar."""
    if isinstance(source, Prepared):
        for _ in display(source.prepare(names), "prepare", len(names)):
            pass


class TrainingBar(ProgressBar):
    """Steps of a whole training with the latest loss; off a terminal, a line per validation pass."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._bar = bar(console)
        self._task: Any = None

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Begin at the step that the training begins with."""
        self._task = self._bar.add_task("train", total=trainer.max_steps, completed=trainer.global_step, remark="")
        self._bar.start()

    def on_train_batch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, *_: Any) -> None:
        """Move on by a step."""
        loss = trainer.callback_metrics.get("train/loss")
        remark = "" if loss is None else f"loss {float(loss):.4f}"
        self._bar.update(self._task, completed=trainer.global_step, remark=remark)

    def on_validation_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Print the scores of the pass."""
        text = scores_line(trainer)
        self._bar.console.print(f"step {trainer.global_step:>6}  validation: {text}", highlight=False, soft_wrap=True)

    def on_train_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Leave the bar as it is."""
        self._bar.stop()

    def on_exception(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, _: BaseException) -> None:
        """Give the terminal back."""
        self._bar.stop()

    def disable(self) -> None:
        """Show nothing."""
        self._bar.disable = True

"""Bars and lines on the console."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from dsr.app.progress import Display


def _display(*, terminal: bool) -> tuple[Display, io.StringIO]:
    text = io.StringIO()
    return Display(Console(file=text, force_terminal=terminal, width=100)), text


def test_output_off_a_terminal_is_lines_alone() -> None:
    display, text = _display(terminal=False)
    for item in display(["a", "b"], "predict"):
        display.say(f"{item}: [about] 3 min")
        with display.steps(item, 10, 0) as update:
            update(5, "loss 0.1")
    assert text.getvalue().strip() == "a: [about] 3 min\nb: [about] 3 min"


def test_steps_are_shown_below_their_pass() -> None:
    display, text = _display(terminal=True)
    for item in display(["statue"], "predict"):
        with display.steps(item, 120, 40) as update:
            update(60, "loss 0.25")
            display._passes.refresh()  # type: ignore[union-attr]
    shown = text.getvalue()
    assert "predict" in shown
    assert "60/120" in shown
    assert "loss 0.25" in shown


def test_steps_need_no_pass_around_them() -> None:
    display, text = _display(terminal=True)
    with display.steps("statue", 120, 40) as update:
        update(120, "loss 0.25")
    assert "statue" in text.getvalue()


def test_parts_are_shown_once_their_number_is_known() -> None:
    display, text = _display(terminal=True)
    for item in display(["statue"], "predict"):
        with display.parts(item) as update:
            before = text.getvalue()
            update(50, 1000)
            display._passes.refresh()  # type: ignore[union-attr]
    assert "50/1000" in text.getvalue()
    assert "1000" not in before


def test_terminal_is_restored_after_an_error() -> None:
    display, _ = _display(terminal=True)

    def fail() -> None:
        for item in display(["a", "b"], "predict"):
            with display.steps(item, 10, 0):
                raise ValueError("broken")

    for _ in range(2):
        with pytest.raises(ValueError, match="broken"):
            fail()
    assert list(display(["c"], "score")) == ["c"]

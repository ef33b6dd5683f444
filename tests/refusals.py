"""How a reader refuses a file: in one line that begins with the file's name, and without printing anything."""

from collections.abc import Callable
from typing import Any

import pytest


def refused(act: Callable[[], object], named: object, capfd: pytest.CaptureFixture[Any]) -> str:
    """Return the message of a refusal without the name that it begins with."""
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the callers look at the message
        act()
    assert capfd.readouterr() == ("", "")
    message = str(caught.value)
    assert message.startswith(f"{named}: ")
    assert message.count(str(named)) == 1
    assert "\n" not in message
    return message.removeprefix(f"{named}: ")

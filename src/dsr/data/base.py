"""What every data set is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from dsr.sample import Scene


class SceneSource(Protocol):
    """A data set: named scenes that are loaded one at a time.

    Attributes:
        name: as in ``scores.csv``.

    """

    name: str

    def scenes(self) -> list[str]:
        """Return the names of the scenes, in order."""
        ...

    def load(self, scene: str) -> Scene:
        """Return one scene.

        Raises:
            ValueError: what is on disk is not what it should be; the message names the file.

        """
        ...

    def fingerprint(self, scene: str) -> str:
        """Return a text that changes when the scene's content does."""
        ...


class Some:
    """Some scenes of a data set.

    Args:
        source: the data set.
        names: of the scenes.

    """

    def __init__(self, source: SceneSource, names: Sequence[str]) -> None:
        self.name = source.name
        self._source, self._names = source, list(names)

    def scenes(self) -> list[str]:
        """Return the names of the scenes, in order."""
        return list(self._names)

    def load(self, scene: str) -> Scene:
        """Return one scene; see :class:`SceneSource`."""
        return self._source.load(scene)

    def fingerprint(self, scene: str) -> str:
        """Return a text that changes when the scene's content does."""
        return self._source.fingerprint(scene)


def chosen(available: Sequence[str], wanted: Sequence[str] | None) -> list[str]:
    """Return the scenes to use: those wanted, or all.

    Raises:
        ValueError: a wanted scene is not available or is named twice, or none is wanted.

    """
    if wanted is not None and (not wanted or len(set(wanted)) < len(wanted)):
        came = ", ".join(wanted) or "an empty list"
        raise ValueError(f"dataset.scenes: expected names, each once, or null for all; got {came}")
    for name in wanted or ():
        if name not in available:
            raise ValueError(f"dataset.scenes: {name!r} is not there; expected some of {', '.join(available)}")
    return list(available) if wanted is None else list(wanted)

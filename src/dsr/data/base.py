"""What every data set is."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Literal, Protocol, runtime_checkable

from dsr.sample import Scene

SceneSelection = Sequence[str] | Literal["found"] | None
"""Names of scenes; ``found`` for all that are on disk, None for those that the data set names."""

_MOST_LISTED = 60


class SceneSource(Protocol):
    """A data set: named scenes that are loaded one at a time.

    Attributes:
        name: as in ``scores.csv``.
        evaluation: whether its scenes are those that methods are compared on, which none may be trained on.

    """

    name: str
    evaluation: bool

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


def content_of(source: SceneSource, scene: str) -> str:
    """Return a text that is the same for the same scene of two data sets, however each prepares it, if they know."""
    content: Callable[[str], str] = getattr(source, "content", source.fingerprint)
    return content(scene)


@runtime_checkable
class Prepared(Protocol):
    """A data set that makes its scenes ready once."""

    def prepare(self, scenes: Sequence[str]) -> Iterable[str]:
        """Make some scenes ready, several at a time, and yield the names as they are done."""
        ...


class Some:
    """Some scenes of a data set.

    Args:
        source: the data set.
        names: of the scenes.

    """

    def __init__(self, source: SceneSource, names: Sequence[str]) -> None:
        self.name, self.evaluation = source.name, source.evaluation
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


def chosen(available: Sequence[str], wanted: SceneSelection) -> list[str]:
    """Return the scenes to use: those wanted, or all.

    Raises:
        ValueError: a wanted scene is not available or is named twice, or none is wanted.

    """
    if wanted == "found":
        wanted = None
    if wanted is not None and (not wanted or len(set(wanted)) < len(wanted)):
        came = ", ".join(wanted) or "an empty list"
        raise ValueError(f"scenes: expected names, each once, or null for all; got {came}")
    for name in wanted or ():
        if name not in available:
            rest = f", ... ({len(available)} in all)" if len(available) > _MOST_LISTED else ""
            some = ", ".join(available[:_MOST_LISTED])
            raise ValueError(f"scenes: {name!r} is not there; expected some of {some}{rest}")
    return list(available) if wanted is None else list(wanted)

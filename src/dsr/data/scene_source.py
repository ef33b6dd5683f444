"""The protocol of data sets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Literal, Protocol, runtime_checkable

from dsr.sample import Scene
from dsr.utils.guards import readable
from dsr.utils.progress import Progress

SceneSelection = Sequence[str] | Literal["found"] | None
"""Names of scenes; None for those that belong to the data set, ``found`` for all that are on disk."""

WITHOUT_OFFSET = "depth is not metric: the disparity offset is left out, as in the paper"
"""Note of a scene whose ``doffs`` is replaced by 0: z = baseline fx / d instead of baseline fx / (d + doffs)."""
_MAX_LISTED = 60


class SceneSource(Protocol):
    """A data set: named scenes that are loaded one at a time.

    Attributes:
        name: name in ``scores.csv``.
        evaluation: whether methods are compared on its scenes, so that none may be trained on them.

    Where the true depth's steps are soft, it also has ``soft_edges``, true.

    """

    name: str
    evaluation: bool

    def scenes(self) -> list[str]:
        """Return the names of the scenes, in order."""
        ...

    def load(self, scene: str) -> Scene:
        """Return one scene, or raise a ValueError that names a file that is missing or damaged."""
        ...

    def fingerprint(self, scene: str) -> str:
        """Return a text that changes whenever the scene's content changes."""
        ...


def content_key(source: SceneSource, scene: str) -> str:
    """Return a text that is equal for two data sets' scenes of the same files; else the fingerprint."""
    content: Callable[[str], str] = getattr(source, "content", source.fingerprint)
    return content(scene)


@runtime_checkable
class Prepared(Protocol):
    """A data set that prepares its scenes once, before they are loaded.

    It may have a method ``unprepared``, which returns those of some scenes that are not ready.
    """

    def prepare(self, scenes: Sequence[str], say: Callable[[str], None], /) -> Iterable[str]:
        """Prepare scenes, several at a time, and yield the name of each that is ready; ``say`` shows a line of text."""
        ...


def prepare_scenes(source: SceneSource, names: Sequence[str], progress: Progress) -> None:
    """Have a data set that renders or resizes its scenes make some of them ready."""
    if isinstance(source, Prepared):
        for _ in progress.track(source.prepare(names, progress.say), "prepare", len(names)):
            pass


def unprepared(source: SceneSource, names: Sequence[str]) -> list[str]:
    """Return those of some scenes that are to be prepared before they are loaded, as far as the data set knows."""
    return getattr(source, "unprepared", lambda _: [])(names)


def regions_of(source: SceneSource) -> tuple[str, ...]:
    """Return the names of the regions that a data set's scenes may have, in the order of tables: its ``regions``."""
    return tuple(getattr(source, "regions", ()))


class SceneSubset:
    """Some of the scenes of a data set."""

    def __init__(self, source: SceneSource, names: Sequence[str]) -> None:
        self.name, self.evaluation = source.name, source.evaluation
        self.regions = regions_of(source)
        self.soft_edges = bool(getattr(source, "soft_edges", False))
        self._source, self._names = source, list(names)

    def scenes(self) -> list[str]:
        """Return the names of the scenes, in order."""
        return list(self._names)

    def load(self, scene: str) -> Scene:
        """Return one scene; see :class:`SceneSource`."""
        return self._source.load(scene)

    def fingerprint(self, scene: str) -> str:
        """Return a text that changes whenever the scene's content changes."""
        return self._source.fingerprint(scene)


def select_scenes(available: Sequence[str], wanted: SceneSelection) -> list[str]:
    """Return the ``wanted`` scenes, or all available ones for None."""
    if wanted == "found":
        wanted = None
    if wanted is not None and (not wanted or len(set(wanted)) < len(wanted)):
        came = ", ".join(wanted) or "an empty list"
        raise ValueError(f"scenes: expected names, each once, or null for all; got {came}")
    for name in wanted or ():
        if name not in available:
            rest = f", ... ({len(available)} in all)" if len(available) > _MAX_LISTED else ""
            some = ", ".join(available[:_MAX_LISTED])
            raise ValueError(f"scenes: {name!r} is not there; expected some of {some}{rest}")
    chosen = list(available) if wanted is None else list(wanted)
    for name in chosen:
        if name != readable(name):
            raise ValueError(f"scenes: expected names in UTF-8, got {name!r}; rename it, or name other scenes")
    return chosen

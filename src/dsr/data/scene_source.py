"""The base class of data sets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal

from dsr.sample import Scene
from dsr.utils.guards import readable
from dsr.utils.progress import Progress

SceneSelection = Sequence[str] | Literal["found"] | None
"""Names of scenes; None for those that belong to the data set, ``found`` for all that are on disk."""

WITHOUT_OFFSET = "depth is not metric: the disparity offset is left out, as in the paper"
"""Note of a scene whose ``doffs`` is replaced by 0: z = baseline fx / d instead of baseline fx / (d + doffs)."""
_MAX_LISTED = 60


class SceneSource:
    """A data set: named scenes that are loaded one at a time.

    Attributes:
        name: name in ``scores.csv``.
        evaluation: whether methods are compared on its scenes, so that none may be trained on them.
        regions: names of the regions that its scenes may have, in the order of tables.
        soft_edges: whether pixels at depth steps are mixtures of both sides.

    """

    name: str
    evaluation: bool
    regions: tuple[str, ...] = ()
    soft_edges: bool = False

    def scenes(self) -> list[str]:
        """Return the names of the scenes, in order."""
        raise NotImplementedError

    def load(self, scene: str) -> Scene:
        """Return one scene, or raise a ValueError that names a file that is missing or damaged."""
        raise NotImplementedError

    def fingerprint(self, scene: str) -> str:
        """Return a text that changes whenever the scene's content changes."""
        raise NotImplementedError

    def content(self, scene: str) -> str:
        """Return a text that is equal for two data sets' scenes of the same files."""
        return self.fingerprint(scene)

    def prepare(self, scenes: Sequence[str], say: Callable[[str], None]) -> Iterable[str] | None:
        """Prepare scenes, several at a time, and yield the name of each that is ready; ``say`` shows a line of text.

        None where scenes need no preparation.
        """
        return None


def prepare_scenes(source: SceneSource, names: Sequence[str], progress: Progress) -> None:
    """Have a data set that renders or resizes its scenes make some of them ready."""
    ready = source.prepare(names, progress.say)
    if ready is not None:
        for _ in progress.track(ready, "prepare", len(names)):
            pass


class SceneSubset(SceneSource):
    """Some of the scenes of a data set."""

    def __init__(self, source: SceneSource, names: Sequence[str]) -> None:
        self.name, self.evaluation = source.name, source.evaluation
        self.regions, self.soft_edges = source.regions, source.soft_edges
        self._source, self._names = source, list(names)

    def scenes(self) -> list[str]:
        """Return the names of the scenes, in order."""
        return list(self._names)

    def load(self, scene: str) -> Scene:
        """Return one scene."""
        return self._source.load(scene)

    def fingerprint(self, scene: str) -> str:
        """Return the fingerprint of the data set's scene."""
        return self._source.fingerprint(scene)


class _Outside(SceneSource):
    """A data set of others, which has members of :class:`SceneSource` and does not derive from it."""

    def __init__(self, made: Any) -> None:
        members = ("name", "evaluation", "regions", "soft_edges", "scenes", "load", "fingerprint", "content", "prepare")
        for member in members:
            if hasattr(made, member):
                setattr(self, member, getattr(made, member))


def as_source(made: Any) -> SceneSource:
    """Return what a node of the configuration makes as a data set, with the defaults of what it leaves out."""
    return made if isinstance(made, SceneSource) else _Outside(made)


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

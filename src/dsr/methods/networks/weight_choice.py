"""Which file of weights a method takes: what the node ``weights`` of its configuration says."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from dsr.methods.networks.weight_files import is_dsr_weights, read_header
from dsr.methods.weights import left_out, packaged_names, packaged_weights
from dsr.utils.configuration import ConfigError
from dsr.utils.ratios import round_ratio

SLACK = 1.05
"""By how much a scale may exceed the factor of weights that are used for it."""


@dataclass(frozen=True)
class WeightChoice:
    """Where the weights of a method for one factor are.

    Args:
        scale: the upsampling factor.
        path: a file, or a directory with published files; None for packaged weights.
        packaged: name of the weights that come with dsr; or the factors of several, by their names.
        file: name of the published file in a directory.
        files: the factors of several published files, by their names.
        source: where the published files are from, for messages.

    """

    scale: float
    path: str | Path | None = None
    packaged: str | Mapping[str, float] | None = None
    file: str | None = None
    files: Mapping[str, float] = field(default_factory=dict)
    source: str | None = None

    @classmethod
    def of(cls, node: Any, scale: float) -> WeightChoice:
        """Return the choice that a method's node ``weights`` describes; the node may be a path alone."""
        if not isinstance(node, Mapping):
            return cls(scale, node)
        names = {each.name for each in fields(cls)}
        unknown = next((key for key in node if key not in {*names, "_target_"}), None)
        if unknown is not None:
            raise ConfigError(f"weights.{unknown}: unknown key; expected {', '.join(sorted(names))}")
        return cls(**{key: value for key, value in node.items() if key != "_target_"} | {"scale": scale})

    def find(self) -> Path:
        """Return the file.

        Raises:
            ConfigError: there is none; it says where to get it.

        """
        given, files = self._given(), self._published()
        if given is None or (given.is_dir() and not files):
            found = self._packaged_file()
            if found is None:
                raise ConfigError(f"weights: {self._lack(files)}")
            return found
        if given.is_dir():
            given = next((given / file for file in files if (given / file).is_file()), given / files[0])
        if not given.is_file():
            raise ConfigError(f"weights: expected a file of weights, got {given} (no such file)")
        return given

    def exists(self) -> bool:
        """Return whether the weights are there."""
        path, files = self._given(), self._published()
        if path is not None and path.is_dir() and files:
            return any((path / file).is_file() for file in files)
        if path is not None and not path.is_dir():
            header = read_header(path) if path.is_file() and is_dsr_weights(path) else None
            return path.is_file() and (header is None or header["arguments"].get("scale") == self.scale)
        return self._packaged_file() is not None

    def _given(self) -> Path | None:
        """Return the file or directory that is named."""
        return None if self.path is None else Path(str(self.path)).expanduser()

    def _lack(self, files: list[str]) -> str:
        """Say which weights are needed, and where they are."""
        published = f", or a directory with {files[0]} (from {self.source})" if files else ""
        needs = f"scale {round_ratio(self.scale)} needs weights=FILE{published}"
        if files and self.packaged is None:
            return f"{needs}; its authors publish them, dsr does not come with them"
        if isinstance(self.packaged, str) and self.packaged in left_out():
            return f"{self.packaged} does not come with this installation; `dsr data get weights`, or weights=FILE"
        return f"dsr comes with {', '.join(packaged_names())}; {needs}"

    def _packaged_file(self) -> Path | None:
        """Return the file of packaged weights, of several the one for the scale."""
        if self.packaged is None or isinstance(self.packaged, str):
            return None if self.packaged is None else packaged_weights(self.packaged)
        there = {str(name): factor for name, factor in self.packaged.items() if packaged_weights(str(name)) is not None}
        nearest = nearest_scale(there.values(), self.scale / SLACK) if there else None
        return next((packaged_weights(name) for name, factor in there.items() if factor == nearest), None)

    def _published(self) -> list[str]:
        """Return the names of published files with the weights for the scale, in order of preference."""
        if not self.files:
            return [self.file] if self.file else []
        trained = nearest_scale(self.files.values(), self.scale)
        return [str(file) for file, factor in self.files.items() if factor == trained]


def find_weights(
    scale: float,
    path: str | None = None,
    packaged: str | dict[str, float] | None = None,
    file: str | None = None,
    files: dict[str, float] | None = None,
    source: str | None = None,
) -> Path:
    """Return the file of weights of a method, as a node of the configuration names it: see :class:`WeightChoice`.

    Raises:
        ConfigError: there is none; it says where to get it.

    """
    return WeightChoice(scale, path, packaged, file, files or {}, source).find()


def nearest_scale(trained: Collection[float], scale: float) -> float:
    """Return the trained factor whose weights suit a factor: itself, else the smallest whole one above, or the largest.

    Weights for a factor that is not whole were trained on one sensor's maps and suit no others.
    """
    if scale in trained:
        return scale
    whole = [each for each in trained if float(each).is_integer()]
    return min((each for each in whole if each >= scale), default=max(whole))

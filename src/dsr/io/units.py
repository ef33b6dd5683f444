"""Units of depth files that nothing says: guessed once for a folder, from its own files alone."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dsr.data.formats.decoding import pixels_in_header
from dsr.io.depth_files import read_depth_file
from dsr.io.encoding import Assumption, find_holes, guess_unit
from dsr.io.pairs import Pair
from dsr.utils.limits import pixels_beside
from dsr.utils.paths import natural_key

Kind = tuple[Path, str, str]
"""Folder, suffix and type of value: maps alike in them have one unit."""


class FolderUnits:
    """Guesses the unit of each kind of map from the first by name that has a known pixel.

    The guess depends on the pairs alone, not on their order, nor on which of them were read or finished before.

    Args:
        pairs: all pairs of the folder.

    """

    def __init__(self, pairs: Sequence[Pair] = ()) -> None:
        self._pairs = pairs
        self._units: dict[Kind, tuple[float, list[Assumption]]] = {}

    def guess(
        self, pair: Pair, stored: np.ndarray, holes: np.ndarray, hole_value: float | None
    ) -> tuple[float, list[Assumption]]:
        """Return metres per value of a map, and the assumptions.

        Args:
            pair: the map's pair.
            stored: (h, w) its values.
            holes: (h, w) bool, where they are missing.
            hole_value: an additional value of holes, also in the other maps.

        Raises:
            ValueError: no usual unit makes the distances plausible.

        """
        kind = _kind(pair, stored)
        if kind not in self._units:
            path, first, missing = self._first(kind, hole_value) or (pair.depth, stored, holes)
            self._units[kind] = guess_unit(str(path), first, missing)
        return self._units[kind]

    def _first(self, kind: Kind, hole_value: float | None) -> tuple[Path, np.ndarray, np.ndarray] | None:
        """Return the first map of a kind that has a known pixel, and its holes."""
        for pair in self._in_order:
            if (pair.depth.parent, pair.depth.suffix.lower()) != kind[:2]:
                continue
            try:
                stored = read_values_of(pair)
            except ValueError:  # a damaged map is reported when its own turn comes
                continue
            holes = find_holes(stored, hole_value)[0]
            if _kind(pair, stored) == kind and not holes.all():
                return pair.depth, stored, holes
        return None

    @functools.cached_property
    def _in_order(self) -> list[Pair]:
        """All pairs by name."""
        return sorted(self._pairs, key=lambda pair: (natural_key(pair.depth.name), natural_key(pair.name)))


def read_values_of(pair: Pair) -> np.ndarray:
    """Return the depth map of a pair as it is stored, (h, w).

    Raises:
        ValueError: it is missing or damaged.

    """
    if pair.capture is not None and pair.capture.depth is not None:
        return pair.capture.depth.read()
    photo = pixels_in_header(pair.rgb)
    return read_depth_file(pair.depth, None if photo is None else pixels_beside(*photo))


def _kind(pair: Pair, stored: np.ndarray) -> Kind:
    """Return the kind of a map."""
    return pair.depth.parent, pair.depth.suffix.lower(), str(stored.dtype)

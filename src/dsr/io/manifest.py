"""Manifests: the frames of a folder, listed once and split into shards.

A folder of a million frames takes half a minute to list and to pair, and each task of an array would do so again, and
might find other files than the one before. A manifest is text, one JSON object in each line:

    {"dsr_manifest": 1, "frames": 1000000, "assumptions": [], "shards": [{"frames": 62500, "bytes": 10187500}, ...]}
    {"shard": 1, "firsts": []}
    {"name": "000000", "rgb": "rgb/000000.jpg", "depth": "depth/000000.png", "camera": "camera.json"}
    ...
    {"shard": 2, "firsts": [{"name": "000000", ...}]}
    ...

Paths are absolute, or those from the manifest's folder to what is in it. The sizes in the first line tell where a shard
begins, so that a task reads that line and its own. ``firsts`` are the frames of other shards that a unit may be guessed
from, see :class:`dsr.io.units.FolderUnits`. What a capture says about a frame is read from the capture again:
``capture`` has its folder or file, and the frame's name in it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import accumulate
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, NamedTuple

from dsr.io.confidence import ConfidenceMap
from dsr.io.encoding import Assumption
from dsr.io.layouts import find_pairs_at
from dsr.io.pairs import Origin, Pair, PairingResult
from dsr.io.shards import Shard
from dsr.io.units import order_of_maps
from dsr.utils.files import replacing
from dsr.utils.limits import opened
from dsr.utils.parsing import is_number, parse_json
from dsr.utils.paths import OutsideError, leads_outside

_VERSION = 1
_LONGEST = 1 << 26
"""Largest size in bytes of a line; the first has about 35 bytes for each shard."""
_LARGEST = 10**12
"""Size in bytes that the first line has room for."""
_Folder = tuple[Path, str]
"""A folder and a suffix in it, whose maps have one unit."""


class ShardFrames(NamedTuple):
    """What a shard works on: its frames in order, and the first ones by name of their folders, for units."""

    pairs: tuple[Pair, ...]
    firsts: tuple[Pair, ...]


def write_manifest(path: Path, found: PairingResult, count: int) -> None:
    """Write a manifest atomically, with absolute paths, or relative ones for what is in its folder.

    Args:
        path: the file.
        found: the frames.
        count: number of shards.

    """
    pairs = found.pairs
    firsts: dict[_Folder, Pair] = {}
    for pair in pairs:
        folder = _folder(pair)
        if folder not in firsts or order_of_maps(pair) < order_of_maps(firsts[folder]):
            firsts[folder] = pair
    shards = [Shard(number, count) for number in range(1, count + 1)]
    room = len(_head(found, [_LARGEST] * count))
    base = str(path.absolute().parent)
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(b" " * room)
        sizes = [
            _write_shard(file, shard, [pairs[i] for i in shard.block(len(pairs))], firsts, base) for shard in shards
        ]
        file.seek(0)
        file.write(_head(found, sizes)[:-1].ljust(room - 1) + b"\n")


class Manifest:
    """A manifest that is read when its frames are needed.

    Args:
        path: the file.

    Raises:
        ValueError: it is damaged or something else.
        OSError: it cannot be read.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with opened(path) as file:
            line = file.readline(_LONGEST)
        try:
            head = parse_json(line)
            if head["dsr_manifest"] != _VERSION:
                raise ValueError
            shards = [(_count(entry["frames"]), _count(entry["bytes"])) for entry in head["shards"]]
            self.frames = _count(head["frames"])
            if self.frames > path.stat().st_size:
                raise ValueError
            self.assumptions = tuple(Assumption(str(text), str(detail)) for text, detail in head["assumptions"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: expected a manifest of `dsr upsample --shards N`, got something else") from error
        self.shards = len(shards)
        expected = [len(Shard(number, self.shards).block(self.frames)) for number in range(1, self.shards + 1)]
        self._begins = list(accumulate((size for _, size in shards), initial=len(line)))
        if not shards or [frames for frames, _ in shards] != expected or self._begins[-1] != path.stat().st_size:
            raise ValueError(f"{path}: expected {self.frames} frames in {self.shards} shards, the file is damaged")

    def __iter__(self) -> Iterator[Pair]:
        """Read all frames in order."""
        for number in range(1, self.shards + 1):
            yield from self.read(Shard(number, self.shards)).pairs

    def read(self, shard: Shard) -> ShardFrames:
        """Read a shard, and nothing of the others.

        Raises:
            ValueError: the manifest is one of another number of shards, or damaged, or a capture lacks a frame.

        """
        if shard.count != self.shards:
            raise ValueError(f"--shard: expected K/{self.shards}, for which {self.path} was written, got {shard}")
        begin, end = self._begins[shard.number - 1 : shard.number + 1]
        block = shard.block(self.frames)
        reader = _Reader(self.path, shard.number + block.start)  # a line for the file, and one for each shard before
        with opened(self.path) as file:
            file.seek(begin)
            head = reader.parse(file.readline(_LONGEST))
            if head.get("shard") != shard.number or not isinstance(head.get("firsts"), list):
                raise reader.damaged()
            firsts = tuple(reader.pair(record) for record in head["firsts"])
            pairs = tuple(reader.pair(reader.parse(file.readline(_LONGEST))) for _ in block)
            if file.tell() != end:
                raise reader.damaged()
        return ShardFrames(pairs, firsts + _firsts_among(pairs, firsts))


def _firsts_among(pairs: Iterable[Pair], others: Iterable[Pair]) -> tuple[Pair, ...]:
    """Return the first pair by name of each folder that ``others`` have none of."""
    elsewhere = {_folder(pair) for pair in others}
    firsts: dict[_Folder, Pair] = {}
    for pair in pairs:
        folder = _folder(pair)
        if folder not in elsewhere and (folder not in firsts or order_of_maps(pair) < order_of_maps(firsts[folder])):
            firsts[folder] = pair
    return tuple(firsts.values())


def _folder(pair: Pair) -> _Folder:
    """Return folder and suffix of a depth map."""
    return pair.depth.parent, pair.depth.suffix.lower()


def _head(found: PairingResult, sizes: Iterable[int]) -> bytes:
    """Return the first line."""
    sizes = list(sizes)
    shards = [
        {"frames": len(Shard(number, len(sizes)).block(len(found.pairs))), "bytes": size}
        for number, size in enumerate(sizes, 1)
    ]
    facts = [list(fact) for fact in found.assumptions]
    return _line({"dsr_manifest": _VERSION, "frames": len(found.pairs), "assumptions": facts, "shards": shards})


def _write_shard(file: BinaryIO, shard: Shard, pairs: list[Pair], firsts: Mapping[_Folder, Pair], base: str) -> int:
    """Write the lines of a shard, and return their size in bytes."""
    begin = file.tell()
    own = {pair.name for pair in pairs}
    needed = [firsts[folder] for folder in dict.fromkeys(map(_folder, pairs))]
    elsewhere = [_record(pair, base) for pair in needed if pair.name not in own]
    file.write(_line({"shard": shard.number, "firsts": elsewhere}))
    file.writelines(_line(_record(pair, base)) for pair in pairs)
    return file.tell() - begin


def _line(values: Mapping[str, Any]) -> bytes:
    return json.dumps(values, separators=(",", ":")).encode() + b"\n"


def _record(pair: Pair, base: str) -> dict[str, Any]:
    """Return a pair as values for JSON, with paths relative to a folder if they lie below it."""

    def place(path: Path) -> str:
        return str(path.absolute()).removeprefix(os.path.join(base, ""))  # noqa: PTH118 - with a separator at its end

    record: dict[str, Any] = {"name": pair.name, "rgb": place(pair.rgb), "depth": place(pair.depth)}
    for name in ("camera", "mask"):
        path = getattr(pair, name)
        if path is not None:
            record[name] = place(path)
    for name in ("unit", "factor"):
        if getattr(pair, name) is not None:
            record[name] = getattr(pair, name)
    if pair.origin is not None:
        record["capture"] = [place(pair.origin.place), pair.origin.name]
    if pair.confidence is not None and pair.confidence.source is None:
        record["confidence"] = [place(pair.confidence.path), pair.confidence.highest]
    return record


class _Reader:
    """Makes pairs of the lines of a manifest that follow after some."""

    def __init__(self, path: Path, line: int) -> None:
        self._path, self._base, self._line = path, path.absolute().parent, line
        self._capture: tuple[Path, dict[tuple[str, Path, Path], Pair]] | None = None

    def damaged(self) -> ValueError:
        """Return the error to raise for a line that is none of a manifest."""
        return ValueError(
            f"{self._path}: line {self._line}: expected the lines of a manifest of `dsr upsample`, the file is damaged"
        )

    def parse(self, line: bytes) -> dict[str, Any]:
        """Return the object in the next line."""
        self._line += 1
        try:
            values = parse_json(line)
        except ValueError:
            raise self.damaged() from None
        if not isinstance(values, dict):
            raise self.damaged()
        return values

    def _place(self, value: Any) -> Path:
        """Return a path, relative ones from the folder of the manifest."""
        if not isinstance(value, str) or not value or "\0" in value:
            raise ValueError
        path = self._base / value
        if not Path(value).is_absolute() and leads_outside(value):
            expected = f"expected absolute paths, or those within {self._base}"
            raise OutsideError(f"{self._path}: line {self._line}: {expected}, got {value!r:.100}")
        return path

    def pair(self, record: Any) -> Pair:
        """Return the pair that an object describes."""
        try:
            name = _name(record["name"])
            pair = Pair(
                name,
                self._place(record["rgb"]),
                self._place(record["depth"]),
                None if "camera" not in record else self._place(record["camera"]),
                None if "mask" not in record else self._place(record["mask"]),
                None if "unit" not in record else _positive(record["unit"]),
                None if "factor" not in record else _count(record["factor"]),
            )
            if "confidence" in record:
                path, highest = record["confidence"]
                pair = replace(pair, confidence=ConfidenceMap(self._place(path), _positive(highest)))
            origin = None
            if "capture" in record:
                place, own = record["capture"]
                origin = Origin(self._place(place), str(own))
        except OutsideError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise self.damaged() from error
        return pair if origin is None else self._of_capture(pair, origin)

    def _of_capture(self, pair: Pair, origin: Origin) -> Pair:
        """Return a pair with what its capture says about it."""
        if self._capture is None or self._capture[0] != origin.place:
            if not origin.place.exists():
                raise ValueError(f"{origin.place}: expected the capture that {self._path} lists, there is none")
            pairs = find_pairs_at(origin.place).pairs
            self._capture = (origin.place, {(each.name, each.rgb, each.depth): each for each in pairs})
        found = self._capture[1].get((origin.name, pair.rgb, pair.depth))
        if found is None:
            raise ValueError(
                f"{origin.place}: expected the frame {origin.name!r:.80} that {self._path} lists, got none"
            )
        confidence = pair.confidence or found.confidence
        return replace(pair, capture=found.capture, origin=origin, confidence=confidence)


def _name(value: Any) -> str:
    """Return a name of a result, which is a folder below that of the results."""
    parts = PurePosixPath(value).parts
    if not isinstance(value, str) or not parts or leads_outside(value) or "\\" in value:
        raise ValueError
    return value


def _count(value: Any) -> int:
    """Return a whole number from 0."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError
    return value


def _positive(value: Any) -> float:
    """Return a positive number."""
    if not is_number(value) or value <= 0:
        raise ValueError
    return float(value)

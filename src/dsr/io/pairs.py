"""Pairs of photo and depth map: from lists of files, two folders by names, and recordings by time."""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

from dsr.io.depth_files import READ_SUFFIXES
from dsr.io.frames import CONFIDENCE_SUFFIXES, CaptureFrame, ConfidenceMap, Source, find_highest
from dsr.io.photos import HEIC_SUFFIXES
from dsr.notes import Assumption
from dsr.utils.guards import naming, natural_key

Role = Literal["rgb", "depth", "other"]
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".ppm", *HEIC_SUFFIXES)
_DEPTH_ONLY = (".npy", ".npz", ".pfm", ".exr", ".depth")
_CONFIDENCE = ("confidence", "conf")
_WORDS: dict[Role, tuple[str, ...]] = {
    "other": ("mask", "masks", *_CONFIDENCE, "ir", "infrared", "normal", "normals", "label", "labels", "vis", "viz"),
    "depth": ("depth", "depths", "depthmap", "disparity", "disp", "range"),
    "rgb": ("rgb", "color", "colour", "image", "images", "img", "imgs", "photo", "photos", "picture"),
}  # the first role of which a name has a word is its
_FILLERS = ("raw", "align", "aligned", "registered", "transformed", "warped", "map", "to", "frame", "in")
_NOT_IN_KEYS = {*_WORDS["rgb"], *_WORDS["depth"], *_FILLERS}
_REGISTERED = re.compile(
    r"(?<!not )\b(align|aligned|registered|transformed|warped|depths? (to|in|2) (rgb|colou?r|image))\b"
    r"(?!.* (to|in|2) (depth|ir|infra|infrared|left|right)\b)"
)
_SECONDS_BY_DIGITS = {10: 1.0, 13: 1e-3, 16: 1e-6, 19: 1e-9}  # of times since 1970 as whole numbers
_MAX_GAP = 0.02  # seconds between the two pictures of a pair
_MOST_CANDIDATES, _RATE = 1 << 20, 40  # pairs within that time, at all and for each photo: at 1000 a second
_Key = TypeVar("_Key", int, str)

CAMERA_NAMES = (
    "camera.json", "cam_params.json", "intrinsics.json", "intrinsic.json", "camera_intrinsic.json",
    "camera_primesense.json", "intrinsic_color.txt", "intrinsics.txt", "intrinsic.txt", "camera-intrinsics.txt",
)  # fmt: skip
_SUFFIXES = frozenset((*PHOTO_SUFFIXES, *READ_SUFFIXES))


def words_of(name: str) -> list[str]:
    """Return the words and numbers of a name, in lower case, numbers without leading zeros."""
    split = re.findall(r"[a-z]+|[A-Z]+(?![a-z])|[A-Z][a-z]+|\d+|[^\W\d_A-Za-z]+", name)
    return [word.lstrip("0") or "0" if word.isdigit() else word.lower() for word in split]


def role_of(path: Path) -> Role:
    """Return the role of a picture by its suffix and the words of its name, ``rgb`` where they say nothing."""
    found = role_of_words(words_of(path.stem))
    if found != "other" and path.suffix.lower() in _DEPTH_ONLY:
        return "depth"
    return found or "rgb"


def role_of_words(words: Iterable[str]) -> Role | None:
    """Return the role that words name, None where they name none."""
    words = set(words)
    return next((role for role, known in _WORDS.items() if words & {*known}), None)


def is_registered(name: str) -> bool:
    """Return whether the name of a depth map, a folder or a topic says that its depth is registered to the photo."""
    return _REGISTERED.search(" ".join(words_of(name))) is not None


def key_of(path: Path) -> tuple[str, ...]:
    """Return the words of a name without those that say its role, which are equal for the two files of a pair."""
    return tuple(word for word in words_of(path.stem) if word not in _NOT_IN_KEYS)


def time_of(path: Path) -> float | None:
    """Return the time in seconds in a name such as 1305031102.175304; None if there is none."""
    numbers = re.findall(r"\d+(?:\.\d+)?", path.stem)
    numbers = [number for number in numbers if len(number.split(".")[0]) in _SECONDS_BY_DIGITS]
    if len(numbers) != 1:
        return None
    return float(numbers[0]) * _SECONDS_BY_DIGITS[len(numbers[0].split(".")[0])]


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Return files in the order of the times in their names, if all have one, else of the names, numbers by value."""
    times = {path: time_of(path) for path in paths}
    named = sorted(times, key=natural_key)
    return named if None in times.values() else sorted(named, key=lambda path: times[path] or 0.0)


def match_pairs(photos: Iterable[Path], depths: Iterable[Path], camera: Path | None = None) -> PairingResult:
    """Return the pairs among photos and depth maps by name, in the photos' order, all of one camera.

    A pair has the same name but for words such as color and depth and for leading zeros; where a name is a time, the
    nearest within 20 ms that no other pair takes. A single photo and a single depth map are a pair whatever they are
    called. If names call some depth maps registered, only these are taken.
    """
    photos, depths = list(photos), list(depths)
    left = in_order(photos)
    right = in_order([path for path in depths if is_registered(path.stem)] or depths)
    if len(left) == len(right) == 1:
        partner = {left[0]: right[0]}
    else:
        by_key: dict[tuple[str, ...], list[Path]] = {}
        for path in right:
            by_key.setdefault(key_of(path), []).append(path)
        partner = {path: by_key[key_of(path)].pop(0) for path in left if by_key.get(key_of(path))}
        used = set(partner.values())
        lone, alone = [path for path in left if path not in partner], [path for path in right if path not in used]
        times = ([math.nan if (time := time_of(path)) is None else time for path in each] for each in (lone, alone))
        partner |= {lone[place]: alone[other] for place, other in match_times(*times)}
    pairs = tuple(Pair(path.stem, path, partner[path], camera) for path in left if path in partner)
    used = {*partner, *partner.values()}
    return PairingResult(pairs, (), tuple(path for path in (*photos, *depths) if path not in used))


def match_times(photos: Sequence[float], depths: Sequence[float]) -> list[tuple[int, int]]:
    """Return the places of the times in seconds that belong together, in the order of the photos.

    The nearest are paired first, each once, within 20 ms; times that are not finite with none. A ValueError if far more
    are that near than any cameras take.
    """
    order = sorted((place for place, time in enumerate(depths) if math.isfinite(time)), key=depths.__getitem__)
    candidates, first = [], 0
    for place in sorted((place for place, time in enumerate(photos) if math.isfinite(time)), key=photos.__getitem__):
        while first < len(order) and depths[order[first]] < photos[place] - _MAX_GAP:
            first += 1
        for other in order[first:]:
            gap = depths[other] - photos[place]
            if gap > _MAX_GAP:
                break
            candidates.append((abs(gap), place, other))
        if len(candidates) > max(_MOST_CANDIDATES, _RATE * len(photos)):
            raise ValueError(f"expected frames of different times, got too many within {_MAX_GAP:g} s")
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for _, place, other in sorted(candidates):
        if place not in partner and other not in taken:
            partner[place] = other
            taken.add(other)
    return sorted(partner.items())


def paired(photos: Mapping[_Key, Path], depths: Mapping[_Key, Path]) -> tuple[list[_Key], tuple[Path, ...]]:
    """Return the numbers or names that photos and depth maps have in common, and the files without a partner."""
    both = [key for key in photos if key in depths]
    known = set(both)
    return both, tuple(path for each in (photos, depths) for key, path in each.items() if key not in known)


@dataclass(frozen=True)
class Pair:
    """Two files of one view; names of their places in a capture that has no such files."""

    name: str  # of the result, unique among the pairs found together
    rgb: Path
    depth: Path
    camera: Path | None = None  # camera file beside them
    mask: Path | None = None  # picture that is 0 where depth is missing
    unit: float | None = None  # metres per value if the layout defines it
    factor: int | None = None  # of upsampling if the file's name has it, as in depth_lr4.npy
    capture: CaptureFrame | None = field(default=None, compare=False)  # what the capture that it is of says about it
    confidence: ConfidenceMap | None = field(default=None, compare=False)
    bits: int = 0  # how far the layout turns values of 16 bits to the left; the unit holds after turning them back
    time: float | None = None  # of the photo in seconds, if the capture or a list of the files states it
    along_ray: bool = False  # whether the layout's values are distances along the rays

    @property
    def named_time(self) -> float | None:
        """The time in seconds in the names of the files; None if there is none."""
        time = time_of(self.depth)
        return time_of(self.rgb) if time is None else time


@dataclass(frozen=True)
class PairingResult:
    """The pairs that were found in order, notes on how they were recognised, and pictures without a partner."""

    pairs: tuple[Pair, ...]
    assumptions: tuple[Assumption, ...] = ()
    unpaired: tuple[Path, ...] = ()


def find_pairs_of_lists(photos: Sequence[Path], depths: Sequence[Path], masks: Sequence[Path] = ()) -> PairingResult:
    """Return the pairs of files in the order given, or of two folders by the names in them."""
    for name, paths in (("--rgb", photos), ("--depth", depths), ("--mask", masks)):
        for path in paths:
            if not path.exists():
                raise ValueError(f"{name}: {path}: no such file or folder")
    if len(photos) == len(depths) == 1 and photos[0].is_dir() and depths[0].is_dir():
        if photos[0].samefile(depths[0]):
            raise ValueError(f"{photos[0]}: expected two folders; one with both is given without --rgb and --depth")
        return find_pairs_of_two_folders(photos[0], depths[0], masks)
    for path in (*photos, *depths, *masks):
        if path.is_dir():
            raise ValueError(f"{path}: expected files, or one folder each for --rgb and --depth")
    if len(photos) != len(depths) or len(masks) not in (0, len(photos)):
        counts = f"{len(photos)} for --rgb, {len(depths)} for --depth" + (f", {len(masks)} for --mask" if masks else "")
        raise ValueError(f"expected as many depth maps (and masks, if any) as photos, got {counts}")
    pairs = []
    for place, (rgb, depth) in enumerate(zip(photos, depths, strict=True)):
        folders = rgb.parent.absolute(), depth.parent.absolute()
        beside = folders[0] != folders[1] and folders[0].parent == folders[1].parent  # their camera file may be above
        camera = find_camera_file(rgb.parent, rgb.parent.parent if beside and rgb.parent.name else rgb.parent)
        pairs.append(Pair(rgb.stem, rgb, depth, camera, masks[place] if masks else None))
    return PairingResult(make_names_unique(pairs))


def find_pairs_of_two_folders(photos: Path, depths: Path, masks: Sequence[Path]) -> PairingResult:
    """Return the pairs of two folders by name."""
    if masks:
        raise ValueError("--mask: expected photos and depth maps as files, one for each mask; got folders")
    left = [path for path in list_pictures(photos) if path.suffix.lower() in PHOTO_SUFFIXES]
    right = [path for path in list_pictures(depths) if path.suffix.lower() in READ_SUFFIXES]
    found = match_pairs(left, right, find_camera_file(photos, photos.parent))
    if not found.pairs:
        text = f"the same names, numbers or times (within 20 ms); of {len(left)} and {len(right)} none belong together"
        raise ValueError(f"{photos} and {depths}: expected photos and depth maps of {text}")
    return found


def find_camera_file(folder: Path, root: Path) -> Path | None:
    """Return a camera file in the folder, in its folders of intrinsics, or above it up to the root."""
    places = [folder, folder / "intrinsic", folder / "intrinsics"]
    while folder != root:
        folder = folder.parent
        places.append(folder)
    return next((place / name for place in places for name in CAMERA_NAMES if (place / name).is_file()), None)


def add_confidence(pairs: Sequence[Pair], given: Sequence[Path]) -> tuple[Pair, ...]:
    """Return pairs with the maps that the user gives: one for each in their order, or a folder of maps by names."""
    for path in given:
        if not path.exists():
            raise ValueError(f"--confidence: {path}: no such file or folder")
    if len(given) == 1 and given[0].is_dir():
        maps = {}
        for path in sorted(given[0].iterdir()):
            if path.suffix.lower() in CONFIDENCE_SUFFIXES:
                maps[tuple(word for word in key_of(path) if word not in _CONFIDENCE)] = path
        found = [maps.get(key_of(pair.depth)) or maps.get(key_of(pair.rgb)) for pair in pairs]
        paths = [path for path in found if path is not None]
        if missing := [pair.name for pair, path in zip(pairs, found, strict=True) if path is None]:
            text = f"expected {len(pairs)} maps, there is none for {len(missing)} depth maps, such as {missing[0]}"
            raise ValueError(f"--confidence: {given[0]}: {text}")
    elif any(path.is_dir() for path in given) or len(given) != len(pairs):
        raise ValueError(f"--confidence: expected a folder or as many maps as photos, {len(pairs)}, got {len(given)}")
    else:
        paths = list(given)
    highest = find_highest(paths)
    return tuple(
        replace(pair, confidence=ConfidenceMap(path, highest)) for pair, path in zip(pairs, paths, strict=True)
    )


def list_pictures(folder: Path) -> list[Path]:
    """Return the pictures and maps in a folder."""
    return [folder / name for name in sorted(picture_names(folder), key=natural_key)]


def picture_names(folder: Path) -> Iterator[str]:
    """Yield the names of the pictures and maps in a folder, which may have a million files."""
    with os.scandir(folder) as entries:  # knows files from folders without asking for each
        for entry in entries:
            suffix = os.path.splitext(entry.name)[1]  # noqa: PTH122 - quicker than a Path
            with contextlib.suppress(OSError):  # a link to itself
                if suffix.lower() in _SUFFIXES and not entry.name.startswith(".") and entry.is_file():
                    yield entry.name


def numbered_files(folder: Path, suffixes: tuple[str, ...], before: str = "") -> dict[int, Path]:
    """Return the files of a folder that have a number for a name, behind a word, by number, in order; {} without it."""
    if not folder.is_dir():
        return {}
    form = re.compile(re.escape(before) + r"(\d{1,9})", re.ASCII)
    found = ((form.fullmatch(path.stem), path) for path in folder.iterdir() if path.suffix.lower() in suffixes)
    return dict(sorted((int(match[1]), path) for match, path in found if match))


def make_names_unique(pairs: Iterable[Pair]) -> tuple[Pair, ...]:
    """Return the pairs under names of their own: that of the folder in front where two are the same, else a number."""
    pairs = list(pairs)
    names = [pair.name for pair in pairs]
    counts = Counter(names)
    if len(counts) < len(names):
        names = [f"{pair.rgb.parent.name}_{name}" if counts[name] > 1 else name
                 for pair, name in zip(pairs, names, strict=True)]  # fmt: skip
    unique: dict[str, Pair] = {}
    for pair, name in zip(pairs, names, strict=True):
        number, own = 2, name
        while own.casefold() in unique:
            number, own = number + 1, f"{name}_{number}"
        unique[own.casefold()] = pair if pair.name == own else replace(pair, name=own)
    return tuple(unique.values())


class Shot(NamedTuple):
    """A photo or a depth map of a recording: the place that messages name, where it is, and when it was taken."""

    place: Path
    source: Source
    seconds: float


def pair_by_time(photos: Sequence[Shot], depths: Sequence[Shot], frame: CaptureFrame, unit: float) -> PairingResult:
    """Return the frames of a recording, named by the numbers of their photos; ``frame`` is what all have in common."""
    with naming(frame.description):
        partner = match_times(*([shot.seconds for shot in each] for each in (photos, depths)))
    if not partner:
        raise ValueError(f"{frame.description}: expected photos and depth maps within 20 ms of each other, found none")
    pairs = []
    for first, second in partner:
        photo, depth = photos[first], depths[second]
        own = replace(frame, photo=photo.source, depth=depth.source)
        pairs.append(Pair(f"{first:06}", photo.place, depth.place, unit=unit, capture=own, time=photo.seconds))
    used = [{place for place, _ in partner}, {place for _, place in partner}]
    lone = [shot.place for shots, known in zip((photos, depths), used, strict=True)
            for place, shot in enumerate(shots) if place not in known]  # fmt: skip
    return PairingResult(tuple(pairs), (), tuple(lone))


def join(parts: Mapping[str, PairingResult]) -> PairingResult:
    """Return the frames of several recordings, whose names begin with that of the recording, and each note once."""
    pairs: list[Pair] = []
    for stem, part in parts.items():
        pairs += (replace(pair, name=stem if pair.name == stem else f"{stem}/{pair.name}") for pair in part.pairs)
    notes = dict.fromkeys(note for part in parts.values() for note in part.assumptions)
    return PairingResult(tuple(pairs), tuple(notes), tuple(path for part in parts.values() for path in part.unpaired))

"""The frames of ``dsr upsample``: found in files and folders, with poses, their checks, and fusion with neighbours."""

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dsr.app.upsample.request import FrameChoice, UpsampleRequest
from dsr.degradation.sensors import Identified
from dsr.geometry.poses import PosedMap, check_poses
from dsr.inference.sequences import View, fuse_views
from dsr.inference.working_size import enlarged_by, find_sensor
from dsr.io.captures.colmap import add_model
from dsr.io.inputs import FolderUnits, Picture
from dsr.io.layouts import NoPairError, find_pairs_of_folder
from dsr.io.pairs import Pair, PairingResult, add_confidence, find_pairs_of_lists, in_order
from dsr.io.trajectories import read_poses
from dsr.notes import LIMITS, Assumption


@dataclass(frozen=True)
class Frames:
    """Frames to work on, and what they depend on."""

    found: PairingResult  # the frames to work on, and notes on them
    whole: tuple[Pair, ...]  # all frames that were found; poses, neighbours and units depend on them
    single: bool  # whether there is a single picture, whose results are in the output folder itself
    units: FolderUnits  # units and range types, identified from the values of all of them
    # of :mod:`dsr.app.upsample.checks`, which looks at several frames, by the name of each frame
    warnings: Mapping[str, tuple[Assumption, ...]] = field(default_factory=dict)


def find_frames(request: UpsampleRequest) -> Frames:
    """Return the frames of a request; a ValueError if there are none."""
    choice = request.frames
    found = _search(choice, request.results.output)
    if choice.confidence:
        found = replace(found, pairs=add_confidence(found.pairs, choice.confidence))
    photos = [pair.rgb for pair in found.pairs]
    if choice.rgb and photos == sorted(photos, key=str):  # as a shell lists them, 1 10 2
        ranks = {photo: rank for rank, photo in enumerate(in_order(photos))}
        found = replace(found, pairs=tuple(sorted(found.pairs, key=lambda pair: ranks[pair.rgb])))
    if choice.model is not None:
        found = add_model(found, choice.model)
        if not any(pair.capture is not None and pair.capture.description == choice.model for pair in found.pairs):
            raise ValueError(f"{choice.model}: expected images named as the photos, such as {found.pairs[0].rgb.name}")
    whole = found.pairs
    single = len(whole) == 1 and not choice.folders and not choice.rgb[0].is_dir()
    if choice.shard is not None:
        found = replace(found, pairs=tuple(whole[number] for number in choice.shard.block(len(whole))))
    return Frames(found, whole, single, FolderUnits(whole))


def _search(choice: FrameChoice, output: Path) -> PairingResult:
    """Return the pairs in the user's files and folders."""
    if not choice.folders:
        return find_pairs_of_lists(choice.rgb, choice.depth, choice.mask)
    try:
        parts = [find_pairs_of_folder(folder, output) for folder in choice.folders]
    except NoPairError as error:
        if len(choice.folders) != 2:
            raise
        raise ValueError(f"{error}; photos and depth maps apart are given as --rgb PHOTOS --depth MAPS") from error
    if len(parts) == 1:
        return parts[0]
    pairs = [
        replace(pair, name=f"{folder.resolve().name}/{pair.name}")
        for folder, part in zip(choice.folders, parts, strict=True)
        for pair in part.pairs
    ]
    if len({pair.name for pair in pairs}) < len(pairs):
        raise ValueError("expected folders of different names; give those of one name in commands of their own")
    facts = tuple(dict.fromkeys(fact for part in parts for fact in part.assumptions))
    return PairingResult(tuple(pairs), facts, tuple(path for part in parts for path in part.unpaired))


class FrameSequence:
    """The frames of each folder in order, with their poses or those of a file; neighbours vote on their depth."""

    def __init__(
        self, pairs: Sequence[Pair], read: Callable[[Pair], Picture], neighbours: int, poses: Path | None
    ) -> None:
        self._read, self._count, self._file, self.given = read, neighbours, poses, poses is not None
        self._poses: Mapping[str, np.ndarray] | None = None
        self._matched: list[Assumption] = []
        if poses is not None:
            trajectory = read_poses(poses)
            self._poses = trajectory.assign(pairs)
            if len(trajectory.poses) != len(pairs):
                counts = f"{len(trajectory.poses)} poses for {len(pairs)} frames"
                self._matched.append(Assumption(f"{poses.name}: {counts}, by their times or numbers"))
        self.recordings: dict[Path, list[Pair]] = {}
        for pair in pairs:
            self.recordings.setdefault(pair.depth.parent, []).append(pair)
        self._views: OrderedDict[str, View | None] = OrderedDict()
        self._places = {pair.name: place for folder in self.recordings.values() for place, pair in enumerate(folder)}

    def neighbours(self, pair: Pair) -> list[Pair]:
        """Return the neighbours of a frame, the nearest first; those of its own folder that have a pose."""
        if not self._count:
            return []
        folder, place = self.recordings[pair.depth.parent], self._places[pair.name]
        poses = self._poses
        found = nearest(place, len(folder), self._count, lambda number: poses is None or folder[number].name in poses)
        return [folder[number] for number in found]

    def fault(self, recording: Sequence[Pair]) -> Assumption | None:
        """Return a warning if the poses of a recording do not fit a sample of its frames."""
        frames = [pair for pair in recording if self._poses is None or pair.name in self._poses]

        def load(number: int) -> PosedMap | None:
            try:
                view = self._view(frames[number])
            except (ValueError, OSError, MemoryError):  # it is reported as a frame of its own
                return None
            return None if view is None else PosedMap(view.depth[0].double().numpy(), view.camera, view.pose)

        return check_poses(len(frames), load)

    def fuse(self, pair: Pair, picture: Picture) -> Picture:
        """Return a frame with its pose, its depth fused with its neighbours', which need one."""
        notes = [*picture.assumptions, *self._matched]
        if self._poses is not None:
            picture = replace(picture, pose=self._poses.get(pair.name), up="")
        if picture.pose is None and self._count:
            where = "this capture has none; give --poses" if self._file is None else f"{self._file} has none"
            raise ValueError(f"--neighbours: expected a pose for each frame, {where}")
        if picture.pose is None and self._file is not None:
            missing = len(self._places) - len(self._poses or ())
            detail = f"{missing} of {len(self._places)} frames have none"
            notes.append(Assumption(f"{self._file.name} has no pose of this frame", detail, "poses-missing", missing))
        picture = replace(picture, assumptions=tuple(notes))
        if not self._count:
            return picture
        others, views, failed = self.neighbours(pair), [], 0
        for other in others:
            try:
                view = self._view(other)
            except (ValueError, OSError):  # it is reported as a frame of its own
                failed += 1
                continue
            if view is not None:
                views.append(view)
        return vote(picture, views, len(others), failed)

    def _view(self, pair: Pair) -> View | None:
        """Return what a neighbour contributes, nothing without a pose; the latest ones are kept with their noise."""
        if pair.name not in self._views:
            picture = self._read(pair)
            pose = picture.pose if self._poses is None else self._poses.get(pair.name)
            self._views[pair.name] = None if pose is None else view_of(picture, pose)
            if len(self._views) > self._count + 2:
                self._views.popitem(last=False)
        self._views.move_to_end(pair.name)
        return self._views[pair.name]


def nearest(place: int, total: int, count: int, usable: Callable[[int], bool]) -> list[int]:
    """Return the places, of ``total``, of at most ``count`` usable frames that vote on one, the nearest first."""
    found: list[int] = []
    for distance in range(1, total):
        found += [other for other in (place - distance, place + distance) if 0 <= other < total and usable(other)]
        if len(found) >= count:
            break
    return found[:count]


def vote(picture: Picture, views: Sequence[View], count: int, failed: int = 0) -> Picture:
    """Return a frame with a pose, its depth fused with its neighbours'; ``failed`` of ``count`` could not be read."""
    assert picture.pose is not None  # noqa: S101 - see above
    fused = fuse_views(view_of(picture, picture.pose), views)
    known = picture.depth_lr.isfinite()
    agreeing, seeing = (float(each[known].mean()) for each in (fused.others, fused.seeing))
    detail = f"of {seeing:.1f} that see a pixel {agreeing:.1f} agree with it"
    detail += f"; {failed} could not be read" if failed else ""
    who = "1 neighbouring frame votes" if count == 1 else f"{count} neighbouring frames vote"
    text, code = f"{who} on the depth", "neighbours-disagree"
    share = agreeing / seeing if seeing else 0.0
    note = Assumption(text, detail)
    if count and share < LIMITS[code]:
        note = Assumption(f"{text}, and hardly any agree with it: are the poses right?", detail, code, round(share, 3))
    return replace(picture, depth_lr=fused.depth, assumptions=(*picture.assumptions, note))


def view_of(picture: Picture, pose: np.ndarray) -> View:
    """Return a picture's depth map with its camera's place."""
    height, width = picture.depth_lr.shape[-2:]
    return View(picture.depth_lr, picture.camera.rescale(width, height), pose)


def prepare(picture: Picture, sensor: str, fuse: Callable[[Picture], Picture]) -> tuple[Picture, Identified | None]:
    """Return a picture that ``fuse`` has fused with its neighbours, and the sensor that its depth as read shows."""
    try:
        identified = find_sensor(picture.depth_lr, sensor, picture.device_name)
    except ValueError as error:
        raise ValueError(f"--{error}") from error
    picture = fuse(picture)
    if identified is None or identified.by == "request":
        return picture, identified
    reason = (
        f"named {picture.device_name}"
        if identified.by == "file"
        else f"by its depth in steps of disparity with f B / step = {identified.constant:.0f} m"
    )
    fact = Assumption("sensor", f"{identified.sensor.name}, {reason}; --sensor overrides it")
    return replace(picture, assumptions=(*picture.assumptions, fact)), identified


def without_repeats(picture: Picture) -> Picture:
    """Undo an enlargement of the depth map by repeated pixels."""
    height, width = picture.depth_lr.shape[-2:]
    block = enlarged_by(picture.depth_lr) if (height, width) == (picture.camera.height, picture.camera.width) else 1
    if block == 1 or height % block or width % block:
        return picture
    fact = Assumption(f"the depth map was enlarged x{block} by repeating pixels, which are dropped")
    depth_lr = picture.depth_lr[:, ::block, ::block]
    confidence = None if picture.confidence is None else picture.confidence[:, ::block, ::block]
    return replace(picture, depth_lr=depth_lr, confidence=confidence, assumptions=(*picture.assumptions, fact))

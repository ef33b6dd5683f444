"""Frames of a sequence for ``dsr upsample``: their poses, checks of these, and fusion with neighbouring frames."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dsr.geometry.camera import Camera
from dsr.geometry.poses import PosedMap, check_poses
from dsr.inference.sequences import View, fuse_views
from dsr.io.inputs import Picture
from dsr.io.pairs import Pair
from dsr.io.trajectories import read_poses
from dsr.notes import LIMITS, Assumption


class FrameSequence:
    """The frames of each folder of depth maps in order, with the poses of a file, or those that the frames have.

    Up to ``neighbours`` other frames vote on each one's depth. A file that is damaged, or does not fit, is a
    ValueError.
    """

    def __init__(
        self, pairs: Sequence[Pair], read: Callable[[Pair], Picture], neighbours: int, poses: Path | None
    ) -> None:
        self._read, self._count, self._file = read, neighbours, poses
        self._poses: Mapping[str, np.ndarray] | None = None
        self.given = poses is not None
        self._matched: list[Assumption] = []
        if poses is not None:
            trajectory = read_poses(poses)
            self._poses = trajectory.assign(pairs)
            self._without = len(pairs) - len(self._poses)
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

    def with_pose(self, pair: Pair, picture: Picture) -> Picture:
        """Return a frame with its pose from the file, if any; a ValueError if neighbours vote and it has no pose."""
        notes = list(self._matched)
        if self._poses is not None:
            picture = replace(picture, pose=self._poses.get(pair.name), up="")
        if picture.pose is None and self._count:
            where = "this capture has none; give --poses" if self._file is None else f"{self._file} has none"
            raise ValueError(f"--neighbours: expected a pose for each frame, {where}")
        if picture.pose is None and self._file is not None and self._without >= LIMITS["poses-missing"]:
            detail = f"{self._without} of {len(self._places)} frames have none"
            notes.append(
                Assumption(f"{self._file.name} has no pose of this frame", detail, "poses-missing", self._without)
            )
        return replace(picture, assumptions=(*picture.assumptions, *notes)) if notes else picture

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
        """Return a frame with its pose, its depth fused with that of its neighbours."""
        picture = self.with_pose(pair, picture)
        if not self._count or picture.pose is None:
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
            self._views[pair.name] = None if pose is None else View(picture.depth_lr, camera_lr(picture), pose)
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
    fused = fuse_views(View(picture.depth_lr, camera_lr(picture), picture.pose), views)
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


def camera_lr(picture: Picture) -> Camera:
    """Return the camera of a picture's depth map."""
    height, width = picture.depth_lr.shape[-2:]
    return picture.camera.rescale(width, height)

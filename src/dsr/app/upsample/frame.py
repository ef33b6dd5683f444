"""One picture of ``dsr upsample``: read it, upsample it, and write its folder of results."""

from __future__ import annotations

import contextlib
import functools
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from dsr.app.upsample.checks import align, check_together
from dsr.app.upsample.frames import Frames
from dsr.app.upsample.outputs import Result, ResultFolder, as_stored, bytes_of
from dsr.app.upsample.request import UpsampleRequest, Upsampling, files_of, inputs_with_neighbours
from dsr.app.upsample.sequence import FrameSequence
from dsr.app.upsample.stored import INFO, warnings_of
from dsr.degradation.sensors import Identified
from dsr.inference.any_ratio import AnyRatio
from dsr.inference.plausibility import find_filled
from dsr.inference.working_size import enlarged_by, find_sensor
from dsr.io.inputs import Picture, read_picture
from dsr.io.pairs import Pair
from dsr.methods.base import MapNoise, Surface
from dsr.methods.glass import NOTED
from dsr.notes import Assumption, expect_no_warning
from dsr.utils.console import one_line
from dsr.utils.guards import readable, refusing_excess
from dsr.utils.processes import scene_lock
from dsr.utils.progress import Progress, megabytes, show_length

Message = str | Sequence[Assumption]  # a line, or notes, of which those are shown that no earlier picture had
Tell = Callable[[Message], object]
_KEPT = 2**26  # numbers in the photos that were read last and are kept
_WHITE = 1.5  # noise that is alike over fewer pixels counts as white
_GLASS = 0.005  # share of the pixels that look like glass from which it is said


class Done(NamedTuple):
    """A picture that was worked on: the outcome with the bytes of its results, or the problem in one line."""

    pair: Pair
    target: Path
    outcome: str = ""
    size: int = 0
    problem: str | None = None


class FrameWork:
    """Upsamples the pictures of a request, one at a time; those of other shards are neighbours and determine units."""

    def __init__(self, request: UpsampleRequest, frames: Frames) -> None:
        self._request, self._frames = request, frames
        self._pictures: OrderedDict[str, Picture] = OrderedDict()
        self._sequence = FrameSequence(frames.whole, self._read, request.frames.neighbours, request.frames.trajectory)

    def check_together(self, jobs: Sequence[tuple[Pair, Path]]) -> Frames:
        """Return the frames with the warnings that concern several of them, if any of the jobs is to be done."""
        if any(self._is_to_do(*job) for job in jobs):
            warnings = check_together(self._frames.whole, self._request.reading, self._read, self._sequence)
            self._frames = replace(self._frames, warnings=warnings)
        return self._frames

    def __call__(self, pair: Pair, target: Path, tell: Tell, progress: Progress) -> Done:
        """Upsample a picture; an error is its problem, and other pictures go on."""
        wanted = self._request.results
        try:
            with refusing_excess(), contextlib.ExitStack() as stack:
                folder = self._folder(pair, target)
                if not wanted.dry_run and not self._is_done(folder):
                    stack.enter_context(scene_lock(wanted.output, str(target.relative_to(wanted.output))))
                    folder.look()  # another command may have been at work there
                return self._work(pair, folder, tell, progress)
        except (ValueError, OSError) as error:
            return Done(pair, target, problem=one_line(error))

    def _work(self, pair: Pair, folder: ResultFolder, tell: Tell, progress: Progress) -> Done:
        """Upsample a picture that no other command is at."""
        request, wanted, how = self._request, self._request.results, self._request.upsampling
        folder.expect_agreement()
        if self._is_done(folder):
            warnings = warnings_of(folder.earlier)
            self._expect_no_warning(pair, folder, warnings)
            tell(warnings)
            tell(f"{pair.name}: complete already, in {folder.path}")
            return Done(pair, folder.path, "complete already", bytes_of(folder.path, folder.earlier["files"]))
        begun = time.perf_counter()
        picture = self._read(pair)
        picture = replace(picture, assumptions=(*picture.assumptions, *self._frames.warnings.get(pair.name, ())))
        picture, sensor = prepare(picture, how.sensor, functools.partial(self._sequence.fuse, pair))
        picture = align(picture, register=request.reading.register)
        size_lr = (picture.depth_lr.shape[-2], picture.depth_lr.shape[-1])
        planned = self._upsampler.plan((picture.camera.height, picture.camera.width), size_lr)
        self._expect_no_warning(pair, folder, picture.assumptions)
        tell(picture.assumptions)
        if wanted.dry_run:
            tell(f"{pair.name}: {planned.text} -> {folder.path}")
            return Done(pair, folder.path, "to do")
        folder.expect_free(files_of(pair, request.reading).values())
        read = time.perf_counter()
        kept = folder.surface(picture.camera, errors=any(part.errors for part in wanted.of_frame))
        if kept is None:
            with progress.task("steps") as step:
                surface = self._upsampler.upsample(picture.rgb, picture.depth_lr, picture.camera, step, sensor)
            surface = as_stored(surface.map(lambda values: values.cpu()))
            tell(_describe(surface, how))
            surface = surface.without_dubious(wanted.max_error / 100) if wanted.certain else surface
        else:
            surface = kept._replace(filled=find_filled(kept.depth, picture.depth_lr))
        result = Result(picture, surface, planned, wanted, readable(pair.name))
        seconds = {"reading": read - begun, "upsampling": time.perf_counter() - read}
        stored = folder.store(result, seconds, reused=kept is not None)
        tell(stored.notes)
        brief = [f"{planned.method} x{planned.scale}", *_in_brief(surface.noise, result.shares)]
        brief += [f"{stored.seconds['total']:.1f} s", megabytes(stored.size)]
        tell(f"{pair.name}: {', '.join(brief)} -> {folder.path}")
        return Done(pair, folder.path, "done", stored.size)

    def _folder(self, pair: Pair, target: Path) -> ResultFolder:
        """Return the folder of a picture's results, with what these depend on."""
        inputs = inputs_with_neighbours(self._request, pair, self._sequence.neighbours(pair))
        return ResultFolder(target, inputs, self._request.settings, overwrite=self._request.results.overwrite)

    def _is_done(self, folder: ResultFolder) -> bool:
        return folder.is_done(self._request.results, checked=self._request.reading.strict)

    def _is_to_do(self, pair: Pair, target: Path) -> bool:
        """Return whether a picture is not complete; one that cannot be read is reported when its turn comes."""
        try:
            return not (target / INFO).is_file() or not self._is_done(self._folder(pair, target))
        except (ValueError, OSError):
            return True

    def _expect_no_warning(self, pair: Pair, folder: ResultFolder, notes: Sequence[Assumption]) -> None:
        """Raise ValueError if one is a warning, and that is not allowed; with one line for all frames of a folder."""
        if self._request.reading.strict:
            several = folder.path != self._request.results.output
            expect_no_warning(str(pair.depth.parent if several else pair.depth), notes, brief=several)

    @functools.cached_property
    def _upsampler(self) -> AnyRatio:
        """The method, whose weights are loaded once."""
        return self._request.upsampling.upsampler()

    def _read(self, pair: Pair) -> Picture:
        """Return a picture; the last ones are kept, for the checks, for the frames that they vote on and their own."""
        if pair.name not in self._pictures:
            with refusing_excess():
                picture = read_picture(pair, self._request.reading, self._frames.units)
                self._pictures[pair.name] = without_repeats(picture)
        self._pictures.move_to_end(pair.name)
        while len(self._pictures) > 1 and sum(each.rgb.numel() for each in self._pictures.values()) > _KEPT:
            self._pictures.popitem(last=False)
        return self._pictures[pair.name]


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


def _describe(surface: Surface, how: Upsampling) -> list[Assumption]:
    """Return notes on an estimated noise of the input, on outliers, on what looks like glass, and on wide holes."""
    notes, noise = [], surface.noise
    if noise is not None and "noise" not in how.arguments:
        text = f"about {show_length(noise.deviation, 2)}"
        text += f", correlated over {noise.extent:.0f} pixels" if noise.extent > _WHITE else ""
        text += f": worked on at 1/{noise.reduced}" if noise.reduced > 1 else ""
        option = "--noise" if noise.reduced == 1 else "--working-size"
        notes.append(Assumption("noise of the depth map", f"{text}; {option} overrides it"))
    if surface.outliers is not None and surface.outliers.pixels:
        text = "depth far from everything around it, or nearer than 5 cm, is treated as holes"
        notes.append(Assumption(text, f"pixels: {surface.outliers.pixels}, patches: {surface.outliers.patches}"))
    if surface.glass is not None and surface.glass >= _GLASS:
        text = "photo and depth disagree as they do on glass, mirrors and gloss; do not trust the depth there"
        of_pixels = f"{surface.glass:.1%} of the pixels, expected to be off by more than {NOTED:.0%}"
        notes.append(Assumption(text, of_pixels))
    share = float(surface.depth.isnan().float().mean())
    if how.fill == "small" and share:
        text = f"holes wider than {how.max_hole:g} degrees stay holes"
        notes.append(Assumption(text, f"{share:.1%} of the pixels; --fill all fills them, too"))
    return notes


def _in_brief(noise: MapNoise | None, shares: Mapping[str, float]) -> list[str]:
    """Return the noise of the input, the size that it was worked on at, and the shares of the pixels that are not 0.

    A share is 0 % or 100 % only if it is exactly that.
    """
    brief = []
    if noise is not None:
        brief.append(f"noise {show_length(noise.deviation, 2)}")
        if noise.reduced > 1:
            brief.append(f"worked on at 1/{noise.reduced}")
    words = {"open": "left open", "glass": "like glass"}
    for name, share in shares.items():
        if share:
            percent = f"{min(max(round(100 * share, 1), 0.1), 99.9):g}%" if share < 1 else f"{share:.0%}"
            brief.append(f"{words.get(name, name)} {percent}")
    return brief

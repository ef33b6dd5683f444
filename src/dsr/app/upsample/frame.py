"""One picture of ``dsr upsample``: read it, upsample it, and write its folder of results."""

from __future__ import annotations

import functools
import math
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dsr.app.upsample.checks import align, check_together
from dsr.app.upsample.frames import Frames
from dsr.app.upsample.outputs import (
    PreviousRun,
    begin,
    described,
    expect_free,
    finish,
    kept_surface,
    output_encoding,
    read_previous_run,
    stored_bytes,
)
from dsr.app.upsample.parts import METRES, PARTS, Result, as_stored, write_parts
from dsr.app.upsample.reporting import Messages
from dsr.app.upsample.request import UpsampleRequest, Upsampling, files_of, inputs_with_neighbours
from dsr.app.upsample.sequence import FrameSequence
from dsr.degradation.sensors import Identified
from dsr.inference import AnyRatio, Plan, enlarged_by, find_filled, find_sensor
from dsr.io.exports import FLAT
from dsr.io.inputs import Picture, read_picture
from dsr.io.pairs import Pair
from dsr.methods.base import MapNoise, Surface
from dsr.methods.glass import NOTED
from dsr.notes import CHECKS, Assumption, expect_no_warning
from dsr.utils.guards import readable, refusing_excess
from dsr.utils.processes import scene_lock
from dsr.utils.progress import Progress, megabytes, show_length
from dsr.utils.versions import package_versions

TO_DO, COMPLETE = "to do", "complete already"
"""Outcomes of a picture that is not computed."""
_WHITE = 1.5
"""Noise that is alike over fewer pixels counts as white."""
_GLASS = 0.005
"""Share of the pixels that look like glass from which it is said."""
_PACKAGES = ("dsr", "torch", "numpy", "opencv-python-headless")


class FrameWork:
    """Upsamples the pictures of a request, one at a time.

    Args:
        request: the request.
        frames: all of its pictures, also those of other shards, which determine units and neighbours.

    Attributes:
        seconds: the time that the last picture of a dry run takes, on two CPU cores; None where it is not known.
        bytes: the size of its results, or that of the last picture that is complete.

    Raises:
        ValueError: the file of poses is damaged, or does not fit the pictures.

    """

    def __init__(self, request: UpsampleRequest, frames: Frames) -> None:
        self._request, self._frames = request, frames
        self.seconds: float | None = None
        self.bytes = 0.0
        self._read_last: tuple[str, Picture] | None = None
        self._sequence = FrameSequence(frames.whole, self._read, request.frames.neighbours, request.frames.trajectory)

    def check_together(self, jobs: Sequence[tuple[Pair, Path]]) -> Frames:
        """Return the frames with the warnings that concern several of them, if any frame is to be done.

        Args:
            jobs: the pictures to work on, each with the folder of its results.

        """
        if any(self.is_to_do(*job) for job in jobs):

            def read(pair: Pair) -> Picture:
                with refusing_excess():
                    self._read_last = pair.name, self._read(pair)
                return self._read_last[1]

            frames = self._frames
            warnings = check_together(frames.whole, self._request.reading, read, self._sequence)
            self._frames = replace(frames, warnings=warnings)
        return self._frames

    def __call__(self, pair: Pair, target: Path, reporter: Messages, progress: Progress) -> str:
        """Upsample one picture, and return the outcome; commands that have it in common do so one after the other."""
        job, output = self._job(pair, target), self._request.results.output
        if self._request.results.dry_run or job.is_done():
            return self._work(job, reporter, progress)
        with scene_lock(output, str(target.relative_to(output))):
            return self._work(replace(job, earlier=read_previous_run(target)), reporter, progress)

    def is_to_do(self, pair: Pair, target: Path) -> bool:
        """Return whether a picture is not complete; one that cannot be read is reported when its turn comes."""
        try:
            return read_previous_run(target) is None or not self._job(pair, target).is_done()
        except (ValueError, OSError):
            return True

    def _job(self, pair: Pair, target: Path) -> _Job:
        """Return what there is to do for a picture."""
        depends_on = inputs_with_neighbours(self._request, pair, self._sequence.neighbours(pair))
        return _Job(self._request, pair, target, self._request.settings, depends_on, read_previous_run(target))

    def _work(self, job: _Job, reporter: Messages, progress: Progress) -> str:
        """Upsample a picture that no other command is at, and return the outcome."""
        request, sequence, pair, target = self._request, self._sequence, job.pair, job.target
        how, wanted = request.upsampling, request.results
        job.expect_agreement()
        if job.is_done():
            earlier, files = ((), ()) if job.earlier is None else (job.earlier.warnings, job.earlier.files)
            job.expect_no_warning(earlier)
            self.bytes = stored_bytes(target, files)
            reporter.facts(earlier)
            reporter.say(f"{pair.name}: {COMPLETE}, in {target}")
            return COMPLETE
        times = Times(progress)
        times.begin("reading")
        picture = self._read(pair)
        picture = replace(picture, assumptions=(*picture.assumptions, *self._frames.warnings.get(pair.name, ())))
        picture, identified = prepare(picture, how.sensor, functools.partial(sequence.fuse, pair))
        picture = align(picture, register=request.reading.register)
        size_lr = (picture.depth_lr.shape[-2], picture.depth_lr.shape[-1])
        size = (picture.camera.height, picture.camera.width)
        planned = self._upsampler.plan(size, size_lr)
        job.expect_no_warning(picture.assumptions)
        reporter.facts(picture.assumptions)
        if wanted.dry_run:
            self.bytes, writing = wanted.cost(math.prod(size))
            self.seconds = None if planned.seconds is None else planned.seconds + writing
            reporter.say(f"{pair.name}: {planned.text}, about {megabytes(self.bytes)} -> {target}")
            return TO_DO
        inputs = files_of(pair, request.reading).values()
        expect_free(target, inputs, ours=wanted.overwrite or job.earlier is not None)
        errors = any(part.errors for part in wanted.of_frame)
        surface = kept_surface(target, picture.camera, errors=errors) if job.reusable else None
        times.begin("upsampling")
        if surface is not None and job.earlier is not None:
            times.kept = job.earlier.seconds
            surface = surface._replace(filled=find_filled(surface.depth, picture.depth_lr))
        else:
            surface = as_stored(self._upsample(picture, identified, progress))
            reporter.facts(_describe(surface, how))
            if wanted.certain:
                surface = surface.without_dubious(wanted.max_error / 100)
        times.begin("writing")
        begin(target, job.settings, job.inputs, () if job.earlier is None else job.earlier.files)
        title = f"{readable(pair.name)}, {planned.method} x{planned.scale}"
        result = Result(picture, surface, output_encoding(picture.encoding, wanted.format), title, wanted)
        kept = job.earlier if job.same else None
        facts, seconds, self.bytes = write_result(
            target, result, planned, times, job.inputs, job.settings, job.earlier, kept
        )
        reporter.facts(facts)
        brief = _in_brief(surface.noise, result.shares)
        brief += [f"{seconds['total']:.1f} s", megabytes(self.bytes)]
        reporter.say(f"{pair.name}: {', '.join([f'{planned.method} x{planned.scale}', *brief])} -> {target}")
        return "done"

    @functools.cached_property
    def _upsampler(self) -> AnyRatio:
        """The method, whose weights are loaded once."""
        return self._request.upsampling.upsampler()

    def _upsample(self, picture: Picture, sensor: Identified | None, progress: Progress) -> Surface:
        """Compute the high-resolution depth with its expected errors, on the CPU."""
        with progress.task("steps") as step:
            surface = self._upsampler.upsample(picture.rgb, picture.depth_lr, picture.camera, step, sensor)
        return surface.map(lambda values: values.cpu())

    def _read(self, pair: Pair) -> Picture:
        """Read a picture, unless it was the last one that the checks read."""
        last, self._read_last = self._read_last, None
        if last is not None and last[0] == pair.name:
            return last[1]
        return without_repeats(read_picture(pair, self._request.reading, self._frames.units))


class Times:
    """Measures the seconds of each stage of a picture and shows which one begins; some may be known beforehand.

    Attributes:
        kept: the seconds of an earlier run whose result is kept, which :meth:`together` counts, too.

    """

    def __init__(self, progress: Progress, **seconds: float) -> None:
        self._progress, self._seconds = progress, {stage: round(each, 3) for stage, each in seconds.items()}
        self._stage, self._since = "", 0.0
        self.kept: Mapping[str, float] = {}

    def begin(self, stage: str) -> None:
        """Begin reading, upsampling or writing."""
        self.read()
        self._stage, self._since = stage, time.perf_counter()
        self._progress.stage(stage)

    def read(self) -> dict[str, float]:
        """Return the seconds of each stage so far, to milliseconds, and their sum as ``total``."""
        if self._stage:
            self._seconds[self._stage] = round(time.perf_counter() - self._since, 3)
        return _with_total(self._seconds)

    def together(self, seconds: Mapping[str, float]) -> dict[str, float]:
        """Return the seconds from :meth:`read` plus :attr:`kept`."""
        stages = dict.fromkeys((*self.kept, *seconds))
        return _with_total({name: self.kept.get(name, 0.0) + seconds.get(name, 0.0) for name in stages})


def _with_total(seconds: Mapping[str, float]) -> dict[str, float]:
    """Return the seconds of stages, to milliseconds, with their sum as ``total``."""
    found = {name: round(each, 3) for name, each in seconds.items() if name != "total"}
    return {**found, "total": round(sum(found.values()), 3)}


@dataclass(frozen=True)
class _Job:
    """One picture, and the earlier run in its folder, if any."""

    request: UpsampleRequest
    pair: Pair
    target: Path
    settings: Mapping[str, Any]
    inputs: Mapping[str, Any]
    earlier: PreviousRun | None

    @property
    def reusable(self) -> bool:
        """Whether the earlier run finished with the same inputs and settings, and may be kept."""
        return self.earlier is not None and self.earlier.complete and self.same and not self.request.results.overwrite

    @property
    def same(self) -> bool:
        """Whether the earlier run had the same inputs and settings."""
        return self.earlier is not None and (self.earlier.settings, self.earlier.inputs) == (self.settings, self.inputs)

    def expect_agreement(self) -> None:
        """Raise ValueError if the folder holds a complete result of other inputs or settings."""
        earlier = self.earlier
        if earlier is None or not earlier.complete or self.same or self.request.results.overwrite:
            return
        if earlier.inputs != self.inputs:
            what = "other inputs: " + ", ".join(str(entry.get("file")) for entry in earlier.inputs.values())
        else:
            changed = [name for name, value in self.settings.items() if earlier.settings.get(name) != value]
            said = ((name, earlier.settings.get(name)) for name in changed)
            what = "other settings: " + ", ".join(
                f"no {name}" if old is None else f"{name} {old}" for name, old in said
            )
        raise ValueError(f"{self.target}: holds a result of {what}; take another -o, or --overwrite")

    def expect_no_warning(self, notes: Sequence[Assumption]) -> None:
        """Raise ValueError if one is a warning, and that is not allowed; with one line for all frames of a folder."""
        if self.request.reading.strict:
            several = self.target != self.request.results.output
            where = self.pair.depth.parent if several else self.pair.depth
            expect_no_warning(str(where), notes, brief=several)

    def is_done(self) -> bool:
        """Return whether all requested parts exist as wanted, and were checked as now if no warning is allowed.

        A mesh of large triangles is none of every pixel; the other one serves for both.
        """
        if not self.reusable or self.earlier is None:
            return False
        if self.request.reading.strict and self.earlier.checks != CHECKS:
            return False
        wanted = self.request.results
        there = {name for name in self.earlier.files if (self.target / name).is_file()}
        if METRES not in there and any(part.name == "depth" for part in wanted.of_frame):
            return False
        shapes = [self.earlier.shapes.get(part.name) for part in wanted.of_frame]
        if wanted.keep == "all" and any(isinstance(shape, dict) and shape.get("how") == FLAT for shape in shapes):
            return False
        return all(there & set(part.files) for part in wanted.of_frame)


def prepare(picture: Picture, sensor: str, fuse: Callable[[Picture], Picture]) -> tuple[Picture, Identified | None]:
    """Return a picture fused with its neighbours, and the sensor identified from its own depth as read.

    Args:
        sensor: see :func:`dsr.inference.find_sensor`.
        fuse: fuses it with its neighbours.

    """
    try:
        identified = find_sensor(picture.depth_lr, sensor, picture.device_name)
    except ValueError as error:
        raise ValueError(f"--{error}") from error
    return _with_sensor(fuse(picture), identified), identified


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


def _with_sensor(picture: Picture, identified: Identified | None) -> Picture:
    """Return a picture with a note on the sensor, if it is known and was not given."""
    if identified is None or identified.by == "request":
        return picture
    reason = (
        f"named {picture.device_name}"
        if identified.by == "file"
        else f"by its depth in steps of disparity with f B / step = {identified.constant:.0f} m"
    )
    fact = Assumption("sensor", f"{identified.sensor.name}, {reason}; --sensor overrides it")
    return replace(picture, assumptions=(*picture.assumptions, fact))


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


def write_result(
    folder: Path, result: Result, planned: Plan, times: Times, inputs: Mapping[str, Any],
    settings: Mapping[str, Any], earlier: PreviousRun | None = None, kept: PreviousRun | None = None,
) -> tuple[list[Assumption], dict[str, float], int]:  # fmt: skip
    """Write the parts of a result and ``info.json``, and return notes, the seconds of the stages, and the size.

    Args:
        folder: of the result.
        planned, times: how the result was computed, and how long that took.
        inputs, settings: what it depends on, as values for JSON.
        earlier: the run whose files are in the folder.
        kept: that run, if its other files stay.

    """
    picture, surface = result.picture, result.surface
    outputs = write_parts(folder, result)
    files = [name for output in outputs.values() for name in output.files]
    facts = list(dict.fromkeys(note for output in outputs.values() for note in output.notes))
    shapes = {
        name: output.shape._asdict()
        for output in outputs.values() if output.shape is not None
        for name in outputs if set(PARTS[name].files) & set(output.files)
    }  # fmt: skip
    counts = {name: shape for name, shape in (kept.shapes if kept else {}).items() if name not in outputs} | shapes
    if surface.outliers is not None:
        counts["outliers"] = surface.outliers._asdict()
    others = [name for name in (kept.files if kept else ()) if name not in files]
    notes = (*picture.assumptions, *facts)
    texts = tuple(note.text for note in notes)
    said = [each for each in (kept.said if kept and others else ()) if not each.startswith(texts)]
    shares = {name: round(share, 6) for name, share in result.shares.items()}
    entries = {
        "inputs": inputs,
        "settings": settings,
        "method": planned.method,
        "scale": planned.scale,
        "plan": planned.text,
        "noise": surface.noise._asdict() if surface.noise else kept.noise if kept else None,
        **described(picture, result.encoding),
        **counts,
        "shares": {**(kept.shares if kept else {}), **shares},
        "assumptions": [*map(str, notes), *said],
        "checks": CHECKS,
        "warnings": [fact.record() for fact in notes if fact.code],
        "seconds": times.together(seconds := times.read()),
        "versions": {"python": platform.python_version(), **package_versions(_PACKAGES)},
    }
    return facts, seconds, finish(folder, earlier, entries, [*files, *others])

"""The command behind ``dsr upsample``: read the user's files, and write a folder of results for each picture."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from dsr.app.upsample.checks import align, check_together
from dsr.app.upsample.frames import Frames, FrameSequence, find_frames, prepare, without_repeats
from dsr.app.upsample.outputs import Result, ResultFolder, as_stored
from dsr.app.upsample.request import UpsampleRequest, Upsampling, inputs_of, inputs_with_neighbours
from dsr.app.upsample.stored import EXPORTS, INFO, warnings_of, write_scene
from dsr.inference.plausibility import find_filled
from dsr.inference.resizing import size_of
from dsr.inference.steady import KEPT, Steady
from dsr.io.images import pixels_in_header
from dsr.io.inputs import Picture, read_geometry, read_picture
from dsr.io.pairs import Pair
from dsr.io.trajectories import USUAL_SIZE, read_poses
from dsr.methods.base import MapNoise, Surface
from dsr.methods.glass import NOTED
from dsr.notes import Assumption, expect_no_warning
from dsr.utils.console import ConsoleProgress, one_line, show
from dsr.utils.files import expect_targets, write_text
from dsr.utils.guards import path_within, readable, refusing_excess
from dsr.utils.processes import Pool, at_work, scene_lock
from dsr.utils.progress import Progress, clock, megabytes, show_length

Message = str | Sequence[Assumption]  # a line, or notes, of which those are shown that no earlier frame had
Tell = Callable[[Message], object]
_UNPOSED = {  # what is written of a single frame without a pose, by part
    "gaussian": ": images, depths and depth_params.json are written, and no sparse model; --poses gives one",
    "nerfstudio": ": it stands at the origin",
}
_SHOWN = 5  # number of names that a line lists; further ones are only counted
_KEPT = 2**26  # numbers in the photos that were read last and are kept
_WHITE = 1.5  # noise that is alike over fewer pixels counts as white
_GLASS = 0.005  # share of the pixels that look like glass from which it is said


class Done(NamedTuple):
    """A frame that was worked on: the outcome with the bytes of its results, or the problem in one line."""

    pair: Pair
    target: Path
    outcome: str = ""
    size: int = 0
    problem: str | None = None


class Reporter:
    """Shows every note once, and counts the frames that it applies to."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self.notes: dict[str, list[Assumption]] = {}  # of the frames, by their statement

    def tell(self, message: Message) -> None:
        """Show a line, or the notes that no earlier frame had."""
        if isinstance(message, str):
            show(self._console, message)
            return
        for note in message:
            if note.statement not in self.notes:
                show(self._console, f"  {note}")
            self.notes.setdefault(note.statement, []).append(note)

    def summary(self, pictures: int) -> None:
        """Show the notes that apply to some of the pictures only."""
        for text, notes in self.notes.items():
            if len(notes) < pictures:
                show(self._console, f"  {len(notes)} of {pictures} pictures: {text}")


def run(request: UpsampleRequest, console: Console) -> list[str]:
    """Upsample all frames of a request, and return the problems, one line each."""
    frames = find_frames(request)
    _check_poses(request, frames, console)
    if request.results.dry_run:
        return _run(request, frames, console)
    with at_work(request.results.output, json.dumps(request.settings, sort_keys=True)):
        return _run(request, frames, console)


def _run(request: UpsampleRequest, frames: Frames, console: Console) -> list[str]:
    wanted, shard, pairs = request.results, request.frames.shard, frames.found.pairs
    started = time.monotonic()
    written = [*(name for part in wanted.of_all for name in part.files), EXPORTS]
    if shard is not None:
        written = [f"shard-{shard.number}-of-{shard.count}.json"]
    expect_targets(wanted.output, written)
    _show_found(request, frames, console)
    reporter = Reporter(console)
    finished: list[Done] = []
    problems: dict[str, list[str]] = {}
    for done in work_through(request, frames, reporter.tell, ConsoleProgress(console)):
        if done.problem is None:
            finished.append(done)
        else:
            problems.setdefault(done.problem, []).append(done.pair.name)
    lines = [f"{_listed(names)}: {message}" if len(pairs) > 1 else message for message, names in problems.items()]
    if finished and wanted.of_all and not wanted.dry_run and shard is None:
        folders = {done.pair.name: done.target for done in finished}  # as workers ended, which is not the frames' order
        folders = {pair.name: folders[pair.name] for pair in pairs if pair.name in folders}
        exports, failures = write_scene(wanted.output, folders, wanted.of_all, overwrite=wanted.overwrite)
        for part, path in exports.items():
            show(console, f"{part}: {len(folders)} frames -> {path}")
        lines += failures
    outcomes = Counter(done.outcome for done in finished)
    if not frames.single:
        counts = [f"{count} {outcome}" for outcome, count in outcomes.items()]
        counts += [f"{sum(map(len, problems.values()))} failed"] if problems else []
        took = ""
        if not wanted.dry_run:
            reporter.summary(len(finished))
            size = megabytes(sum(done.size for done in finished))
            took = f" in {clock(time.monotonic() - started)}, {size}"
        pictures = "1 picture" if len(pairs) == 1 else f"{len(pairs)} pictures"
        show(console, f"{pictures}: {', '.join(counts) or 'nothing to do'}{took} -> {wanted.output}")
    if shard is not None and not wanted.dry_run:
        warnings = [(notes[0].record(), len(notes)) for notes in reporter.notes.values() if notes[0].code]
        summary = {
            "shard": str(shard),
            "outcomes": outcomes,
            "failed": [{"problem": problem, "frames": names} for problem, names in problems.items()],
            "warnings": [{**warning, "pictures": count} for warning, count in warnings],
            "seconds": round(time.monotonic() - started, 3),
        }
        write_text(wanted.output / written[0], json.dumps(summary, indent=2) + "\n")
    return lines


def work_through(request: UpsampleRequest, frames: Frames, tell: Tell, progress: Progress) -> Iterator[Done]:
    """Upsample frames in ``--workers`` processes, each with its share of the cores; yield each once it is done."""
    output = request.results.output  # the folder of a single frame; no link leads those of several out of it
    jobs = [(pair, output if frames.single else path_within(output, pair.name, output)) for pair in frames.found.pairs]
    workers = min(request.frames.workers, len(jobs))
    work = FrameWork(request, frames)  # raises for poses that do not fit
    frames = work.check_together(jobs)
    if workers <= 1:
        for job in progress.track(jobs, "upsample", label=lambda job: job[0].name, lines=False):
            yield work(*job, tell, progress)
        return
    del work  # and the frames that it has read
    left, threads = list(jobs), max(1, (os.cpu_count() or 1) // workers)
    with Pool(workers, _begin, (request, frames), threads, progress.say) as pool:
        results = pool.results(_remote, jobs)
        try:
            for job, (done, messages) in progress.track(
                results, "upsample", len(jobs), label=lambda each: each[0][0].name
            ):
                left.remove(job)
                for message in messages:
                    tell(message)
                yield done
        except ChildProcessError as error:
            yield from (Done(*job, problem=str(error)) for job in left)


def _begin(request: UpsampleRequest, frames: Frames) -> FrameWork:
    return FrameWork(request, frames, kept=_KEPT if request.frames.neighbours else 0)


def _remote(work: FrameWork, job: tuple[Pair, Path]) -> tuple[Done, list[Message]]:
    """Upsample a frame in a worker, and return what is to be told of it, too."""
    messages: list[Message] = []
    return work(*job, messages.append, Progress()), messages


def _check_poses(request: UpsampleRequest, frames: Frames, console: Console) -> None:
    """Refuse frames without a pose, of the file or the capture, for a part that needs one; one alone gets a note."""
    parts = [part for part in request.results.of_all if part.poses]
    if not parts:
        return
    if request.frames.trajectory is not None:
        given = read_poses(request.frames.trajectory).assign(frames.whole)
        posed = {pair.name: pair.name in given for pair in frames.whole}
    else:
        posed = {pair.name: True for pair in frames.whole}
        for pair in frames.whole:
            with contextlib.suppress(ValueError, OSError):  # it is reported as a frame of its own
                geometry, _ = read_geometry(pair, pixels_in_header(pair.rgb) or USUAL_SIZE, request.reading)
                posed[pair.name] = geometry.pose is not None
    missing = [name for name, has in posed.items() if not has]
    for part in parts:
        if missing and len(posed) > 1:
            count = f"{len(missing)} of {len(posed)}"
            text = f"expected a pose of each frame, got none for {count}, such as {missing[0]}; --poses gives them"
            raise ValueError(f"{part.name}: {text}")
        if missing:
            show(console, f"--with {part.name}: the frame has no pose{_UNPOSED[part.name]}")


def _show_found(request: UpsampleRequest, frames: Frames, console: Console) -> None:
    found, total, shard = frames.found, len(frames.whole), request.frames.shard
    named = total == 1 and len(found.pairs) == 1
    lines = [f"{found.pairs[0].rgb} and {found.pairs[0].depth}" if named else f"{total} pairs of photo and depth map"]
    lines += [f"  {fact}" for fact in found.assumptions]
    if found.unpaired:
        names = _listed([path.name for path in found.unpaired])
        lines.append(f"  {len(found.unpaired)} without a partner, left out: {names}")
    if shard is not None:
        block = shard.block(total)
        lines.append(
            f"shard {shard}: {f'frames {block.start + 1} to {block.stop}' if block else 'no frame'} of {total}"
        )
        if request.results.of_all:
            names = ", ".join(part.name for part in request.results.of_all)
            lines.append(f"  {names}: of all frames, by the same command without --shard")
    for line in lines:
        show(console, line)


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


class FrameWork:
    """Upsamples the frames of a request, one at a time; those of other shards are neighbours and determine units."""

    def __init__(self, request: UpsampleRequest, frames: Frames, kept: int = _KEPT) -> None:
        self._request, self._frames, self._kept = request, frames, kept
        self._pictures: OrderedDict[str, Picture] = OrderedDict()
        self._sequence = FrameSequence(frames.whole, self._read, request.frames.neighbours, request.frames.trajectory)
        self._steady, self._recording = Steady(), Path()  # of the folder of the last frame
        self._before: deque[tuple[Pair, ResultFolder]] = deque(maxlen=KEPT)  # complete ones that it was not told of

    def check_together(self, jobs: Sequence[tuple[Pair, Path]]) -> Frames:
        """Return the frames with the warnings that concern several of them, if any of the jobs is to be done."""
        for pair, target in jobs:
            done = False  # also if it cannot be read, which is reported when its turn comes
            with contextlib.suppress(ValueError, OSError):
                done = (target / INFO).is_file() and self._folder(pair, target).done
            if not done:
                warnings = check_together(self._frames.whole, self._request.reading, self._read, self._sequence)
                self._frames = replace(self._frames, warnings=warnings)
                break
        return self._frames

    def __call__(self, pair: Pair, target: Path, tell: Tell, progress: Progress) -> Done:
        """Upsample a frame; an error is its problem, and other frames go on."""
        wanted = self._request.results
        try:
            with refusing_excess(), contextlib.ExitStack() as stack:
                folder = self._folder(pair, target)
                if not wanted.dry_run and not folder.done:
                    stack.enter_context(scene_lock(wanted.output, str(target.relative_to(wanted.output))))
                    folder.look()  # another command may have been at work there
                return self._work(pair, folder, tell, progress)
        except (ValueError, OSError) as error:
            return Done(pair, target, problem=one_line(error))

    def _work(self, pair: Pair, folder: ResultFolder, tell: Tell, progress: Progress) -> Done:
        """Upsample a frame that no other command is at."""
        request, wanted, how = self._request, self._request.results, self._request.upsampling
        if pair.depth.parent != self._recording:
            self._steady, self._recording = Steady(), pair.depth.parent
            self._before.clear()
        folder.expect_agreement()
        if folder.done:
            warnings = warnings_of(folder.earlier)
            self._expect_no_warning(pair, folder, warnings)
            tell(warnings)
            tell(f"{pair.name}: complete already, in {folder.path}")
            self._before.append((pair, folder))
            return Done(pair, folder.path, "complete already", folder.size)
        begun = time.perf_counter()
        picture = self._read(pair)
        picture = replace(picture, assumptions=(*picture.assumptions, *self._frames.warnings.get(pair.name, ())))
        picture, sensor = prepare(picture, how.sensor, functools.partial(self._sequence.fuse, pair))
        picture = align(picture, register=request.reading.register)
        planned = how.upsampler.plan(size_of(picture.rgb), size_of(picture.depth_lr))
        self._expect_no_warning(pair, folder, picture.assumptions)
        tell(picture.assumptions)
        if wanted.dry_run:
            tell(f"{pair.name}: {planned.text} -> {folder.path}")
            return Done(pair, folder.path, "to do")
        sources = inputs_of(pair, request.reading).values()
        folder.expect_free(each if isinstance(each, Path) else each.file for each in sources)
        read = time.perf_counter()
        kept = folder.surface(picture.camera, errors=any(part.errors for part in wanted.of_frame))
        steady = self._steady_before() if request.frames.steady else None
        if kept is None:
            with progress.task("steps") as step:
                surface = how.upsampler.upsample(picture.rgb, picture.depth_lr, picture.camera, step, sensor)
            surface = as_stored(surface)
            tell(_describe(surface, how))
            surface = surface if steady is None else as_stored(steady.average(surface, picture.rgb))
            surface = surface.without_dubious(wanted.max_error / 100) if wanted.certain else surface
        else:
            surface = kept._replace(filled=find_filled(kept.depth, picture.depth_lr))
        if steady is not None:
            steady.remember(surface, picture.rgb)
        result = Result(picture, surface, planned, wanted, readable(pair.name))
        seconds = {"reading": read - begun, "upsampling": time.perf_counter() - read}
        tell(folder.store(result, seconds, reused=kept is not None))
        brief = [f"{planned.method} x{planned.scale}", *_in_brief(surface.noise, result.shares)]
        brief += [f"{time.perf_counter() - begun:.1f} s", megabytes(folder.size)]
        tell(f"{pair.name}: {', '.join(brief)} -> {folder.path}")
        return Done(pair, folder.path, "done", folder.size)

    def _steady_before(self) -> Steady:
        """Return the mean of the results before a frame, of which those of earlier runs are read back."""
        for earlier, folder in self._before:
            picture = self._read(earlier)
            if (surface := folder.surface(picture.camera, errors=True)) is None:
                raise ValueError(f"{folder.path}: expected depth and confidence, which the next frame needs, got none")
            self._steady.remember(surface, picture.rgb)
        self._before.clear()
        return self._steady

    def _folder(self, pair: Pair, target: Path) -> ResultFolder:
        request = self._request
        inputs = inputs_with_neighbours(request, pair, self._sequence.neighbours(pair))
        return ResultFolder(target, inputs, request.settings, request.results, strict=request.reading.strict)

    def _expect_no_warning(self, pair: Pair, folder: ResultFolder, notes: Sequence[Assumption]) -> None:
        """Raise ValueError if one is a warning, and that is not allowed; with one line for all frames of a folder."""
        if self._request.reading.strict:
            several = folder.path != self._request.results.output
            expect_no_warning(str(pair.depth.parent if several else pair.depth), notes, brief=several)

    def _read(self, pair: Pair) -> Picture:
        """Return a frame as it was read; the last ones are kept."""
        if pair.name not in self._pictures:
            with refusing_excess():
                picture = read_picture(pair, self._request.reading, self._frames.units)
                self._pictures[pair.name] = without_repeats(picture)
        self._pictures.move_to_end(pair.name)
        while len(self._pictures) > 1 and sum(each.rgb.numel() for each in self._pictures.values()) > self._kept:
            self._pictures.popitem(last=False)
        return self._pictures[pair.name]


def _describe(surface: Surface, how: Upsampling) -> list[Assumption]:
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
    brief = []
    if noise is not None:
        brief.append(f"noise {show_length(noise.deviation, 2)}")
        if noise.reduced > 1:
            brief.append(f"worked on at 1/{noise.reduced}")
    words = {"open": "left open", "glass": "like glass"}
    for name, share in shares.items():
        if share:  # 0 % and 100 % are exactly that
            percent = f"{min(max(round(100 * share, 1), 0.1), 99.9):g}%" if share < 1 else f"{share:.0%}"
            brief.append(f"{words.get(name, name)} {percent}")
    return brief

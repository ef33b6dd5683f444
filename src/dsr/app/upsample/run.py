"""The command behind ``dsr upsample``: read the user's files, and write a folder of results for each picture."""

from __future__ import annotations

import platform
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from dsr.app.upsample.alignment import align
from dsr.app.upsample.outputs import (
    PreviousRun,
    begin,
    described,
    expect_free,
    finish,
    kept_surface,
    output_encoding,
    read_previous_run,
    write_parts,
)
from dsr.app.upsample.reporting import Reporter, listed, problem_line
from dsr.app.upsample.request import UpsampleRequest, files_of, inputs_with_neighbours, settings_of
from dsr.app.upsample.scene import write_scene
from dsr.app.upsample.sequence import FrameSequence
from dsr.inference import Plan, enlarged_by, plan, upsample_surface
from dsr.io.encoding import Assumption
from dsr.io.inputs import Picture, read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.pairs import Pair, PairingResult, add_confidence, find_pairs_of_lists
from dsr.io.units import FolderUnits
from dsr.methods.base import MapNoise, Surface
from dsr.utils.console import ConsoleProgress, show
from dsr.utils.progress import Progress
from dsr.utils.versions import package_versions

_WHITE = 1.5
"""Noise that is alike over fewer pixels counts as white."""
_SHAPED_BY_ERRORS = frozenset({"cloud", "mesh", "confidence"})
"""Parts of a result that depend on its expected errors."""
_PACKAGES = ("dsr", "torch", "numpy", "opencv-python-headless")


def run(request: UpsampleRequest, console: Console) -> list[str]:
    """Upsample all pictures of a request.

    Args:
        request: the request.
        console: where progress and assumptions are shown.

    Returns:
        The problems, one line each; empty if there were none.

    Raises:
        ValueError: the pairs cannot be determined.

    """
    found = _find(request)
    if request.confidence:
        found = replace(found, pairs=add_confidence(found.pairs, request.confidence))
    single = len(found.pairs) == 1 and not request.folders and not request.rgb[0].is_dir()
    _show_found(console, found)
    reporter, units = Reporter(console), FolderUnits(found.pairs)
    sequence = FrameSequence(
        found.pairs,
        lambda pair: _without_repeats(read_picture(pair, request.reading, units)),
        request.neighbours,
        request.poses,
    )
    problems: dict[str, list[str]] = {}
    outcomes: Counter[str] = Counter()
    targets: dict[str, Path] = {}
    scene_problems: list[str] = []
    progress = ConsoleProgress(console)
    for pair in progress.track(found.pairs, "upsample", label=lambda pair: pair.name, lines=False):
        target = request.output if single else request.output / pair.name
        try:
            outcomes[_one(request, pair, target, units, sequence, reporter, progress)] += 1
            targets[pair.name] = target
        except (ValueError, OSError, MemoryError, torch.OutOfMemoryError) as error:
            problems.setdefault(problem_line(error), []).append(pair.name)
    if targets and request.scene_parts and not request.dry_run:
        scene = write_scene(request.output, targets, request.scene_parts, overwrite=request.overwrite)
        for part, path in scene.files.items():
            reporter.say(f"{part}: {len(targets)} frames -> {path}")
        scene_problems = scene.problems
    if not single:
        reporter.summary(outcomes["done"] + outcomes["to do"])
        counts = [f"{count} {outcome}" for outcome, count in outcomes.items()]
        counts += [f"{sum(map(len, problems.values()))} failed"] if problems else []
        pictures = "1 picture" if len(found.pairs) == 1 else f"{len(found.pairs)} pictures"
        show(console, f"{pictures}: {', '.join(counts)} -> {request.output}")
    lines = [f"{listed(names)}: {message}" if len(found.pairs) > 1 else message for message, names in problems.items()]
    return lines + scene_problems


def _find(request: UpsampleRequest) -> PairingResult:
    """Return the pairs."""
    if not request.folders:
        return find_pairs_of_lists(request.rgb, request.depth, request.mask)
    parts = [find_pairs_of_folder(folder, request.output) for folder in request.folders]
    if len(parts) == 1:
        return parts[0]
    pairs = [
        replace(pair, name=f"{folder.resolve().name}/{pair.name}")
        for folder, part in zip(request.folders, parts, strict=True)
        for pair in part.pairs
    ]
    if len({pair.name for pair in pairs}) < len(pairs):
        raise ValueError("expected folders of different names; give those of one name in commands of their own")
    facts = tuple(dict.fromkeys(fact for part in parts for fact in part.assumptions))
    return PairingResult(tuple(pairs), facts, tuple(path for part in parts for path in part.unpaired))


def _show_found(console: Console, found: PairingResult) -> None:
    """Show how many pairs there are, and which files have no partner."""
    count = len(found.pairs)
    lines = [
        f"{count} pairs of photo and depth map" if count > 1 else f"{found.pairs[0].rgb} and {found.pairs[0].depth}"
    ]
    lines += [f"  {fact}" for fact in found.assumptions]
    if found.unpaired:
        lines.append(
            f"  {len(found.unpaired)} without a partner, left out: {listed([path.name for path in found.unpaired])}"
        )
    for line in lines:
        show(console, line)


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
        return self.earlier is not None and self.earlier.complete and self.same and not self.request.overwrite

    @property
    def same(self) -> bool:
        """Whether the earlier run had the same inputs and settings."""
        return self.earlier is not None and (self.earlier.settings, self.earlier.inputs) == (self.settings, self.inputs)

    def expect_agreement(self) -> None:
        """Raise ValueError if the folder holds a complete result of other inputs or settings."""
        earlier = self.earlier
        if earlier is None or not earlier.complete or self.same or self.request.overwrite:
            return
        if earlier.inputs != self.inputs:
            what = "other inputs: " + ", ".join(str(entry.get("file")) for entry in earlier.inputs.values())
        else:
            changed = [name for name, value in self.settings.items() if earlier.settings.get(name) != value]
            what = "other settings: " + ", ".join(f"{name} {earlier.settings.get(name)}" for name in changed)
        raise ValueError(f"{self.target}: holds a result of {what}; take another -o, or --overwrite")

    def is_done(self) -> bool:
        """Return whether all requested parts exist."""
        if not self.reusable or self.earlier is None:
            return False
        there = {name.split("/")[0].split(".")[0] for name in self.earlier.files if (self.target / name).is_file()}
        return there >= set(self.request.wanted)


def _one(
    request: UpsampleRequest,
    pair: Pair,
    target: Path,
    units: FolderUnits,
    sequence: FrameSequence,
    reporter: Reporter,
    progress: Progress,
) -> str:
    """Upsample one picture, and return the outcome."""
    depends_on = inputs_with_neighbours(request, pair, sequence.neighbours(pair))
    job = _Job(request, pair, target, settings_of(request), depends_on, read_previous_run(target))
    job.expect_agreement()
    if job.is_done():
        reporter.say(f"{pair.name}: complete already, in {target}")
        return "complete already"
    picture = sequence.fuse(pair, _without_repeats(read_picture(pair, request.reading, units)))
    picture = align(picture, register=request.register)
    size_lr = (picture.depth_lr.shape[-2], picture.depth_lr.shape[-1])
    size = (picture.camera.height, picture.camera.width)
    planned = plan(size, size_lr, request.scale, request.method, request.directories, request.settings)
    reporter.facts(picture.assumptions)
    if request.dry_run:
        reporter.say(f"{pair.name}: {planned.text} -> {target}")
        return "to do"
    inputs = files_of(pair, request.reading).values()
    expect_free(target, inputs, ours=request.overwrite or job.earlier is not None)
    errors = bool(_SHAPED_BY_ERRORS & set(request.parts))
    surface = kept_surface(target, picture.camera, errors=errors) if job.reusable else None
    begin(target, job.settings, job.inputs, () if job.earlier is None else job.earlier.files)
    started = time.perf_counter()
    if surface is None:
        surface = _upsample(job, picture, progress)
        reporter.facts(_describe(surface.noise, given="noise" in request.settings))
        reporter.facts(_describe_holes(surface, request))
    seconds = time.perf_counter() - started
    facts = _write(job, picture, surface, planned, seconds)
    reporter.facts(facts)
    reporter.say(f"{pair.name}: {planned.text}, {seconds:.1f} s -> {target}")
    return "done"


def _without_repeats(picture: Picture) -> Picture:
    """Undo an enlargement of the depth map by repeated pixels."""
    height, width = picture.depth_lr.shape[-2:]
    block = enlarged_by(picture.depth_lr) if (height, width) == (picture.camera.height, picture.camera.width) else 1
    if block == 1 or height % block or width % block:
        return picture
    fact = Assumption(f"the depth map was enlarged x{block} by repeating pixels, which are dropped")
    depth_lr = picture.depth_lr[:, ::block, ::block]
    confidence = None if picture.confidence is None else picture.confidence[:, ::block, ::block]
    return replace(picture, depth_lr=depth_lr, confidence=confidence, assumptions=(*picture.assumptions, fact))


def _upsample(job: _Job, picture: Picture, progress: Progress) -> Surface:
    """Compute the high-resolution depth with its expected errors, on the CPU."""
    request = job.request
    with progress.task("steps") as step:
        surface = upsample_surface(
            picture.rgb,
            picture.depth_lr,
            picture.camera,
            request.scale,
            method=request.method,
            settings=request.settings,
            directories=request.directories,
            device=request.device,
            fill=request.fill,
            max_hole=request.max_hole,
            progress=step,
        )
    return surface.map(lambda values: values.cpu())


def _describe(noise: MapNoise | None, *, given: bool) -> list[Assumption]:
    """Return a note on the noise of the input, if it was estimated and not given."""
    if noise is None or given:
        return []
    extent = f", correlated over {noise.extent:.0f} pixels" if noise.extent > _WHITE else ""
    return [Assumption("noise of the depth map", f"about {1e3 * noise.deviation:.2g} mm{extent}; --noise overrides it")]


def _describe_holes(surface: Surface, request: UpsampleRequest) -> list[Assumption]:
    """Return a note on wide holes, if there are any."""
    share = float(surface.depth.isnan().float().mean())
    if request.fill != "small" or not share:
        return []
    text = f"holes wider than {request.max_hole:g} degrees stay holes"
    return [Assumption(text, f"{share:.1%} of the pixels; --fill all fills them, too")]


def _write(job: _Job, picture: Picture, surface: Surface, planned: Plan, seconds: float) -> list[Assumption]:
    """Write all parts and ``info.json``, and return notes for the user."""
    started = time.perf_counter()
    encoding = output_encoding(picture.encoding, job.request.depth_format)
    title = f"{job.pair.name}, {planned.method} x{planned.scale}"
    request = job.request
    files, facts, shapes = write_parts(job.target, picture, surface, request.wanted, encoding, title, request.limits)
    kept = job.earlier if job.earlier is not None and job.same else None
    counts = {**(kept.shapes if kept else {}), **{part: written._asdict() for part, written in shapes.items()}}
    entries = {
        "inputs": job.inputs,
        "settings": job.settings,
        "method": planned.method,
        "scale": planned.scale,
        "plan": planned.text,
        "noise": surface.noise._asdict() if surface.noise else kept.noise if kept else None,
        **described(picture, encoding),
        **counts,
        "assumptions": [str(fact) for fact in (*picture.assumptions, *facts)],
        "seconds": {"upsampling": round(seconds, 3), "writing": round(time.perf_counter() - started, 3)},
        "versions": {"python": platform.python_version(), **package_versions(_PACKAGES)},
    }
    others = [name for name in (kept.files if kept else ()) if name not in files]
    finish(job.target, job.earlier, entries, [*files, *others])
    return facts

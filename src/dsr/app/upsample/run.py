"""``dsr upsample``: from somebody's files to folders of results, one picture after another."""

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
from torch import Tensor

from dsr.app.upsample.outputs import (
    PreviousRun,
    begin,
    described,
    expect_free,
    finish,
    kept_depth,
    output_encoding,
    read_previous_run,
    write_parts,
)
from dsr.app.upsample.reporting import Reporter, listed, problem_line
from dsr.app.upsample.request import UpsampleRequest, files_of, inputs_of, settings_of
from dsr.inference import AUTO, NOISY, Plan, enlarged_by, plan, suited_method, upsample_depth
from dsr.io.encoding import Assumption
from dsr.io.inputs import Picture, UnitMemory, read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.pairs import Pair, PairingResult, find_pairs_of_lists
from dsr.utils.console import ConsoleProgress, show
from dsr.utils.progress import Progress
from dsr.utils.versions import package_versions

_PACKAGES = ("dsr", "torch", "numpy", "opencv-python-headless")


def run(wanted: UpsampleRequest, console: Console) -> list[str]:
    """Upsample all that is asked for.

    Args:
        wanted: what.
        console: where progress and assumptions are shown.

    Returns:
        What went wrong, one line for each; empty where nothing did.

    Raises:
        ValueError: nothing can be done at all.

    """
    found = _find(wanted)
    single = len(found.pairs) == 1 and not wanted.folders and not wanted.rgb[0].is_dir()
    _tell_found(console, found)
    reporter, units = Reporter(console), UnitMemory()
    problems: dict[str, list[str]] = {}
    outcomes: Counter[str] = Counter()
    progress = ConsoleProgress(console)
    for pair in progress.track(found.pairs, "upsample", label=lambda pair: pair.name, lines=False):
        target = wanted.output if single else wanted.output / pair.name
        try:
            outcomes[_one(wanted, pair, target, units, reporter, progress)] += 1
        except (ValueError, OSError, MemoryError, torch.OutOfMemoryError) as error:
            problems.setdefault(problem_line(error), []).append(pair.name)
    if not single:
        reporter.summary(outcomes["done"] + outcomes["to do"])
        counts = [f"{count} {outcome}" for outcome, count in outcomes.items()]
        counts += [f"{sum(map(len, problems.values()))} failed"] if problems else []
        pictures = "1 picture" if len(found.pairs) == 1 else f"{len(found.pairs)} pictures"
        show(console, f"{pictures}: {', '.join(counts)} -> {wanted.output}")
    return [f"{listed(names)}: {message}" if len(found.pairs) > 1 else message for message, names in problems.items()]


def _find(wanted: UpsampleRequest) -> PairingResult:
    """Return the pairs."""
    if not wanted.folders:
        return find_pairs_of_lists(wanted.rgb, wanted.depth, wanted.mask)
    parts = [find_pairs_of_folder(folder, wanted.output) for folder in wanted.folders]
    if len(parts) == 1:
        return parts[0]
    pairs = [
        replace(pair, name=f"{folder.resolve().name}/{pair.name}")
        for folder, part in zip(wanted.folders, parts, strict=True)
        for pair in part.pairs
    ]
    if len({pair.name for pair in pairs}) < len(pairs):
        raise ValueError("expected folders of different names; give those of one name in commands of their own")
    facts = tuple(dict.fromkeys(fact for part in parts for fact in part.assumptions))
    return PairingResult(tuple(pairs), facts, tuple(path for part in parts for path in part.unpaired))


def _tell_found(console: Console, found: PairingResult) -> None:
    """Show how many pairs there are, and what has no partner."""
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
    """One picture, and what an earlier run left in its folder."""

    wanted: UpsampleRequest
    pair: Pair
    target: Path
    settings: Mapping[str, Any]
    inputs: Mapping[str, Any]
    earlier: PreviousRun | None

    @property
    def reusable(self) -> bool:
        """Whether the earlier run came to its end with the same inputs and settings, and may stay."""
        return self.earlier is not None and self.earlier.complete and self.same and not self.wanted.overwrite

    @property
    def same(self) -> bool:
        """Whether the earlier run had the same inputs and settings."""
        return self.earlier is not None and (self.earlier.settings, self.earlier.inputs) == (self.settings, self.inputs)

    def expect_agreement(self) -> None:
        """Raise ValueError where the folder holds a complete result of something else."""
        earlier = self.earlier
        if earlier is None or not earlier.complete or self.same or self.wanted.overwrite:
            return
        if earlier.inputs != self.inputs:
            what = "other inputs: " + ", ".join(str(entry.get("file")) for entry in earlier.inputs.values())
        else:
            changed = [name for name, value in self.settings.items() if earlier.settings.get(name) != value]
            what = "other settings: " + ", ".join(f"{name} {earlier.settings.get(name)}" for name in changed)
        raise ValueError(f"{self.target}: holds a result of {what}; take another -o, or --overwrite")

    def is_done(self) -> bool:
        """Return whether everything that is wanted is there."""
        if not self.reusable or self.earlier is None:
            return False
        there = {name.split("/")[0].split(".")[0] for name in self.earlier.files if (self.target / name).is_file()}
        return there >= set(self.wanted.parts)


def _one(
    wanted: UpsampleRequest, pair: Pair, target: Path, units: UnitMemory, reporter: Reporter, progress: Progress
) -> str:
    """Do one picture, and return how it went."""
    job = _Job(wanted, pair, target, settings_of(wanted), inputs_of(pair, wanted.reading), read_previous_run(target))
    job.expect_agreement()
    if job.is_done():
        reporter.say(f"{pair.name}: complete already, in {target}")
        return "complete already"
    picture = _without_repeats(read_picture(pair, wanted.reading, units))
    coarse_size = (picture.depth_lr.shape[-2], picture.depth_lr.shape[-1])
    method, suits = _method(picture, wanted)
    picture = replace(picture, assumptions=(*picture.assumptions, *suits))
    planned = plan((picture.camera.height, picture.camera.width), coarse_size, wanted.scale, method, wanted.directories)
    reporter.facts(picture.assumptions)
    if wanted.dry_run:
        reporter.say(f"{pair.name}: {planned.text} -> {target}")
        return "to do"
    inputs = files_of(pair, wanted.reading).values()
    expect_free(target, inputs, ours=wanted.overwrite or job.earlier is not None)
    depth = kept_depth(target, picture.camera) if job.reusable else None
    begin(target, job.settings, job.inputs, () if job.earlier is None else job.earlier.files)
    started = time.perf_counter()
    if depth is None:
        depth = _upsampled(job, picture, planned.method, progress)
    seconds = time.perf_counter() - started
    facts = _write(job, picture, depth, planned, seconds)
    reporter.facts(facts)
    reporter.say(f"{pair.name}: {planned.text}, {seconds:.1f} s -> {target}")
    return "done"


def _method(picture: Picture, wanted: UpsampleRequest) -> tuple[str, list[Assumption]]:
    """Return the method to use, and what there is to say of it."""
    if wanted.method != AUTO:
        return wanted.method, []
    method = suited_method(picture.depth_lr, picture.camera, wanted.scale)
    if method == NOISY:
        return method, [
            Assumption(f"the depth map is noisy: {NOISY}, which was trained for that (--method facets keeps more)")
        ]
    return method, []


def _without_repeats(picture: Picture) -> Picture:
    """Return the picture with a depth map that was enlarged by repeating pixels as it was before."""
    height, width = picture.depth_lr.shape[-2:]
    block = enlarged_by(picture.depth_lr) if (height, width) == (picture.camera.height, picture.camera.width) else 1
    if block == 1 or height % block or width % block:
        return picture
    fact = Assumption(f"the depth map was enlarged x{block} by repeating pixels, which are dropped")
    return replace(picture, depth_lr=picture.depth_lr[:, ::block, ::block], assumptions=(*picture.assumptions, fact))


def _upsampled(job: _Job, picture: Picture, method: str, progress: Progress) -> Tensor:
    """Return the high-resolution depth, (1, H, W) in metres."""
    wanted = job.wanted
    with progress.task("steps") as step:
        return upsample_depth(
            picture.rgb,
            picture.depth_lr,
            picture.camera,
            wanted.scale,
            method=method,
            settings=wanted.settings,
            directories=wanted.directories,
            device=wanted.device,
            keep_holes=wanted.keep_holes,
            progress=step,
        ).cpu()


def _write(job: _Job, picture: Picture, depth: Tensor, planned: Plan, seconds: float) -> list[Assumption]:
    """Write all parts and ``info.json``, and return what should be said of them."""
    started = time.perf_counter()
    encoding = output_encoding(picture.encoding, job.wanted.depth_format)
    title = f"{job.pair.name}, {planned.method} x{planned.scale}"
    files, facts = write_parts(job.target, picture, depth, job.wanted.parts, encoding, title)
    entries = {
        "inputs": job.inputs,
        "settings": job.settings,
        "method": planned.method,
        "scale": planned.scale,
        "plan": planned.text,
        **described(picture, encoding),
        "assumptions": [str(fact) for fact in (*picture.assumptions, *facts)],
        "seconds": {"upsampling": round(seconds, 3), "writing": round(time.perf_counter() - started, 3)},
        "versions": {"python": platform.python_version(), **package_versions(_PACKAGES)},
    }
    kept = job.earlier.files if job.earlier is not None and job.same else ()
    finish(job.target, job.earlier, entries, [*files, *(name for name in kept if name not in files)])
    return facts

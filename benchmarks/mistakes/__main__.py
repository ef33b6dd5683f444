"""Make mistakes with real frames, and count which are noticed; and make none, and count false alarms.

``make mistakes ARGS="--cases 500 --seed 0"``. Every case is a command, `dsr upsample` with the fastest method.
With ``DSR_SHARED`` the frames are those of all data sets and sensors there, otherwise rendered ones.
"""

import argparse
import json
import os
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
from commands import run_python

from mistakes.frames import Frame, all_frames, rendered_sequence
from mistakes.kinds import ANSWERS, KINDS, RIGHT, Case, Material, judged

ROOT = Path(__file__).resolve().parents[2]
LISTED, SEQUENCE_SIZE = 6, 128
SEQUENCES = (0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11, 12)
"""Frames of a list, and size of sequences; their scenes, no landscape."""


def draw(number: int, seed: int, sources: dict[str, Callable[[], Frame]], folder: Path) -> tuple[str, str, Case]:
    """Return a case with what is wrong in it."""
    rng = np.random.default_rng([seed, number])
    names = [(group, kind) for group in KINDS for kind in KINDS[group]]
    rights = [each for each in names if each[0] == RIGHT]
    group, kind = (rights if number % 4 == 3 else [each for each in names if each[0] != RIGHT])[rng.integers(
        len(rights) if number % 4 == 3 else len(names) - len(rights)
    )]  # fmt: skip
    chosen = rng.choice(list(sources), min(LISTED, len(sources)), replace=False)
    factor = int(rng.choice((1, 4))) if kind != "the depth camera's" else 4
    sequence = rendered_sequence(int(rng.choice(SEQUENCES)), SEQUENCE_SIZE) if "pose" in f"{group} {kind}" else ()
    count = len(chosen) if "lists" in kind else 2
    frames = [sources[name]().reduced(factor) for name in chosen[:count]] if not sequence else ()
    material = Material(frames, sequence, folder, rng)
    return group, kind, KINDS[group][kind](material)


def answer(case: Case, folder: Path) -> tuple[str, str]:
    """Return what a command answers to a case, and its words."""
    out = folder / "out"
    command = ("-m", "dsr", "upsample", *case.arguments, "--method", "bicubic", "--only", "depth", "-o", str(out))
    done = run_python(*command, cwd=ROOT, timeout=600)
    if done.returncode == 2:
        return "refused", done.stderr.strip().splitlines()[-1]
    if done.returncode:
        raise RuntimeError(f"exit {done.returncode}: {done.stderr[-500:]}")
    infos = [json.loads(path.read_text()) for path in sorted(out.rglob("info.json"))]
    warnings = [each["message"] for info in infos for each in info["warnings"]]
    read = infos[0]["input_depth"]
    return judged(case, warnings, read["unit"], read["range_type"]), "".join(warnings[:1])


def main() -> None:
    """Run the campaign."""
    parser = argparse.ArgumentParser(prog="make mistakes", description=__doc__)
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--shared", type=Path, default=os.environ.get("DSR_SHARED", ROOT.parent / "shared"))
    parser.add_argument("--only", default="", help="kinds whose name contains this")
    options = parser.parse_args()
    sources = all_frames(options.shared)
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    started = time.monotonic()
    for number in range(options.cases):
        with tempfile.TemporaryDirectory() as place:
            group, kind, case = draw(number, options.seed, sources, Path(place))
            said, words = answer(case, Path(place))
        counts[group, kind][said] += 1
        wrong = said in ("warned", "refused") if group == RIGHT else said == "silent"
        if wrong:
            print(f"case {number}: {group}, {kind}: {said} {words}", flush=True)
    print(table(counts))
    print(f"{options.cases} cases, seed {options.seed}, {(time.monotonic() - started) / 60:.0f} minutes")


def table(counts: dict[tuple[str, str], Counter[str]]) -> str:
    """Return the counts in Markdown."""
    lines = ["| what | case | cases | " + " | ".join(ANSWERS) + " |", "| --- | --- |" + " ---: |" * (len(ANSWERS) + 1)]
    for group, kinds in KINDS.items():
        for kind in kinds:
            row = counts.get((group, kind), Counter())
            cells = " | ".join(str(row[each]) for each in ANSWERS)
            lines.append(f"| {group} | {kind} | {row.total()} | {cells} |")
    wrong = sum((row for (group, _), row in counts.items() if group != RIGHT), Counter())
    right = sum((row for (group, _), row in counts.items() if group == RIGHT), Counter())
    for name, row in (("all mistakes", wrong), ("all that is right", right)):
        lines.append(f"| {name} | | {row.total()} | " + " | ".join(str(row[each]) for each in ANSWERS) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()

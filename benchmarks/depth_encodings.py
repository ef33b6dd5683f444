"""Depth that is stored otherwise than in millimetres or metres: what ``dsr upsample`` says of each usual encoding.

    python benchmarks/depth_encodings.py [--shared DIR] [--frames N] [--reduce 1] [--only NAME]

Every frame of ``DIR``, or each of some rendered ones, is stored in each encoding as the mistakes of
``benchmarks/mistakes`` are, and read as the command reads it, without any option but the camera. *Read rightly* means
that unit and range type are, *refused* that a line asks for what cannot be decided, *silent* that one of the two is
wrong, and no line says so.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from mistakes.frames import Frame, all_frames
from mistakes.kinds import ANSWERS, KINDS, RIGHT, Maker, Material, judged, valued, whole

from dsr.app.upsample.checks import check_planes
from dsr.app.upsample.frames import find_frames
from dsr.app.upsample.request import UpsampleRequest
from dsr.io.inputs import read_picture
from dsr.utils.options import add_options, build

ENCODINGS: dict[str, Maker] = {
    **{name: KINDS[RIGHT][name] for name in ("millimetres, 16 bits", "float metres")},
    **KINDS["units and encodings"],
    "inverse depth, 1/m": valued(lambda depth, _: (1 / depth).astype(np.float32)),
    "1/256 m, no size of KITTI's": valued(lambda depth, _: whole(256 * depth), (1 / 256, "orthogonal")),
}


def without_detail(frame: Frame) -> Frame:
    """Return a frame whose photo has the size of its depth map: what is measured does not depend on it."""
    height, width = frame.depth.shape
    photo = cv2.resize(frame.photo, (width, height), interpolation=cv2.INTER_AREA)
    return replace(frame, photo=photo, camera=frame.camera.rescale(width, height))


def answer(make: Maker, frame: Frame) -> str:
    """Return what is said of a frame in an encoding."""
    parser = argparse.ArgumentParser()
    add_options(parser, UpsampleRequest)
    with tempfile.TemporaryDirectory() as folder:
        case = make(Material((frame,), (), Path(folder), np.random.default_rng(0)))
        request = build(UpsampleRequest, parser.parse_args([*case.arguments, "-o", folder]))
        (pair,) = find_frames(request).whole
        try:
            picture = read_picture(pair, request.reading)
        except ValueError:
            return "refused"
        notes = (*picture.assumptions, *check_planes(picture, pair, request.reading))
    encoding = picture.encoding
    return judged(case, [each.code for each in notes if each.code], encoding.unit, encoding.range_type)


def measured(frames: list[Frame], only: str) -> Iterator[tuple[str, Counter[str]]]:
    """Yield each encoding with how often each answer was given."""
    for name, make in ENCODINGS.items():
        if only in name:
            yield name, Counter(answer(make, frame) for frame in frames)


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path("-"), help="rendered frames, where there is no such folder")
    parser.add_argument("--frames", type=int, help="at most so many, spread evenly")
    parser.add_argument("--reduce", type=int, default=1, help="every so many pixels of the maps")
    parser.add_argument("--only", default="", help="encodings whose name contains this")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    sources = list(all_frames(arguments.shared).values())
    every = 1 if arguments.frames is None else -(-len(sources) // arguments.frames)
    frames = [without_detail(load().reduced(arguments.reduce)) for load in sources[::every]]
    print(f"| {len(frames)} frames | " + " | ".join(ANSWERS) + " |\n| --- |" + " ---: |" * len(ANSWERS))
    for name, counts in measured(frames, arguments.only):
        print(f"| {name} | " + " | ".join(str(counts[each]) for each in ANSWERS) + " |", flush=True)


if __name__ == "__main__":
    main()

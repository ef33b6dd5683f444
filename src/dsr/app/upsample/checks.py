"""Whether the planes of a picture's depth map are flat as it was read, for ``dsr upsample``: else a warning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dsr.geometry.planes import Array, inverse_votes, range_votes, thinned
from dsr.io.encoding import Encoding
from dsr.io.inputs import Picture
from dsr.io.pairs import Pair
from dsr.io.reading import Reading
from dsr.notes import Assumption

_HALF = 2**-10
"""Relative step of floats of 16 bits."""


def check_planes(picture: Picture, pair: Pair, reading: Reading) -> Picture:
    """Return a picture, with a warning where its planes are flat only if its values are read in another way.

    What a capture's format or ``--range-type`` says is believed.

    Args:
        picture: as it was read.
        pair: its files.
        reading: what the user says about them.

    """
    if pair.capture is not None or reading.range_type is not None or reading.rig is not None:
        return picture
    height, width = picture.depth_lr.shape[-2:]
    depth, camera = thinned(picture.depth_lr[0].double().numpy(), picture.camera.rescale(width, height))
    falls = inverse_votes(depth)
    encoding = picture.encoding
    if falls.verdict == "falls":
        given = "disparities rise with distance, as depth does" if encoding.range_type == "disparity" else (
            "values fall with distance, as disparities do")  # fmt: skip
        detail = f"straight over {falls.falling} of {falls.falling + falls.rising} planes; --range-type sets it"
        warning = Assumption(given, detail, "falls-with-distance", falls.ratio)
        return replace(picture, assumptions=(*picture.assumptions, warning))
    votes = range_votes(depth, camera, _step(depth, encoding))
    if votes.verdict not in ("ray", "reverse") or encoding.range_type == "disparity":
        return picture
    ray = votes.verdict == "ray"
    text, other = (
        ("depth looks like distance along the ray", "perspective")
        if ray
        else ("distances along the ray look like depth along the axis", "orthogonal")
    )
    support = votes.ray if ray else votes.reverse
    detail = f"{support} of {votes.windows} planes are flat then, {votes.flat} now; --range-type {other}"
    warning = Assumption(text, detail, "along-the-ray", support / votes.windows)
    return replace(picture, assumptions=(*picture.assumptions, warning))


def _step(depth: Array, encoding: Encoding) -> float:
    """Return the step to which values are rounded, as a fraction of their median."""
    if encoding.dtype == "float16":
        return _HALF
    if np.dtype(encoding.dtype).kind == "f" or encoding.range_type == "disparity":
        return 0.0
    return float(encoding.unit / np.nanmedian(depth))

"""``dataset=tofmark``: a time-of-flight sensor's samples beside a photo (Ferstl et al., ICCV 2013).

Voynov et al. 2019 use Books, Devil and Shark with the real sensor's maps as the input: ``downsampling=measured``.

The benchmark's files hold no camera. It is estimated here from the Books that the paper's authors published with a
camera and metric depth: of 100 correspondences between the two photos 72 fit one pose and one camera of square pixels,
without distortion, with a root mean square of 0.95 pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from dsr.data.base import SceneSelection
from dsr.data.formats import tofmark
from dsr.data.preparation.records import Preparation, PreparedDataset, listed, records_of

SCENES = ("books", "devil", "shark")
ESTIMATED = (549.2, 549.2, 375.2, 334.3)
"""fx, fy, cx, cy in pixels of the 610 x 810 photos."""


class ToFMark(PreparedDataset):
    """Scenes of ToFMark at their own size, the samples as measured maps at x4 and x8.

    Args:
        root: where the ``.mat`` files or the pictures lie.
        scenes: names of the ones to use; None for the three, ``found`` for all in ``root``.
        intrinsics: fx, fy, cx, cy in pixels; None for the estimated ones.
        depth_range: metres that levels 1 and 255 of pictures stand for; they hold no scale.
        variables: names in the ``.mat`` files of ``intensity``, ``depth`` and ``samples``, where they are not found.

    Raises:
        ValueError: a scene is not there, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        intrinsics: Sequence[float] | None = None,
        depth_range: Sequence[float] | None = None,
        variables: Mapping[str, str] | None = None,
    ) -> None:
        for name, values, count in (("intrinsics", intrinsics, 4), ("depth_range", depth_range, 2)):
            if values is not None and len(values) != count:
                raise ValueError(f"{name}: expected {count} numbers, got {len(values)}")
        folder = Path(root).expanduser()
        settings = {
            "intrinsics": tuple(intrinsics or ESTIMATED),
            "depth_range": depth_range and tuple(depth_range),
            "variables": variables and dict(variables),
        }
        found = records_of(listed(tofmark.find_frames, folder), tofmark.load_frame, "tofmark", **settings)
        if intrinsics is None:
            note = "the benchmark has no camera: it is an estimate"
            found = {name: replace(record, note=note) for name, record in found.items()}
        super().__init__("tofmark", folder, found, SCENES, scenes, Preparation(None))

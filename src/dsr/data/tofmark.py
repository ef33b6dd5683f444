"""``dataset=tofmark``: samples of a time-of-flight sensor and a photo (Ferstl et al., ICCV 2013).

Voynov et al. 2019 use Books, Devil and Shark with the maps of the real sensor as the input: ``downsampling=measured``.

The benchmark's files hold no camera. It was estimated from the scene Books that the paper's authors published with a
camera and metric depth: 72 of 100 correspondences between the two photos fit one pose and one camera of square pixels
without distortion, with a root mean square error of 0.95 pixels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dsr.data.base import SceneSelection
from dsr.data.formats import tofmark
from dsr.data.preparation.dataset import Preparation, PreparedDataset, add_note, list_frames, make_records

SCENES = ("books", "devil", "shark")
ESTIMATED = (549.2, 549.2, 375.2, 334.3)
"""fx, fy, cx, cy in pixels of the 610 x 810 photos."""


class ToFMark(PreparedDataset):
    """Scenes of ToFMark at their original size, with the samples as measured maps at x4 and x8.

    Args:
        root: directory of the ``.mat`` files or the pictures.
        scenes: names of the scenes to use; None for the three, ``found`` for all in ``root``.
        intrinsics: fx, fy, cx, cy in pixels; None for the estimated ones.
        depth_range: depth in metres of levels 1 and 255 of the pictures, which hold no scale.
        variables: names of ``intensity``, ``depth`` and ``samples`` in the ``.mat`` files, where they are not found.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

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
        settings = {
            "intrinsics": tuple(intrinsics or ESTIMATED),
            "depth_range": depth_range and tuple(depth_range),
            "variables": variables and dict(variables),
        }
        found = make_records(list_frames(tofmark.find_frames, root), tofmark.load_frame, "tofmark", **settings)
        if intrinsics is None:
            found = add_note(found, "the benchmark has no camera: it is an estimate")
        super().__init__("tofmark", root, found, SCENES, scenes, Preparation(None))

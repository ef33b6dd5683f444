"""``dataset=sunrgbd``: indoor scenes of four sensors (Song et al., CVPR 2015).

Voynov et al. 2019 evaluate on twelve images and do not say which. This data set has three of each sensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from dsr.data.base import SceneSelection
from dsr.data.formats import sunrgbd
from dsr.data.preparation.dataset import (
    Preparation,
    PreparedDataset,
    SceneRecord,
    list_frames,
    make_records,
    rename_records,
)

FRAMES = MappingProxyType(
    {
        "kinect1_1": "kv1/NYUdata/NYU0001",
        "kinect1_2": "kv1/NYUdata/NYU0428",
        "kinect1_3": "kv1/b3dodata/img_0063",
        "kinect2_1": "kv2/kinect2data/000002_2014-05-26_14-23-37_260595134347_rgbf000103-resize",
        "kinect2_2": "kv2/align_kv2/2014-12-18_11-31-54_260595134347",
        "kinect2_3": "kv2/align_kv2/2014-12-18_13-59-40_260595134347",
        "realsense_1": "realsense/lg/2014_10_24-09_14_34-1311000073",
        "realsense_2": "realsense/sa/2014_10_21-15_21_11-1311000073",
        "realsense_3": "realsense/sh/2014_10_21-11_35_34-1311000041",
        "xtion_1": "xtion/xtion_align_data/2014_12_18_12_3_40",
        "xtion_2": "xtion/sun3ddata/mit_76_studyroom/76-1studyroom1/0000003-000000067032",
        "xtion_3": "xtion/sun3ddata/brown_bm_2/brown_bm_2",
    }
)
"""Folders of the scenes; where several scenes lie below one, its first is used."""


class SunRGBD(PreparedDataset):
    """Scenes of SUN RGB-D; the depth that the sensor measured, with its holes, is the true depth.

    Args:
        root: directory of the scenes' folders, at any depth.
        scenes: names of the scenes to use; None for twelve, ``found`` for all in ``root``.
        size: height and width in pixels; None for the original size.
        crop: see :class:`dsr.data.preparation.dataset.Preparation`.
        refined: whether the authors' refined depth without holes is the true depth.
        frames: folder of each of the twelve names.
        intrinsics: fx, fy, cx, cy in pixels for folders without ``intrinsics.txt``.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        refined: bool = False,
        frames: Mapping[str, str] = FRAMES,
        intrinsics: Sequence[float] | None = None,
    ) -> None:
        if intrinsics is not None and len(intrinsics) != 4:
            raise ValueError(f"intrinsics: expected fx, fy, cx, cy, got {len(intrinsics)} numbers")
        settings = {"refined": refined, "intrinsics": intrinsics and tuple(intrinsics)}
        records = make_records(list_frames(sunrgbd.find_frames, root), sunrgbd.load_frame, "sunrgbd", **settings)
        found = rename_records(records, {name: _first_below(records, path) for name, path in frames.items()})
        super().__init__("sunrgbd", root, found, tuple(FRAMES), scenes, Preparation(size, crop))


def _first_below(records: Mapping[str, SceneRecord], path: str) -> str:
    """Return the first scene whose name is or begins with a path, below ``SUNRGBD`` or not; the path where none is."""
    beginnings = tuple(f"{above}{path.replace('/', '_')}_" for above in ("", "SUNRGBD_"))
    return next((name for name in records if f"{name}_".startswith(beginnings)), path)

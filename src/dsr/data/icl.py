"""``dataset=icl``: synthetic rooms with exact depth (Handa et al., ICRA 2014).

Voynov et al. 2019 evaluate on six frames, which they name by what they show, not by number. Their size and crop follow
from their camera of Plant: frames are resized to a height of 512 and cropped to the square in the middle. Which frames
they used is unknown. Those below are spread over the trajectories; ``dataset.frames`` takes others.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from dsr.data.base import SceneSelection
from dsr.data.formats import icl_nuim
from dsr.data.preparation.dataset import Preparation, PreparedDataset, list_frames, make_records, rename_records

FRAMES = MappingProxyType(
    {
        "painting": "living_room_traj0/0300",
        "sofa": "living_room_traj1/0300",
        "plant": "living_room_traj2/0300",
        "office": "office_room_traj0/0300",
        "coat_rack": "office_room_traj1/0300",
        "displays": "office_room_traj2/0300",
    }
)


class ICL(PreparedDataset):
    """Frames of ICL-NUIM.

    Args:
        root: directory of the folders of the trajectories.
        scenes: names of the scenes to use; None for the paper's six, ``found`` for every frame in ``root``.
        size: height and width in pixels; None for the original size.
        crop: see :class:`dsr.data.preparation.dataset.Preparation`.
        frames: frame of each of the paper's names.

    Raises:
        ValueError: a scene is not on disk, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        frames: Mapping[str, str] = FRAMES,
    ) -> None:
        found = rename_records(
            make_records(list_frames(icl_nuim.find_frames, root), icl_nuim.load_frame, "icl"), frames
        )
        super().__init__("icl", root, found, tuple(FRAMES), scenes, Preparation(size, crop))

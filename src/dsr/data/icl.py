"""``dataset=icl``: synthetic rooms with exact depth (Handa et al., ICRA 2014).

Voynov et al. 2019 evaluate on six frames, which they name by what they show, not by number. Their size and crop are
known: their camera of Plant is that of a frame whose height was made 512 and whose middle was cut out. Which frames
theirs are is not; those below are spread over the trajectories, and ``dataset.frames`` takes others.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from dsr.data.base import SceneSelection
from dsr.data.formats import icl_nuim
from dsr.data.preparation.records import Preparation, PreparedDataset, listed, records_of, renamed

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
        root: where the trajectories' folders lie.
        scenes: names of the ones to use; None for the paper's six, ``found`` for every frame in ``root``.
        size: height and width in pixels; None for frames as they are.
        crop: see :class:`dsr.data.preparation.records.Preparation`.
        frames: which frame each of the paper's names stands for.

    Raises:
        ValueError: a scene is not there, or a value is out of range.

    """

    def __init__(
        self,
        root: str,
        scenes: SceneSelection = None,
        size: int | None = 512,
        crop: float = 0.5,
        frames: Mapping[str, str] = FRAMES,
    ) -> None:
        folder = Path(root).expanduser()
        found = renamed(records_of(listed(icl_nuim.find_frames, folder), icl_nuim.load_frame, "icl"), frames)
        super().__init__("icl", folder, found, tuple(FRAMES), scenes, Preparation(size, crop))

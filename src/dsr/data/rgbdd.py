"""``dataset=rgbdd`` and ``dataset=rgbdd_real``: a photo and two time-of-flight sensors (He et al., CVPR 2021).

``rgbdd`` has the industrial sensor's depth to downsample, ``rgbdd_real`` that of a phone beside it.

He et al., "Towards Fast and Accurate Real-World Depth Super-Resolution: Benchmark Dataset and Baseline", CVPR 2021;
github.com/lingzhi96/RGB-D-D-Dataset. As its owners hand it out:

    portraits/portraits_test/ID/ID_RGB.jpg              the photo, 512 x 384
    portraits/portraits_test/ID/ID_HR_gt.png            the industrial sensor's depth, 512 x 384, 16 bits, mm, filled
    portraits/portraits_test/ID/ID_LR_fill_depth.png    the phone's depth, 192 x 144, mm, filled

likewise ``plants`` and ``models``, and ``_train`` in place of ``_test``: 2215 to train on, 405 to test. The test images
are also in circulation, with DCTNet (Zhao et al., CVPR 2022), as

    DIR/RGB/ID_RGB.jpg   DIR/Depth/ID_HR_gt.png   DIR/DepthLR/ID_LR_fill_depth.png

No camera is published; 60 degrees of horizontal view are assumed.
"""

from dataclasses import replace
from pathlib import Path
from typing import Literal

from dsr.data.frame_files import (
    NO_CAMERA,
    expect_size,
    find_beside,
    in_natural_order,
    load_pair,
    read_millimetres,
    walk,
)
from dsr.data.scene_source import PreparedDataset, SceneSelection, make_records
from dsr.sample import Scene
from dsr.utils.guards import expect_one_of

Split = Literal["test", "train"]
COUNTS = {"test": 405, "train": 2215}  # numbers of scenes
RATIO = 8 / 3  # of the photo's size and that of the phone's depth
Files = tuple[Path, ...]
_PARTS = ("models", "plants", "portraits")
_DEPTH, _MEASURED = "{0}_HR_gt.png", "{0}_LR_fill_depth.png"


def find_frames(root: Path, split: Split | None = None, measured: bool = False) -> dict[str, Files]:
    """Return photos, true depth and, if ``measured``, the phone's depth, by their number "20200509112638", in order."""
    found: dict[str, Files] = {}
    names = ("{0}_RGB.jpg", _DEPTH, _MEASURED)[: 3 if measured else 2]
    parts = [f"{part}_{each}" for part in _PARTS for each in COUNTS if split in (None, each)]
    for folder, _, files in walk(root):  # as its owners hand it out
        wanted = [name.format(folder.name) for name in names]
        if folder.parent.name in parts and set(wanted) <= set(files):
            found.setdefault(folder.name, tuple(folder / name for name in wanted))
    if split in (None, "test"):  # those in circulation
        others = (f"Depth/{_DEPTH}", f"DepthLR/{_MEASURED}")[: 2 if measured else 1]
        for _, number, paths in find_beside(root, "RGB", r"(\d+)_RGB\.jpg", others):
            found.setdefault(number, paths)
    return in_natural_order(found)


def load_measured_frame(rgb_path: Path, depth_path: Path, measured_path: Path, dataset: str, name: str) -> Scene:
    """Return one image as :func:`~dsr.data.frame_files.load_pair` does, with the phone's depth as the measured map."""
    scene, measured = load_pair(rgb_path, depth_path, dataset, name), read_millimetres(measured_path)
    size = (round(scene.camera.height / RATIO), round(scene.camera.width / RATIO))
    expect_size(measured_path, measured, size)
    return replace(scene, measured={scene.camera.width / size[1]: measured})


DETECTED = ((find_frames, load_pair, "rgbdd"),)


class RGBDD(PreparedDataset):
    """Images of RGB-D-D at their own size; ``real`` ones have the phone's depth as the measured map."""

    soft_edges = True

    def __init__(self, root: str, real: bool, split: Split = "test", scenes: SceneSelection = None) -> None:
        expect_one_of("split", split, COUNTS)
        name, load = ("rgbdd_real", load_measured_frame) if real else ("rgbdd", load_pair)
        found = make_records(find_frames(Path(root).expanduser(), split, real), load, name, NO_CAMERA)
        super().__init__(name, root, found, scenes, count=COUNTS[split])
        self.evaluation = split == "test"

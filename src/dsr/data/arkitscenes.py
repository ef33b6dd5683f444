"""``dataset=arkitscenes``: a tablet's lidar at a ratio of 7.5, with a laser scanner's depth as the truth.

Baruch et al., "ARKitScenes: A Diverse Real-World Dataset for 3D Indoor Scene Understanding Using Mobile RGB-D Data",
NeurIPS Datasets and Benchmarks 2021; DATA.md and the READMEs of github.com/apple/ARKitScenes.

    Validation/41069021/wide/41069021_305.244.png               the photo, 1920 x 1440; the folder may be ``color``
    Validation/41069021/highres_depth/41069021_305.244.png      the laser scanner's depth, 1920 x 1440, 16 bits, mm
    Validation/41069021/lowres_depth/41069021_305.244.png       the lidar's depth, 256 x 192, mm
    Validation/41069021/confidence/41069021_305.244.png         of the lidar, 256 x 192, 8 bits, 0 (low) to 2 (high)
    Validation/41069021/wide_intrinsics/41069021_305.244.pincam   width height fx fy cx cy

and the same in ``Training``: 287 and 1970 videos, the splits of upsampling_train_val_splits.csv. They are among the raw
data, too, where they alone have ``highres_depth``. Depth 0 is a hole. Intrinsics may be a millisecond off, and belong
to the raw data; where there are none, 60 degrees of horizontal view are assumed. Photos stay as the camera was held.
"""

from pathlib import Path
from typing import Literal

import torch

from dsr.data.frame_files import (
    expect_size,
    find_beside,
    given_camera,
    in_natural_order,
    read_frame,
    read_millimetres,
)
from dsr.data.scene_source import PreparedDataset, SceneSelection, make_records
from dsr.geometry.camera import ASSUMED_FOV, Camera
from dsr.io.captures.arkit import find_intrinsics
from dsr.io.images import read_levels, read_numbers
from dsr.sample import Scene
from dsr.utils.guards import expect_one_of

Split = Literal["validation", "training"]
SPLITS: tuple[Split, ...] = ("validation", "training")
_SIZE, _SIZE_LR = (1440, 1920), (192, 256)
_HIGHEST_CONFIDENCE = 2
Files = tuple[Path, Path, Path, Path | None, Path | None]


def find_frames(root: Path, split: Split | None = None) -> dict[str, Files]:
    """Return the files of frames by name "41069021_305.244", in order; what is in no ``Training`` is for validation."""
    found: dict[str, Files] = {}
    for folder in ("wide", "color"):
        others = ("highres_depth/{}.png", "lowres_depth/{}.png")
        for place, frame, (photo, truth, measured) in find_beside(root, folder, r"(\d+_\d+\.\d+)\.png", others):
            if split is None or ("Training" in place.resolve().parts) == (split == "training"):
                confidence = place / "confidence" / photo.name
                known = confidence if confidence.is_file() else None
                intrinsics = find_intrinsics(place / "wide_intrinsics", frame)
                found.setdefault(frame, (photo, truth, measured, known, intrinsics))
    return in_natural_order(found)


def load_frame(
    rgb_path: Path,
    depth_path: Path,
    measured_path: Path,
    confidence_path: Path | None,
    intrinsics_path: Path | None,
    dataset: str,
    name: str,
    *,
    min_confidence: int = 0,
) -> Scene:
    """Return one frame with the lidar's map as the measured one, with holes below ``min_confidence``."""
    rgb, depth = read_frame(rgb_path, depth_path, size=_SIZE)
    measured = read_millimetres(measured_path)
    expect_size(measured_path, measured, _SIZE_LR)
    if min_confidence > 0:
        if confidence_path is None:
            raise ValueError(f"{measured_path}: expected its confidence in the folder confidence, there is none")
        confidence = read_levels(confidence_path)
        expect_size(confidence_path, confidence, _SIZE_LR)
        if confidence.max() > _HIGHEST_CONFIDENCE:
            raise ValueError(f"{confidence_path}: expected confidence from 0 to 2, got {confidence.max()}")
        measured = measured.masked_fill(torch.from_numpy(confidence < min_confidence), torch.nan)
        if not measured.isfinite().any():
            raise ValueError(f"{confidence_path}: expected a pixel of confidence {min_confidence}, there is none")
    height, width = _SIZE
    camera = Camera.from_fov(ASSUMED_FOV, width, height)
    if intrinsics_path is not None:
        width_given, height_given, *intrinsics = read_numbers(intrinsics_path, 6).tolist()  # pixel centres at integers
        if (height_given, width_given) != _SIZE:
            came = f"{height_given:g} x {width_given:g}"
            raise ValueError(f"{intrinsics_path}: expected a camera of 1440 x 1920 pixels, got {came}")
        camera = given_camera(intrinsics, _SIZE, intrinsics_path)
    return Scene(dataset, name, rgb, camera, depth, {width / _SIZE_LR[1]: measured})


NOTE = f"there is no .pincam file: {ASSUMED_FOV:g} degrees of horizontal view are assumed"
DETECTED = ((find_frames, load_frame, "arkitscenes"),)


class ARKitScenes(PreparedDataset):
    """Frames of ARKitScenes for depth upsampling (Baruch et al., NeurIPS 2021) at their own size, 1920 x 1440."""

    def __init__(
        self, root: str, split: Split = "validation", scenes: SceneSelection = None, min_confidence: int = 0
    ) -> None:
        expect_one_of("split", split, SPLITS)
        if min_confidence not in range(3):
            raise ValueError(f"min_confidence: expected 0, 1 or 2, got {min_confidence}")
        frames = find_frames(Path(root).expanduser(), split)
        found = make_records(
            frames, load_frame, "arkitscenes", lambda *files: "" if files[-1] else NOTE, min_confidence=min_confidence
        )
        super().__init__("arkitscenes", root, found, scenes)
        self.evaluation = split == "validation"

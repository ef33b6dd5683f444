"""``dataset=stereo_board``: a stereo camera before a board, which is an exact plane.

Five pairs of a RealSense that came with the code of Kienle and Petri, "Multi-Object Self-Supervised Depth Denoising",
arXiv 2305.05778, MIT licence; ``resources/images/uncalibrated/realsense`` in the commit c73b356 of
github.com/alr-internship/self-supervised-depth-denoising:

    color/8.png    the photo, 1920 x 1080, with the lens's distortion
    depth/8.png    the camera's depth, registered to the photo, 16 bits, mm, 0 = hole

likewise 14, 19, 25 and 31. A ChArUco board is in view. Its corners gave what this module has in :data:`CAMERA`,
:data:`LENS` and :data:`BOARDS` (root mean square reprojection error 0.30 pixels), and so the depth of every pixel on
the board: that of the plane where the pixel's ray, bent by the lens, meets it. Elsewhere nothing is known. The scene's
camera has no lens, so that planes are bent in it by up to 4.5 mm, the truth's and the map's alike.
"""

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
import torch

from dsr.data.download import CATALOGUE
from dsr.data.frame_files import find_beside, in_natural_order, read_frame
from dsr.data.scene_source import PreparedDataset, SceneSelection, make_records
from dsr.geometry.camera import Camera, Lens
from dsr.sample import Scene
from dsr.utils.versions import file_hash


@dataclass(frozen=True)
class Board:
    """The board in a frame."""

    normal: tuple[float, float, float]  # of its plane, of length 1, in the camera's axes (right, down, forward)
    distance: float  # of its plane from the camera along the normal, metres
    outline: tuple[tuple[float, float], ...]  # (column, row) of its corners, in pixels of the photo


CAMERA = Camera(1920, 1080, 1368.937, 1370.763, 936.091, 541.831)
LENS = Lens("brown_conrady", (0.13314, -0.3092, 0.0, 0.0))
BOARDS = MappingProxyType(
    {
        "8": Board(
            (0.442803, 0.010729, 0.896555), 1.36465, ((1331, 662.4), (891.1, 595.5), (922.7, 297.4), (1373.9, 313.9))
        ),
        "14": Board(
            (-0.494666, -0.003126, 0.869077), 0.92904, ((1439.5, 693), (1021.5, 764.2), (998.6, 347.5), (1424.4, 347))
        ),
        "19": Board(
            (-0.043949, -0.422185, 0.905444),
            1.22079,
            ((1513.8, 597.5), (1054.4, 736.5), (954.8, 457.7), (1459.7, 289.6)),
        ),
        "25": Board(
            (0.234985, -0.645635, 0.726593), 1.06151, ((1645, 616.2), (1149.1, 671.8), (1045.7, 430.4), (1601.7, 318.5))
        ),
        "31": Board(
            (-0.196585, -0.516696, 0.833294), 1.12616, ((1285.1, 732), (926.5, 591.8), (1108.8, 309.1), (1475.6, 498.6))
        ),
    }
)
# Pixels inside the outline up to which its own error of a pixel or two counts, and up to which the border reaches
INSIDE, BORDER = 12, 36


def find_frames(root: Path) -> dict[str, tuple[Path, Path, str]]:
    """Return photo, depth and name by name "8", in order."""
    found = {}
    for _, name, (photo, depth) in find_beside(root, "color", r"(\d+)\.(?:png|jpg)", ("depth/{}.png",)):
        if name in BOARDS:
            found[name] = (photo, depth, name)
    return in_natural_order(found)


def load_frame(rgb_path: Path, depth_path: Path, board: str, dataset: str, name: str) -> Scene:
    """Return one frame, the camera's map measured at the photo's size and the board's plane as the truth.

    Regions are ``board``, deeper inside the outline than :data:`INSIDE` pixels, and of that ``border``, up to
    :data:`BORDER`, which shows what is blurred across the outline.
    """
    rgb, measured = read_frame(rgb_path, depth_path, size=(CAMERA.height, CAMERA.width))
    filled = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    cv2.fillPoly(filled, [np.round(BOARDS[board].outline).astype(np.int32)], 1)
    inside = cv2.distanceTransform(filled, cv2.DIST_L2, 5)  # pixels inside the outline, 0 outside
    regions = {"board": inside > INSIDE, "border": (inside > INSIDE) & (inside <= BORDER)}
    found = {each: torch.from_numpy(region.astype(np.uint8))[None] for each, region in regions.items()}
    # each pixel's ray, bent by the lens, meets the plane
    truth = np.full(inside.shape, np.nan)
    rows, columns = np.nonzero(inside)
    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)[:, None]
    across, down = cv2.undistortPoints(pixels, matrix, np.array(LENS.coefficients))[:, 0].T
    rays = np.stack([across, down, np.ones_like(down)], axis=1)
    truth[rows, columns] = BOARDS[board].distance / (rays @ BOARDS[board].normal)
    return Scene(dataset, name, rgb, CAMERA, torch.from_numpy(truth)[None], {1: measured}, regions=found)


def _find_pinned(root: Path) -> dict[str, tuple[Path, Path, str]]:
    """Return the frames by their checksums: recordings of others have files of the same names."""
    pinned = {item.sha256 for item in CATALOGUE["stereo_board"].items}
    return {name: files for name, files in find_frames(root).items() if file_hash(files[0]) in pinned}


DETECTED = ((_find_pinned, load_frame, "stereo_board"),)


class StereoBoard(PreparedDataset):
    """Five frames of a stereo camera before an exact plane, at their own size, its map as measured at x1."""

    regions = ("board", "border")

    def __init__(self, root: str, scenes: SceneSelection = None) -> None:
        found = make_records(find_frames(Path(root).expanduser()), load_frame, "stereo_board")
        super().__init__("stereo_board", root, found, scenes, tuple(BOARDS))

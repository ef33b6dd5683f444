"""The frames that mistakes are made with: those of the shared data sets and sensors, and rendered ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import yaml

from dsr.data.detection import find_scenes
from dsr.geometry.camera import Camera
from dsr.geometry.poses import Matrix
from dsr.io.depth_files import read_depth_file
from dsr.sample import Scene
from dsr.synthetic.procedural.random_scene import RandomScene, make_camera, random_scene, render

DATA_SETS = (
    *(f"real/{name}" for name in ("ddrnet", "icl_nuim", "middlebury2005", "middlebury2006", "middlebury2014")),
    *(f"real/{name}" for name in ("rgbdd_real", "sunrgbd", "tartanair")),
    *("scenes", "modern/Lu", "modern/Middlebury", "modern/NYU", "modern/RGBDD"),
)  # Folders that dsr finds scenes in by itself
LIDAR_FOCAL = 1440.0  # Pixels of a phone's photo of 1920 x 1440, which comes without a camera
RENDERED, SIZE = 24, 256  # Rendered frames to draw from, and their size in pixels
LENGTH, STEP = 5, 0.03  # Frames of a sequence, and distance of their places as a fraction of that to what they look at


@dataclass(frozen=True)
class Frame:
    """A photo, (H, W, 3) uint8 RGB, its depth map, (h, w) metres with NaN in holes, and the photo's camera."""

    name: str
    photo: np.ndarray
    depth: np.ndarray
    camera: Camera
    pose: Matrix | None = None

    def reduced(self, factor: int) -> Frame:
        """Return it with every ``factor``-th pixel of its depth map, cut to a multiple of it."""
        height, width = (size // factor * factor for size in self.depth.shape)
        if self.depth.shape != self.photo.shape[:2] or min(height, width) < 40 * factor:
            return self
        depth = self.depth[factor // 2 : height : factor, factor // 2 : width : factor]
        return replace(
            self, photo=self.photo[:height, :width], depth=depth, camera=self.camera.crop(0, 0, height, width)
        )


def all_frames(shared: Path) -> dict[str, Callable[[], Frame]]:
    """Return what reads each frame of the shared material by name, or renders some where there is none."""
    if shared.is_dir():
        return shared_frames(shared)
    return {f"rendered/{number}": partial(rendered_frame, number, SIZE) for number in range(RENDERED)}


def shared_frames(shared: Path) -> dict[str, Callable[[], Frame]]:
    """Return what reads each frame of the shared material, by name."""
    found: dict[str, Callable[[], Frame]] = {}
    for folder in DATA_SETS:
        for name, load in find_scenes(shared / folder):
            found[f"{folder}/{name}"] = partial(_of_scene, f"{folder}/{name}", load)
    real = shared / "real"
    for folder in sorted((real / "depth_camera").iterdir()):
        photo = next(folder.glob("rgb.*"))
        found[f"depth_camera/{folder.name}"] = partial(
            _of_files, photo, folder / "raw_depth.png", folder / "intrinsics.txt"
        )
    board = real / "stereo_board"
    for path in sorted((board / "depth").iterdir()):
        found[f"stereo_board/{path.stem}"] = partial(_of_files, board / "color" / path.name, path, board / "board.json")
    glass = real / "cleargrasp"
    for path in sorted(glass.glob("*-transparent-depth-img.exr")):
        photo = glass / path.name.replace("depth-img.exr", "rgb-img.jpg")
        found[f"cleargrasp/{path.name[:3]}"] = partial(_of_files, photo, path, glass / "camera_intrinsics.yaml")
    phone = real / "iphone_lidar"
    found["iphone_lidar"] = partial(_of_files, phone / "image.jpg", phone / "arkit_depth.png", None)
    return found


def _of_scene(name: str, load: Callable[[], Scene]) -> Frame:
    """Return the frame of a scene: a sensor's own map where there is one."""
    scene = load()
    depth = scene.measured[min(scene.measured)] if scene.measured else scene.depth
    assert depth is not None
    photo = (255 * scene.rgb.permute(1, 2, 0).numpy()).round().astype(np.uint8)
    return Frame(name, photo, depth[0].double().numpy(), scene.camera)


def _of_files(photo: Path, depth: Path, intrinsics: Path | None) -> Frame:
    """Return the frame of a photo, a map in millimetres or an EXR file in metres, and a file of the camera."""
    pixels = cv2.cvtColor(cv2.imread(str(photo)), cv2.COLOR_BGR2RGB)
    values = read_depth_file(depth).astype(np.float64) * (1 if depth.suffix == ".exr" else 1e-3)
    size = (pixels.shape[1], pixels.shape[0])
    if intrinsics is None:
        camera = Camera.centred(*size, LIDAR_FOCAL)
    elif intrinsics.suffix == ".json":
        camera = Camera(**json.loads(intrinsics.read_text())["camera"])
    elif intrinsics.suffix == ".yaml":
        stored = yaml.safe_load(intrinsics.read_text())
        camera = Camera(*size, *(float(stored[key]) for key in ("fx", "fy", "cx", "cy")))
    else:
        matrix = np.loadtxt(intrinsics)
        camera = Camera(*size, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    return Frame(f"{photo.parent.name}/{photo.stem}", pixels, np.where(values > 0, values, np.nan), camera)


def rendered_frame(number: int, size: int) -> Frame:
    """Return a frame of a random scene."""
    return _seen(_scene(number), f"rendered/{number}", size)


def rendered_sequence(number: int, size: int) -> list[Frame]:
    """Return the frames of a random scene as a camera on a path sees it, with poses from camera to world."""
    scene = _scene(number)
    view = scene.viewpoint
    right, down, _ = view.axes()
    far = float(np.linalg.norm(view.target - view.eye))
    frames = []
    for place in range(LENGTH):
        step = (place - LENGTH // 2) * STEP * far
        moved = replace(view, eye=view.eye + step * right + 0.2 * abs(step) * down, roll=view.roll + 0.5 * place)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = moved.axes().T, scene.metres * moved.eye
        frame = _seen(replace(scene, viewpoint=moved, seed=scene.seed + place), f"sequence/{number}-{place}", size)
        frames.append(replace(frame, pose=pose))
    return frames


def _scene(number: int) -> RandomScene:
    """Return a random scene."""
    return random_scene(np.random.default_rng(np.random.SeedSequence([4711, number])))


def _seen(scene: RandomScene, name: str, size: int) -> Frame:
    """Return what a scene's camera sees."""
    made = render(scene, size)
    return Frame(name, made.rgb, made.depth.astype(np.float64), make_camera(scene.viewpoint, size))

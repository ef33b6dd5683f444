"""Inputs that can be computed with and are wrong: what dsr says of them, and of right ones.

    make mistakes ARGS="--cases 500 --seed 0"                        dsr upsample, with mistakes and without
    python benchmarks/mistakes.py encodings [--shared DIR] [--frames N] [--reduce 1] [--only NAME]
    python benchmarks/mistakes.py pairs --shared DIR [--rendered 500] [--workers 2]
    python benchmarks/mistakes.py poses [--scenes 20] [--size 160] [--right]

The first makes each kind of mistake with real frames, or rendered ones without ``DSR_SHARED``, and gives them to
``dsr upsample`` with the fastest method. ``encodings`` stores frames in each usual encoding and reads them as that
command does. *Read rightly* means that unit and range type are, *refused* that a line asks for what cannot be decided,
*silent* that one of the two is wrong, and no line says so. ``pairs`` and ``poses`` measure single checks, see there.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional

from dsr.app.upsample.checks import align, check_planes
from dsr.app.upsample.frames import find_frames
from dsr.app.upsample.request import UpsampleRequest
from dsr.data.cleargrasp import read_depth
from dsr.data.detection import find_scenes
from dsr.data.frame_files import read_picture
from dsr.degradation.downsampling import scene_generator
from dsr.degradation.noise import Kinect
from dsr.degradation.random_degradation import Everything
from dsr.geometry.agreement import depth_outlines, find_misplaced, judge, photo_outlines, reduce_photo, significances
from dsr.geometry.camera import Camera
from dsr.geometry.poses import READINGS, Matrix, PosedMap, find_fault, invert, sample
from dsr.io import inputs
from dsr.io.depth_files import Encoding, read_depth_file
from dsr.io.inputs import Picture
from dsr.notes import LIMITS
from dsr.sample import AllHolesError, Scene
from dsr.synthetic.procedural.random_scene import RandomScene, make_camera, random_scene, render, render_random_scene
from dsr.synthetic.simgeo import SCENES, render_scene
from dsr.utils.options import add_options, build

ROOT = Path(__file__).resolve().parents[1]

FOLDERS = (
    "ddrnet",
    "icl_nuim",
    "middlebury2005",
    "middlebury2006",
    "middlebury2014",
    "rgbdd_real",
    "sunrgbd",
    "tartanair",
)
DATA_SETS = (
    *(f"real/{name}" for name in FOLDERS),
    *("scenes", "modern/Lu", "modern/Middlebury", "modern/NYU", "modern/RGBDD"),
)  # Folders that dsr finds scenes in by itself
LIDAR_FOCAL = 1440.0  # Pixels of a phone's photo of 1920 x 1440, which comes without a camera
RENDERED, RENDERED_SIZE = 24, 256  # Rendered frames to draw from, and their size in pixels
FRAMES, STEP = 5, 0.03  # Frames of a sequence, and distance of their places as a fraction of that to what they look at


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
    return {f"rendered/{number}": partial(rendered_frame, number, RENDERED_SIZE) for number in range(RENDERED)}


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
    for place in range(FRAMES):
        step = (place - FRAMES // 2) * STEP * far
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


def scaled(pose: Matrix, factor: float) -> Matrix:
    """Return a pose in another unit."""
    return np.block([[pose[:3, :3], factor * pose[:3, 3:]], [pose[3:]]])


def turned(pose: Matrix, change: Callable[[Matrix], Matrix]) -> Matrix:
    """Return a pose with another rotation."""
    return np.block([[change(pose[:3, :3]), pose[:3, 3:]], [pose[3:]]])


def scalar_first(turn: Matrix) -> Matrix:
    """Return the rotation whose quaternion is w x y z of another's x y z w."""
    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    return Rotation.from_quat((w, x, y, z)).as_matrix()


OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
FORWARD_DOWN = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


RIGHT = "right"
ANSWERS = ("read rightly", "warned", "refused", "silent")  # What may be said of a case
CENTIMETRES, SHIFT, MILLIMETRES = 1e2, 0.05, 1e3


class Case(NamedTuple):
    """A case: the arguments, and how the values are to be read if they can be: metres per value and range type."""

    arguments: list[str]
    reading: tuple[float, str] | None = None


def judged(case: Case, warnings: Sequence[str], unit: float, range_type: str) -> str:
    """Return which of :data:`ANSWERS` a case that is not refused was given, by how its values were read."""
    wanted, of_type = case.reading or (np.nan, "")
    rightly = abs(unit / wanted - 1) < 1e-3 and range_type == of_type
    return "warned" if warnings else "read rightly" if rightly else "silent"


class Material(NamedTuple):
    """What a case is made of: frames of scenes that differ, its own first; a sequence; a folder for files."""

    frames: Sequence[Frame]
    sequence: Sequence[Frame]
    folder: Path
    rng: np.random.Generator

    @property
    def frame(self) -> Frame:
        """The case's own frame."""
        return self.frames[0]


Maker = Callable[[Material], Case]


def write_photo(path: Path, photo: np.ndarray) -> str:
    """Write a photo, and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), cv2.cvtColor(np.ascontiguousarray(photo), cv2.COLOR_RGB2BGR))
    return str(path)


def write_values(path: Path, values: np.ndarray) -> str:
    """Write a depth map: whole numbers as PNG, where NaN is 0, floats as NumPy has them; and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if values.dtype.kind == "f":
        np.save(path.with_suffix(".npy"), values)
        return str(path.with_suffix(".npy"))
    assert cv2.imwrite(str(path), values)
    return str(path)


def whole(values: np.ndarray, kind: type = np.uint16) -> np.ndarray:
    """Return values as whole numbers, 0 in holes and beyond their range."""
    values = np.nan_to_num(values, nan=0.0)
    return np.where(values <= np.iinfo(kind).max, values, 0).round().astype(kind)


def intrinsics(*numbers: float) -> list[str]:
    """Return the option."""
    return ["--intrinsics", *(f"{number:.6g}" for number in numbers)]


def pair(of: Material, photo: np.ndarray, values: np.ndarray, camera: Sequence[float] | None = None) -> list[str]:
    """Write a pair, and return the arguments for it."""
    own = of.frame.camera
    files = write_photo(of.folder / "photo.png", photo), write_values(of.folder / "depth.png", values)
    numbers = (own.fx, own.fy, own.cx, own.cy) if camera is None else camera
    return ["--rgb", files[0], "--depth", files[1], *intrinsics(*numbers)]


def pictured(change: Callable[[np.ndarray, Material], np.ndarray]) -> Maker:
    """Return what gives a photo that was changed."""

    def make(of: Material) -> Case:
        return Case(pair(of, change(of.frame.photo, of), whole(MILLIMETRES * of.frame.depth)))

    return make


def valued(change: Callable[[np.ndarray, Frame], np.ndarray], reading: tuple[float, str] | None = None) -> Maker:
    """Return what gives a depth map that is stored otherwise."""

    def make(of: Material) -> Case:
        return Case(pair(of, of.frame.photo, change(of.frame.depth, of.frame)), reading)

    return make


def seen(change: Callable[[Frame], tuple[float, float, float, float]]) -> Maker:
    """Return what gives another camera."""

    def make(of: Material) -> Case:
        return Case(pair(of, of.frame.photo, whole(MILLIMETRES * of.frame.depth), change(of.frame)))

    return make


def posed(change: Callable[[np.ndarray], np.ndarray], fewer: int = 0) -> Maker:
    """Return what gives the frames of a sequence with poses that were changed, the last ones left out."""

    def make(of: Material) -> Case:
        for frame in of.sequence:
            name = frame.name.rpartition("-")[2]
            write_photo(of.folder / "rgb" / f"{name}.png", frame.photo)
            write_values(of.folder / "depth" / f"{name}.png", whole(MILLIMETRES * frame.depth))
        kept = of.sequence[: len(of.sequence) - fewer] if fewer >= 0 else [*of.sequence, of.sequence[-1]]
        rows = [change(frame.pose)[:3].ravel() for frame in kept if frame.pose is not None]
        np.savetxt(of.folder / "poses.txt", [[*row, 0, 0, 0, 1] for row in rows])
        camera = of.sequence[0].camera
        arguments = ["--rgb", str(of.folder / "rgb"), "--depth", str(of.folder / "depth")]
        arguments += [
            *("--poses", str(of.folder / "poses.txt")),
            *intrinsics(camera.fx, camera.fy, camera.cx, camera.cy),
        ]
        return Case(arguments)

    return make


def listed(order: Callable[[list[int], np.random.Generator], list[int]]) -> Maker:
    """Return what gives lists of photos and depth maps, the latter in another order."""

    def make(of: Material) -> Case:
        size = of.frame.photo.shape[:2]
        photos, maps = [], []
        for number, frame in enumerate(of.frames):
            resized = cv2.resize(frame.photo, size[::-1], interpolation=cv2.INTER_AREA)
            depth = cv2.resize(frame.depth, of.frame.depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
            photos.append(write_photo(of.folder / f"photo{number}.png", resized))
            maps.append(write_values(of.folder / f"depth{number}.png", whole(MILLIMETRES * depth)))
        maps = [maps[number] for number in order(list(range(len(maps))), of.rng)]
        return Case(["--rgb", *photos, "--depth", *maps])

    return make


def _other(photo: np.ndarray, of: Material) -> np.ndarray:
    """Return the photo of another scene at the size of this one."""
    return cv2.resize(of.frames[1].photo, photo.shape[1::-1], interpolation=cv2.INTER_AREA)


def _shifted(photo: np.ndarray, of: Material) -> np.ndarray:
    """Return a photo of the same size that was moved to the side, with the border repeated."""
    pixels = round(SHIFT * photo.shape[1]) * int(of.rng.choice((-1, 1)))
    return cv2.warpAffine(
        photo, np.float32([[1, 0, pixels], [0, 1, 0]]), photo.shape[1::-1], borderMode=cv2.BORDER_REFLECT
    )


def _disparity(depth: np.ndarray, frame: Frame) -> np.ndarray:
    """Return disparities in pixels of the map, before a stereo camera whose nearest thing has 1/8 of the width."""
    return (depth.shape[1] / 8 * np.nanmin(depth) / depth).astype(np.float32)


def _stretched(depth: np.ndarray) -> np.ndarray:
    """Return depth from 0 to 1 over a picture."""
    low, high = np.nanpercentile(depth, (0.5, 99.5))
    return ((depth - low) / (high - low)).clip(0, 1)


def _coloured(depth: np.ndarray, _: Frame) -> np.ndarray:
    """Return depth as a picture in false colours."""
    return cv2.applyColorMap(whole(255 * _stretched(depth), np.uint8), cv2.COLORMAP_JET)


def _rotated_bits(depth: np.ndarray, _: Frame) -> np.ndarray:
    """Return millimetres whose bits are turned as SUN RGB-D turns them."""
    values = whole(MILLIMETRES * depth)
    return (values << 3) | (values >> 13)


def _along_rays(depth: np.ndarray, frame: Frame) -> np.ndarray:
    """Return distances along the rays in millimetres."""
    camera = frame.camera.rescale(depth.shape[1], depth.shape[0])
    return whole(MILLIMETRES * depth * camera.ray_lengths().numpy())


def _of_camera(frame: Frame, *factors: float) -> tuple[float, float, float, float]:
    """Return the photo's intrinsics, each times a factor."""
    own = (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy)
    fx, fy, cx, cy = (number * factor for number, factor in zip(own, factors, strict=True))
    return fx, fy, cx, cy


def _with_view(frame: Frame, degrees: float) -> tuple[float, float, float, float]:
    """Return the intrinsics of a camera with another field of view."""
    focal = frame.camera.width / 2 / np.tan(np.radians(degrees / 2))
    return focal, focal, frame.camera.cx, frame.camera.cy


def _depth_cameras(frame: Frame) -> tuple[float, float, float, float]:
    """Return the intrinsics of the depth map's pixels."""
    camera = frame.camera.rescale(frame.depth.shape[1], frame.depth.shape[0])
    return camera.fx, camera.fy, camera.cx, camera.cy


def _baseline(of: Material) -> Case:
    """Give disparities with a baseline in millimetres."""
    arguments = pair(of, of.frame.photo, _disparity(of.frame.depth, of.frame))
    return Case([*arguments, "--range-type", "disparity", "--baseline", "100"])


KINDS: Mapping[str, Mapping[str, Maker]] = {
    "photo and depth": {
        "mirrored": pictured(lambda photo, _: photo[:, ::-1]),
        "upside down": pictured(lambda photo, _: photo[::-1]),
        "turned by 180 degrees": pictured(lambda photo, _: photo[::-1, ::-1]),
        "of another scene": pictured(_other),
        "shifted by 5 % of the width": pictured(_shifted),
        "lists in reverse order": listed(lambda numbers, _: numbers[::-1]),
        "lists in another order": listed(lambda numbers, rng: list(np.roll(numbers, rng.integers(1, len(numbers))))),
    },
    "units and encodings": {
        "float centimetres": valued(lambda depth, _: (CENTIMETRES * depth).astype(np.float32), (1e-2, "orthogonal")),
        "float millimetres": valued(lambda depth, _: (MILLIMETRES * depth).astype(np.float32), (1e-3, "orthogonal")),
        "1/5000 m": valued(lambda depth, _: whole(5000 * depth), (1 / 5000, "orthogonal")),
        "1/6553.5 m": valued(lambda depth, _: whole(6553.5 * depth), (1 / 6553.5, "orthogonal")),
        "SUN RGB-D's bits": valued(_rotated_bits, (1e-3, "orthogonal")),
        "disparity, floats": valued(_disparity),
        "disparity, 8 bits": valued(lambda depth, frame: whole(_disparity(depth, frame), np.uint8)),
        "inverse depth": valued(lambda depth, _: (np.nanmin(depth) / depth * 37.3).astype(np.float32)),
        "0 to 1": valued(lambda depth, _: _stretched(depth).astype(np.float32)),
        "8 bits for viewing": valued(lambda depth, _: whole(255 * _stretched(depth), np.uint8)),
        "false colours": valued(_coloured),
        "along the rays": valued(_along_rays, (1e-3, "perspective")),
    },
    "cameras": {
        "of twice the size": seen(lambda frame: _of_camera(frame, 2, 2, 2, 2)),
        "of half the size": seen(lambda frame: _of_camera(frame, 0.5, 0.5, 0.5, 0.5)),
        "fy of 5 pixels": seen(lambda frame: (frame.camera.fx, 5.0, frame.camera.cx, frame.camera.cy)),
        "4 degrees of view": seen(lambda frame: _with_view(frame, 4)),
        "172 degrees of view": seen(lambda frame: _with_view(frame, 172)),
        "cx of 1e9": seen(lambda frame: (frame.camera.fx, frame.camera.fy, 1e9, frame.camera.cy)),
        "the depth camera's": seen(_depth_cameras),
        "baseline in millimetres": _baseline,
    },
    "poses": {
        "in millimetres": posed(lambda pose: scaled(pose, MILLIMETRES)),
        "world to camera": posed(invert),
        "rotations by columns": posed(lambda pose: turned(pose, np.transpose)),
        "y up, z back": posed(lambda pose: pose @ OPENGL),
        "order of the quaternion": posed(lambda pose: turned(pose, scalar_first)),
        "one fewer than frames": posed(lambda pose: pose, 1),
        "one more than frames": posed(lambda pose: pose, -1),
    },
    RIGHT: {
        "millimetres, 16 bits": valued(lambda depth, _: whole(MILLIMETRES * depth), (1e-3, "orthogonal")),
        "float metres": valued(lambda depth, _: depth.astype(np.float32), (1.0, "orthogonal")),
        "lists": listed(lambda numbers, _: numbers),
        "a sequence with poses": posed(lambda pose: pose),
    },
}  # fmt: skip
LISTED, SEQUENCE_SIZE = 6, 128
SEQUENCES = (0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11, 12)


def draw(number: int, seed: int, sources: dict[str, Callable[[], Frame]], folder: Path) -> tuple[str, str, Case]:
    """Return a case with what is wrong in it."""
    rng = np.random.default_rng([seed, number])
    names = [(group, kind) for group in KINDS for kind in KINDS[group]]
    rights = [each for each in names if each[0] == RIGHT]
    group, kind = (rights if number % 4 == 3 else [each for each in names if each[0] != RIGHT])[rng.integers(
        len(rights) if number % 4 == 3 else len(names) - len(rights)
    )]  # fmt: skip
    chosen = rng.choice(list(sources), min(LISTED, len(sources)), replace=False)
    factor = int(rng.choice((1, 4))) if kind != "the depth camera's" else 4
    sequence = rendered_sequence(int(rng.choice(SEQUENCES)), SEQUENCE_SIZE) if "pose" in f"{group} {kind}" else ()
    count = len(chosen) if "lists" in kind else 2
    frames = [sources[name]().reduced(factor) for name in chosen[:count]] if not sequence else ()
    material = Material(frames, sequence, folder, rng)
    return group, kind, KINDS[group][kind](material)


def answer(case: Case, folder: Path) -> tuple[str, str]:
    """Return what a command answers to a case, and its words."""
    out = folder / "out"
    command = ("-m", "dsr", "upsample", *case.arguments, "--method", "bicubic", "--only", "depth", "-o", str(out))
    from commands import run_python  # noqa: PLC0415 - of tests/, for this campaign alone

    done = run_python(*command, cwd=ROOT, timeout=600)
    if done.returncode == 2:
        return "refused", done.stderr.strip().splitlines()[-1]
    if done.returncode:
        raise RuntimeError(f"exit {done.returncode}: {done.stderr[-500:]}")
    infos = [json.loads(path.read_text()) for path in sorted(out.rglob("info.json"))]
    warnings = [each["message"] for info in infos for each in info["warnings"]]
    read = infos[0]["input_depth"]
    return judged(case, warnings, read["unit"], read["range_type"]), "".join(warnings[:1])


def commands(words: Sequence[str]) -> None:
    """Run `dsr upsample` on mistakes, and on what is right: three to one."""
    parser = argparse.ArgumentParser(prog="make mistakes", description=commands.__doc__)
    parser.add_argument("--cases", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--shared", type=Path, default=os.environ.get("DSR_SHARED", ROOT.parent / "shared"))
    options = parser.parse_args(words)
    sources = all_frames(options.shared)
    counts: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    started = time.monotonic()
    for number in range(options.cases):
        with tempfile.TemporaryDirectory() as place:
            group, kind, case = draw(number, options.seed, sources, Path(place))
            said, words = answer(case, Path(place))
        counts[group, kind][said] += 1
        wrong = said in ("warned", "refused") if group == RIGHT else said == "silent"
        if wrong:
            print(f"case {number}: {group}, {kind}: {said} {words}", flush=True)
    print(commands_table(counts))
    print(f"{options.cases} cases, seed {options.seed}, {(time.monotonic() - started) / 60:.0f} minutes")


def commands_table(counts: dict[tuple[str, str], Counter[str]]) -> str:
    """Return the counts in Markdown."""
    lines = ["| what | case | cases | " + " | ".join(ANSWERS) + " |", "| --- | --- |" + " ---: |" * (len(ANSWERS) + 1)]
    for group, kinds in KINDS.items():
        for kind in kinds:
            row = counts.get((group, kind), Counter())
            cells = " | ".join(str(row[each]) for each in ANSWERS)
            lines.append(f"| {group} | {kind} | {row.total()} | {cells} |")
    wrong = sum((row for (group, _), row in counts.items() if group != RIGHT), Counter())
    right = sum((row for (group, _), row in counts.items() if group == RIGHT), Counter())
    for name, row in (("all mistakes", wrong), ("all that is right", right)):
        lines.append(f"| {name} | | {row.total()} | " + " | ".join(str(row[each]) for each in ANSWERS) + " |")
    return "\n".join(lines)


ENCODINGS: dict[str, Maker] = {
    **{name: KINDS[RIGHT][name] for name in ("millimetres, 16 bits", "float metres")},
    **KINDS["units and encodings"],
    "inverse depth, 1/m": valued(lambda depth, _: (1 / depth).astype(np.float32)),
    "1/256 m, no size of KITTI's": valued(lambda depth, _: whole(256 * depth), (1 / 256, "orthogonal")),
}


def without_detail(frame: Frame) -> Frame:
    """Return a frame whose photo has the size of its depth map: what is measured does not depend on it."""
    height, width = frame.depth.shape
    photo = cv2.resize(frame.photo, (width, height), interpolation=cv2.INTER_AREA)
    return replace(frame, photo=photo, camera=frame.camera.rescale(width, height))


def read_as(make: Maker, frame: Frame) -> str:
    """Return what is said of a frame in an encoding."""
    parser = argparse.ArgumentParser()
    add_options(parser, UpsampleRequest)
    with tempfile.TemporaryDirectory() as folder:
        case = make(Material((frame,), (), Path(folder), np.random.default_rng(0)))
        request = build(UpsampleRequest, parser.parse_args([*case.arguments, "-o", folder]))
        (pair,) = find_frames(request).whole
        try:
            picture = inputs.read_picture(pair, request.reading)
        except ValueError:
            return "refused"
        notes = (*picture.assumptions, *check_planes(picture, pair, request.reading))
    encoding = picture.encoding
    return judged(case, [each.code for each in notes if each.code], encoding.unit, encoding.range_type)


def encodings(words: Sequence[str]) -> None:
    """Store every frame, or some, in each encoding, and count the answers."""
    parser = argparse.ArgumentParser(prog="mistakes.py encodings", description=encodings.__doc__)
    parser.add_argument("--shared", type=Path, default=Path("-"), help="rendered frames, where there is no such folder")
    parser.add_argument("--frames", type=int, help="at most so many, spread evenly")
    parser.add_argument("--reduce", type=int, default=1, help="every so many pixels of the maps")
    parser.add_argument("--only", default="", help="encodings whose name contains this")
    options = parser.parse_args(words)
    torch.set_num_threads(1)
    sources = list(all_frames(options.shared).values())
    every = 1 if options.frames is None else -(-len(sources) // options.frames)
    frames = [without_detail(load().reduced(options.reduce)) for load in sources[::every]]
    print(f"| {len(frames)} frames | " + " | ".join(ANSWERS) + " |\n| --- |" + " ---: |" * len(ANSWERS))
    for name, make in ENCODINGS.items():
        if options.only in name:
            counts = Counter(read_as(make, frame) for frame in frames)
            print(f"| {name} | " + " | ".join(str(counts[each]) for each in ANSWERS) + " |", flush=True)


SENSORS = Everything(
    noises={"white": 1, "correlated": 1, "structured": 1, "flight": 1, "lidar": 1, "stereo": 1},
    holes={"none": 2, "blobs": 1, "shadows": 1, "steps": 1, "dark": 1, "pixels": 1},
    folds=0,
    relief=0,
    displaced=0,
)
TURNS: dict[str, Callable[[Tensor], Tensor]] = {
    "mirrored": lambda photo: photo.flip(2),
    "flipped": lambda photo: photo.flip(1),
    "180": lambda photo: photo.flip(1, 2),
    "90": lambda photo: _resized(photo.rot90(1, (1, 2)), photo.shape[1:]),
    "270": lambda photo: _resized(photo.rot90(-1, (1, 2)), photo.shape[1:]),
}
WRONG_PAIRS = (*TURNS, "other", "shifted")
SIDE, LISTS, LENGTH = 256, 200, 12
_SAME = 0.8
_SEQUENCES = ("ddrnet", "stereo_board", "cleargrasp")


class Right(NamedTuple):
    """A photo, (3, H, W) in [0, 1], and the depth map of it, (1, h, w) in metres, NaN in holes."""

    dataset: str
    name: str
    rgb: Tensor
    depth: Tensor

    @property
    def developed(self) -> bool:
        """Whether the thresholds were chosen on it."""
        return "iddlebury" in self.dataset or (self.dataset.startswith("rendered") and self.name.startswith("11"))


class Outcome(NamedTuple):
    """What was found in a pair: the code of its warning, and the figures that it depends on; by kind, "" as given."""

    code: str
    margin: float
    significance: float
    conclusive: bool


def degraded(dataset: str, scene: Scene, scales: tuple[int, ...]) -> Iterator[Right]:
    """Yield a scene's map reduced by each factor as a sensor may measure it."""
    for scale in scales:
        generator = scene_generator(scale, dataset, scene.name, scale)
        whole = scene.crop(0, 0, *(size // scale * scale for size in scene.rgb.shape[-2:]))
        try:
            sample, _ = SENSORS(whole, scale, generator)
        except AllHolesError:
            continue
        title = f"{dataset}, x{scale}" if scale > 1 else f"{dataset}, noisy"
        yield Right(title, scene.name, sample.rgb.float().clamp(0, 1), sample.depth_lr.float())


def raw(shared: Path) -> Iterator[Right]:
    """Yield the maps of sensors as they are."""
    real = shared / "real"

    def right(dataset: str, photo: Path, depth: Path, name: str = "") -> Right:
        return Right(dataset, name or photo.stem, read_picture(photo).float(), _stored(depth, dataset))

    for path in sorted((real / "ddrnet/depth_map").glob("*.png")):
        yield right("ddrnet raw", real / "ddrnet/color_map" / path.name, path)
    for path in sorted((real / "rgbdd_real/DepthLR").glob("*.png")):
        yield right("rgbdd_real raw", real / "rgbdd_real/RGB" / f"{path.name.split('_')[0]}_RGB.jpg", path)
    yield right("iphone_lidar", real / "iphone_lidar/image.jpg", real / "iphone_lidar/arkit_depth.png")
    for folder in sorted((real / "depth_camera").iterdir()):
        yield right("depth_camera", next(folder.glob("rgb.*")), folder / "raw_depth.png", folder.name)
    for path in sorted((real / "stereo_board/depth").glob("*.png")):
        yield right("stereo_board", real / "stereo_board/color" / path.name, path)
    for path in sorted((real / "cleargrasp").glob("*-depth-img.exr")):
        yield right("cleargrasp", path.with_name(path.name.replace("-depth-img.exr", "-rgb-img.jpg")), path)
    for path in sorted((real / "tofmark").glob("*_depth.bmp")):
        yield right("tofmark", path.with_name(path.name.replace("_depth", "")), path)
    for folder in sorted((real / "sunrgbd").iterdir()):
        for path in folder.glob("depth/*.png"):
            yield right("sunrgbd raw", next((folder / "image").glob("*.jpg")), path, folder.name)
    yield right(
        "sunrgbd raw", *((real / "sunrgbd/open3d_sample" / f"SUN_{kind}") for kind in ("color.jpg", "depth.png"))
    )
    yield right("books raw", shared / "scenes/books/rgb.png", shared / "scenes/books/disparity_lr4.npy", "books")


def _stored(path: Path, dataset: str) -> Tensor:
    """Return a depth map in metres, or in some unit, as the units are no matter here."""
    if path.suffix == ".exr":
        return read_depth(path)
    stored = np.load(path) if path.suffix == ".npy" else cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    stored = stored if stored.ndim == 2 else stored[..., 0]
    if dataset == "sunrgbd raw" and "open3d" not in str(path):
        stored = (stored >> 3) | (stored << 13)
    values = torch.from_numpy(stored.astype(np.float32))[None]
    values = values.reciprocal() if "disparity" in path.name else values / 1000
    return values.masked_fill(~((values > 0) & values.isfinite()), torch.nan)


def real_pairs(shared: Path) -> Iterator[Right]:
    """Yield every real pair, as it is and degraded."""
    yield from raw(shared)
    modern = sorted((shared / "modern").iterdir())
    for folder in [*(shared / "real" / name for name in FOLDERS), *modern, shared / "scenes"]:
        dataset = f"modern {folder.name}" if folder in modern else folder.name
        for _, load in find_scenes(folder):
            scene = load()
            if scene.depth is None:
                continue
            yield Right(dataset, scene.name, scene.rgb.float(), scene.depth.float())
            for ratio, measured in scene.measured.items() if dataset.startswith("middlebury") else ():
                yield Right(f"{dataset}, measured", f"{scene.name} x{ratio}", scene.rgb.float(), measured.float())
            yield from degraded(dataset, scene, (4, 8))


def rendered_pairs(number: int) -> list[Right]:
    """Return a rendered scene, degraded; of every fiftieth number one of SimGeo."""
    seed, index = 11 + number % 2, number // 2
    made = render_random_scene(seed, index, SIDE)
    if index % 25 == 24:
        made = render_scene(SCENES[index // 25 % len(SCENES)], SIDE + 8 * (number % 2))
    rgb = torch.from_numpy(made.rgb).permute(2, 0, 1).float() / 255
    depth = torch.from_numpy(made.depth)[None]
    side = rgb.shape[-1]
    camera = Camera(side, side, 0.94 * side, 0.94 * side, (side - 1) / 2, (side - 1) / 2, baseline=0.2)
    scene = Scene("rendered", f"{seed}_{index}", rgb, camera, depth)
    return list(degraded("rendered", scene, ((1, 4, 8)[index % 3],)))


def examine(rgb: Tensor, depth: Tensor, *, right: bool = False) -> Outcome:
    """Return what ``dsr upsample`` finds; in a wrong pair its displacement only where nothing else is detected."""
    verdict = judge(depth[0].numpy(), rgb)
    if verdict is not None and not right and verdict.kind in ("turned", "apart", "other"):
        code = verdict.statement
    else:
        camera = Camera(rgb.shape[-1], rgb.shape[-2], 1.0, 1.0, 0.0, 0.0)
        picture = Picture(rgb, depth, camera, Encoding(".npy", "float32", 1.0, np.nan, "orthogonal"), ())
        code = "".join(note.code for note in align(picture, register=False).assumptions)
    if verdict is None:
        return Outcome(code, -99.0, 99.0, conclusive=False)
    return Outcome(code, verdict.margin, verdict.as_given.significance, conclusive=verdict.conclusive)


def outcomes(job: tuple[Right, Tensor]) -> dict[str, Outcome]:
    """Return what is found in a pair as it is, and in the wrong ones made of it."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    pair, other = job
    found = {"": examine(pair.rgb, pair.depth, right=True)}
    for kind, turn in TURNS.items():
        found[kind] = examine(turn(pair.rgb).contiguous(), pair.depth)
    found["other"] = examine(_resized(other, pair.rgb.shape[1:]), pair.depth)
    found["shifted"] = examine(*_cropped(pair, shifted=True))
    as_right = judge(_cropped(pair, shifted=False)[1][0].numpy(), _cropped(pair, shifted=False)[0])
    conclusive = as_right is not None and as_right.conclusive
    found["shifted"] = found["shifted"]._replace(conclusive=found[""].conclusive and conclusive)
    return found


def _cropped(pair: Right, *, shifted: bool) -> tuple[Tensor, Tensor]:
    """Return a pair without 10 to 25 % of its width or height, cut off of photo and map on opposite sides or not."""
    rng = np.random.default_rng(len(pair.name) + pair.depth.shape[-1])
    axis, share = int(rng.integers(1, 3)), rng.uniform(0.1, 0.25)
    cut = round(share * pair.depth.shape[axis])
    left = round(cut / pair.depth.shape[axis] * pair.rgb.shape[axis])
    rgb = pair.rgb.narrow(axis, left, pair.rgb.shape[axis] - left)
    depth = pair.depth.narrow(axis, 0 if shifted else cut, pair.depth.shape[axis] - cut)
    return rgb.contiguous(), depth.contiguous()


def _resized(photo: Tensor, size: tuple[int, ...]) -> Tensor:
    """Return a photo at another size."""
    return functional.interpolate(photo[None], tuple(size), mode="bilinear", antialias=True)[0].clamp(0, 1)


def _tiny(rgb: Tensor) -> np.ndarray:
    """Return a small thumbnail as a vector of unit length, by which scenes are distinguished."""
    values = functional.interpolate(rgb[None], (12, 16), mode="area").double().numpy().ravel()
    values -= values.mean()
    return values / max(float(np.linalg.norm(values)), 1e-9)


def others(pairs: list[Right]) -> list[int]:
    """Return for each pair one of the same half that shows another scene."""
    tiny = np.stack([_tiny(pair.rgb) for pair in pairs])
    rng = np.random.default_rng(0)
    found = []
    for pair, alike in zip(pairs, tiny @ tiny.T, strict=True):
        sequence = next((name for name in _SEQUENCES if pair.dataset.startswith(name)), None)
        options = [
            number
            for number, other in enumerate(pairs)
            if alike[number] < _SAME
            and other.developed == pair.developed
            and not (sequence is not None and other.dataset.startswith(sequence))
        ]
        found.append(int(rng.choice(options)))
    return found


def lists(pairs: list[Right], *, developed: bool) -> str:
    """Return how many lists of pairs of different scenes get a warning, in the same and in another order."""
    rng = np.random.default_rng(1)
    size = (192, 256)
    chosen = [pair for pair in pairs if pair.developed == developed and max(pair.depth.shape) >= 80][
        :: 1 + len(pairs) // 400
    ]
    tiny = np.stack([_tiny(pair.rgb) for pair in chosen])
    alike = tiny @ tiny.T >= _SAME
    depths = [depth_outlines(pair.depth[0].numpy(), size) for pair in chosen]
    photos = [photo_outlines(reduce_photo(pair.rgb, size), 256 / max(pair.depth.shape)) for pair in chosen]
    agreements = significances(depths, photos)
    counts = dict.fromkeys(("same order", "reversed", "one off", "two exchanged"), 0)
    for _ in range(LISTS):
        drawn: list[int] = []
        for number in rng.permutation(len(chosen)):
            if not alike[number, drawn].any() and len(drawn) < LENGTH:
                drawn.append(int(number))
        exchanged = [*drawn[1::-1], *drawn[2:]]
        for kind, order in zip(counts, (drawn, drawn[::-1], drawn[1:] + drawn[:1], exchanged), strict=True):
            found = find_misplaced(agreements[np.ix_(drawn, order)])
            counts[kind] += len(found) >= LIMITS["photo-order"]
    return ", ".join(f"{kind} {count}" for kind, count in counts.items())


def pairs_table(pairs: list[Right], results: list[dict[str, Outcome]]) -> Iterator[str]:
    """Yield the lines of the table: by data set, then by half."""
    yield "| data set | right pairs | false alarms | edges exist | " + " | ".join(WRONG_PAIRS) + " |"
    yield "| --- |" + " --- |" * (3 + len(WRONG_PAIRS))
    rows = list(zip(pairs, results, strict=True))
    names = dict.fromkeys(pair.dataset.partition(",")[0] for pair in pairs)
    groups = {name: [row for row in rows if row[0].dataset.partition(",")[0] == name] for name in names}
    for title, developed in (("**all that thresholds were chosen on**", True), ("**all others**", False)):
        groups[title] = [row for row in rows if row[0].developed == developed]
    groups["**all**"] = rows
    for name, group in groups.items():
        alarms = [result[""].code for _, result in group if result[""].code]
        beside = alarms.count("edges-beside")
        conclusive = [result for _, result in group if result[""].conclusive]
        detected = [
            f"{sum(bool(result[kind].code) for result in conclusive)} of {len(conclusive)}" if conclusive else ""
            for kind in WRONG_PAIRS
        ]
        cry = f"{len(alarms) - beside}" + (f" (+ {beside} shifted)" if beside else "")
        yield f"| {name} | {len(group)} | {cry} | {len(conclusive)} | " + " | ".join(detected) + " |"


def curves(pairs: list[Right], results: list[dict[str, Outcome]]) -> dict[str, list[tuple[float, float, float]]]:
    """Return threshold, share of right pairs with a false alarm, share of wrong ones detected where edges exist."""
    own = [result for pair, result in zip(pairs, results, strict=True) if not pair.developed]
    conclusive = [result for result in own if result[""].conclusive]
    found: dict[str, list[tuple[float, float, float]]] = {"photo-turned": [], "photo-other": []}
    for threshold in np.arange(0, 12.1, 0.5):
        false = np.mean([result[""].margin >= threshold for result in own])
        detected = np.mean([result[kind].margin >= threshold for result in conclusive for kind in TURNS])
        found["photo-turned"].append((threshold, false, detected))
    for threshold in np.arange(-1, 6.1, 0.25):
        false = np.mean([result[""].conclusive and result[""].significance < threshold for result in own])
        detected = np.mean([result["other"].significance < threshold for result in conclusive])
        found["photo-other"].append((threshold, false, detected))
    return found


def pairs(words: Sequence[str]) -> None:
    """Count warnings of photos and depth maps that do not belong together, and of those that do.

    Right pairs are everything in ``--shared``: raw maps of sensors, maps with a truth at their own size, the same
    reduced by 4 and 8 with noise and holes as sensors have them, and rendered scenes, at 1/1, 1/4 and 1/8, with the
    same. Wrong ones are made of them: the photo is mirrored, turned (by 90 degrees, and resized to what it was), taken
    from another scene, or photo and depth are cropped on opposite sides by 10 to 25 % of the size, so that they are
    shifted. Edges exist in a right pair, and what remains of it after the crop, if its
    :class:`dsr.geometry.agreement.Verdict` is ``conclusive``, which depends on its edges and not on how they agree. The
    thresholds were chosen on Middlebury and every other rendered scene; the rest is reported separately. Lists of 12
    pairs, in the same and in another order, follow, and what other thresholds would detect.
    """
    parser = argparse.ArgumentParser(prog="mistakes.py pairs", description=pairs.__doc__)
    parser.add_argument("--shared", type=Path, required=True)
    parser.add_argument("--rendered", type=int, default=500)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args(words)
    torch.set_num_threads(1)
    with ProcessPoolExecutor(options.workers, get_context("spawn")) as pool:
        found = list(real_pairs(options.shared))
        found += [pair for made in pool.map(rendered_pairs, range(options.rendered), chunksize=4) for pair in made]
        jobs = ((pair, found[other].rgb) for pair, other in zip(found, others(found), strict=True))
        results = []
        for number, result in enumerate(pool.map(outcomes, jobs), 1):
            results.append(result)
            print(f"\r{number} of {len(found)} pairs", end="", file=sys.stderr)
    print("\n".join(pairs_table(found, results)))
    for developed in (True, False):
        print(f"\n{LISTS} lists of {LENGTH} each, warnings,", "chosen on:" if developed else "others:",
              lists(found, developed=developed))  # fmt: skip
    for code, points in curves(found, results).items():
        print(f"\n| `{code}` from | false alarms | detected |\n| --- | --- | --- |")
        print("\n".join(f"| {threshold:g} | {false:.1%} | {detected:.1%} |" for threshold, false, detected in points))


WRONG_POSES: dict[str, Callable[[Matrix], Matrix]] = {
    "": lambda pose: pose,
    "from world to camera": invert,
    "of cameras with y up and z backward": lambda pose: pose @ OPENGL,
    "of cameras with x forward and z down": lambda pose: pose @ FORWARD_DOWN.T,
    "with rotations by columns": lambda pose: turned(pose, np.transpose),
    "with quaternions w x y z": lambda pose: turned(pose, scalar_first),
    "in millimetres": lambda pose: scaled(pose, 1e3),
    "in centimetres": lambda pose: scaled(pose, 1e2),
    "10 times too small": lambda pose: scaled(pose, 0.1),
    "1000 times too small": lambda pose: scaled(pose, 1e-3),
    "from world to camera, in millimetres": lambda pose: scaled(invert(pose), 1e3),
    "from world to camera, of cameras with y up and z backward": lambda pose: invert(pose @ OPENGL),
    "of cameras with y up and z backward, in millimetres": lambda pose: scaled(pose @ OPENGL, 1e3),
}


class Camerawork(NamedTuple):
    """How a camera moves: frames; steps in distances to its target, and turns in degrees, from frame to frame."""

    frames: int
    step: float
    turn: float


WORK = {
    "video": Camerawork(120, 0.003, 0.3),
    "photos": Camerawork(20, 0.05, 4.0),
    "rotation alone": Camerawork(60, 0.0, 1.0),
    "translation alone": Camerawork(60, 0.01, 0.0),
    "tripod": Camerawork(60, 0.0, 0.0),
}


class Recording(NamedTuple):
    """Depth maps by number, their camera, and right poses."""

    depth: Callable[[int], np.ndarray]
    camera: Camera
    poses: Sequence[Matrix]


def smooth(rng: np.random.Generator, frames: int, step: float) -> np.ndarray:
    """Return a smooth random path with a root mean square step, (frames, 3)."""
    times = np.arange(frames)[:, None]
    path = np.zeros((frames, 3))
    for waves in (0.7, 1.6, 3.1):
        path += (
            np.sin(2 * np.pi * waves * times / max(frames, 30) + rng.uniform(0, 6.28, 3))
            / waves
            * rng.uniform(0.5, 1, 3)
        )
    steps = np.diff(path, axis=0)
    return path * step / np.sqrt((steps**2).sum(1).mean())


def rendered_recording(index: int, work: Camerawork, size: int, *, wall: bool) -> Recording:
    """Return a procedural scene, or a wall, as a moving camera sees it."""
    rng = np.random.default_rng(np.random.SeedSequence([48, index]))
    scene = random_scene(rng)
    view, camera = scene.viewpoint, make_camera(scene.viewpoint, size)
    distance = float(np.linalg.norm(view.target - view.eye))
    eyes = view.eye + distance * smooth(rng, work.frames, work.step)
    angles = smooth(rng, work.frames, work.turn)
    start = view.axes().T
    own = []
    for eye, angle in zip(eyes, angles, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = start @ Rotation.from_rotvec(angle, degrees=True).as_matrix(), eye
        own.append(pose)
    rays = camera.rays().numpy().reshape(3, -1)
    noise = Kinect(nearest=0.2, farthest=None)

    def depth(number: int) -> np.ndarray:
        turn, eye = own[number][:3, :3], own[number][:3, 3]
        if wall:
            normal = start[:, 2]
            values = normal @ (view.target - eye) / np.maximum(normal @ (turn @ rays), 0.05)
        else:
            values = scene.tracer.trace(eye, turn @ rays).depth
        values = scene.metres * np.where(np.isfinite(values) & (values > 0.05), values, np.nan)
        known = torch.from_numpy(values.reshape(1, 1, size, size))
        return noise(known, torch.Generator().manual_seed(number))[0, 0].numpy()

    world = np.eye(4)
    if index % 2:
        world[:3, :3], world[:3, 3] = Rotation.random(random_state=index).as_matrix(), rng.normal(0, 2, 3)
    else:
        world = invert(scaled(own[0], scene.metres))
    poses = [world @ scaled(pose, scene.metres) @ inexact(rng) for pose in own]
    return Recording(depth, camera, poses)


def inexact(rng: np.random.Generator) -> Matrix:
    """Return the error of a pose: 1 cm and half a degree in all."""
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.3, 3), degrees=True).as_matrix()
    error[:3, 3] = rng.normal(0, 0.006, 3)
    return error


def recordings(scenes: int, size: int) -> Iterator[tuple[str, Recording]]:
    """Yield the recordings with the name of their kind."""
    for name, work in WORK.items():
        for index in range(scenes):
            yield name, rendered_recording(index, work, size, wall=False)
    for name in ("video", "translation alone"):
        for index in range(scenes):
            yield f"wall, {name}", rendered_recording(index, WORK[name], size, wall=True)


def outcome(recording: Recording, groups: Sequence[Sequence[int]], maps: dict[int, np.ndarray], wrong: str) -> str:
    """Return what is said of poses that are wrong in a way."""
    change = WRONG_POSES[wrong]
    found = find_fault(
        [PosedMap(maps[number], recording.camera, change(recording.poses[number])) for number in group]
        for group in groups
    )
    if found is None:
        return "silent"
    if found.code != "poses":
        return "disagree"
    names = found.text.removeprefix("the poses are probably ").split(" or ")
    return "right" if wrong in names else "wrong"


def poses(words: Sequence[str]) -> None:
    """Count whether poses that are read wrongly are noticed, by the camera's motion and by what is wrong.

    Random procedural scenes and a wall, as a camera on a smooth random path sees them, with the noise of a Kinect v1
    and poses that are off by a centimetre and half a degree, in a world's frame of any place.
    """
    parser = argparse.ArgumentParser(prog="mistakes.py poses", description=poses.__doc__)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--size", type=int, default=160)
    parser.add_argument("--right", action="store_true", help="right poses alone: false alarms of more scenes")
    options = parser.parse_args(words)
    torch.set_num_threads(1)
    measured = [""] if options.right else list(WRONG_POSES)
    counts: dict[str, dict[str, Counter[str]]] = {}
    seconds = 0.0
    for kind, recording in recordings(options.scenes, options.size):
        groups = sample(len(recording.poses))
        maps = {number: recording.depth(number) for group in groups for number in group}
        started = time.perf_counter()
        for wrong in measured:
            found = outcome(recording, groups, maps, wrong)
            counts.setdefault(kind, {}).setdefault(wrong, Counter())[found] += 1
        seconds = max(seconds, (time.perf_counter() - started) / len(measured))
    print("named rightly / that they disagree / wrongly / silent")
    print(f"| poses | {' | '.join(counts)} |")
    print("| --- |" + " --- |" * len(counts))
    for wrong in measured:
        cells = [
            " / ".join(str(each[wrong][name]) for name in ("right", "disagree", "wrong", "silent"))
            for each in counts.values()
        ]
        print(f"| {wrong or 'right'} | {' | '.join(cells)} |")
    print(f"{len(READINGS)} readings, at most {seconds:.2f} s for a sequence")


def main() -> None:
    """Run what the first word names, the campaign of commands unless it does."""
    programs = {"encodings": encodings, "pairs": pairs, "poses": poses}
    words = sys.argv[1:]
    if words and words[0] in programs:
        programs[words[0]](words[1:])
    else:
        commands(words)


if __name__ == "__main__":
    main()

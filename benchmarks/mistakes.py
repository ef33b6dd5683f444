"""Inputs that can be computed with and are wrong: what dsr says of them, and of right ones.

    make mistakes ARGS="--cases 500 --seed 0"                        dsr upsample, with mistakes and without
    python benchmarks/mistakes.py encodings [--shared DIR] [--frames N] [--reduce 1] [--only NAME]

The first makes each kind of mistake with real frames, or rendered ones without ``DSR_SHARED``, and gives them to
``dsr upsample`` with the fastest method. ``encodings`` stores frames in each usual encoding and reads them as that
command does. *Read rightly* means that unit and range type are, *refused* that a line asks for what cannot be decided,
*silent* that one of the two is wrong, and no line says so.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation

from dsr.app.upsample.checks import check_planes
from dsr.app.upsample.frames import find_frames
from dsr.app.upsample.request import UpsampleRequest
from dsr.data.detection import find_scenes
from dsr.geometry.camera import Camera
from dsr.geometry.poses import Matrix, invert
from dsr.io import inputs
from dsr.io.depth_files import read_depth_file
from dsr.sample import Scene
from dsr.synthetic.procedural.random_scene import RandomScene, make_camera, random_scene, render
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


def main() -> None:
    """Run the campaign of commands, or that of encodings."""
    words = sys.argv[1:]
    if words[:1] == ["encodings"]:
        encodings(words[1:])
    else:
        commands(words)


if __name__ == "__main__":
    main()

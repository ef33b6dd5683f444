# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""How often poses that are read wrongly are noticed, by the camera's motion and by what is wrong.

python docs/measurements/scripts/wrong_poses.py [--scenes 20] [--size 160] [--right]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from dsr.degradation.noise import Kinect
from dsr.geometry.camera import Camera
from dsr.geometry.poses import READINGS, Matrix, PosedMap, find_fault, invert, sample
from dsr.synthetic.procedural.random_scene import make_camera, random_scene


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
    parser = argparse.ArgumentParser(prog="wrong_poses.py", description=poses.__doc__)
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


if __name__ == "__main__":
    poses(sys.argv[1:])

"""Folders of a few small frames for ``dsr upsample``, and its results as values to compare."""

import json

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

FRAMES = 7


def write_frames(folder, count=FRAMES, *, holes=2):
    """Write frames of millimetres; the first maps are all holes, so that the unit is guessed from a later one."""
    rng = np.random.default_rng(0)
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for number in range(count):
        Image.fromarray(rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)).save(folder / "rgb" / f"{number:03}.png")
        depth = 500 + 900 * (number > holes) + np.arange(8)[None] * 10 + np.zeros((6, 1))
        Image.fromarray((depth * (number >= holes)).astype(np.uint16)).save(folder / "depth" / f"{number:03}.png")
    return folder


def results(output):
    """Return the content of all files of frames, by name, without times."""
    found = {}
    for path in sorted(output.rglob("*")):
        if path.is_file() and path.parent != output:
            content = path.read_bytes()
            if path.name == "info.json":
                content = {**json.loads(content), "seconds": None}
            found[str(path.relative_to(output))] = content
    return found


def room(camera, pose):
    """Return the depth, (H, W), of a room of 4 x 3 x 6 m with a ball in it, as a camera at a pose in it sees it."""
    rays = np.einsum("ij,jhw->ihw", pose[:3, :3], camera.rays().numpy())
    eye = pose[:3, 3]
    walls = [(np.where(rays[i] > 0, half, -half) - eye[i]) / rays[i] for i, half in enumerate((2.0, 1.5, 3.0))]
    to_ball = np.array([0.3, 0.2, 1.2]) - eye
    square, along = (rays**2).sum(0), np.einsum("i,ihw->hw", to_ball, rays)
    root = along**2 - square * (to_ball @ to_ball - 0.5**2)
    hit = np.where((root > 0) & (along > 0), (along - np.sqrt(np.maximum(root, 0))) / square, np.inf)
    return np.minimum(np.minimum.reduce(walls), hit)


def walk(count, step=0.08, turn=4.0):
    """Return poses of a camera that walks and turns through :func:`room`."""
    poses = []
    for number in range(count):
        pose = np.eye(4)
        angles = turn * number * np.array([0.4, 1.0, -0.5]) + (5, -20, 3)
        pose[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        pose[:3, 3] = step * number * np.array([0.8, -0.4, 0.5]) + (-0.6, 0.3, -1.0)
        poses.append(pose)
    return poses


def in_text(poses, pattern="{:.9f}"):
    """Return poses as a file has them, four lines of four numbers each."""
    return "".join(" ".join(pattern.format(value) for value in row) + "\n" for pose in poses for row in pose)


def write_recording(folder, camera, poses):
    """Write photos of twice the size of the depth maps of :func:`room`, in millimetres, and the camera's file."""
    rng = np.random.default_rng(0)
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for number, pose in enumerate(poses):
        depth = room(camera, pose) * (1 + 0.003 * rng.standard_normal((camera.height, camera.width)))
        photo = np.repeat(np.repeat((255 * depth / depth.max()).astype(np.uint8), 2, 0), 2, 1)
        Image.fromarray(np.stack([photo] * 3, -1)).save(folder / "rgb" / f"{number:03}.png")
        Image.fromarray(np.round(1000 * depth).astype(np.uint16)).save(folder / "depth" / f"{number:03}.png")
    of_photo = camera.rescale(2 * camera.width, 2 * camera.height)
    names = ("width", "height", "fx", "fy", "cx", "cy")
    (folder / "camera.json").write_text(json.dumps({name: getattr(of_photo, name) for name in names}))
    return folder

"""Small scenes and maps of closed form, for the tests of many methods."""

from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from dsr.data.scene_source import SceneSource
from dsr.degradation.downsampling import Downsampling, Kernel, make_sample
from dsr.geometry.camera import Camera, from_range, to_range
from dsr.sample import DepthSample, Scene
from dsr.synthetic.raycast import rotation

BALLS = [(-0.7, -0.4, 2.6, 0.4), (0.6, 0.3, 2.2, 0.35), (0.1, -0.7, 3.0, 0.3), (-0.5, 0.6, 2.4, 0.3)]


def sample_of(
    disparity: Tensor, rgb: Tensor | None = None, scale: int = 4, doffs: float = 0.0, kernel: Kernel = "box"
) -> DepthSample:
    """Return the problem of a scene with these disparities, (H, W)."""
    height, width = disparity.shape
    camera = Camera(width, height, 60.0, 55.0, 0.45 * width, 0.55 * height, doffs=doffs)
    rgb = torch.zeros(3, height, width) if rgb is None else rgb
    scene = Scene("set", "hall", rgb, camera, from_range(disparity[None], camera, "disparity"))
    return make_sample(scene, scale, Downsampling(kernel), "disparity")


class SceneList(SceneSource):
    """A data set to train on, of scenes in memory."""

    name, evaluation = "set", False

    def __init__(self, scenes: Iterable[Scene]) -> None:
        self._scenes = {scene.name: scene for scene in scenes}

    def load(self, scene: str) -> Scene:
        return self._scenes[scene]

    def fingerprint(self, scene: str) -> str:
        return scene


def seeded(seed: int = 0) -> torch.Generator:
    """Return a generator of its own."""
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int = 0) -> Tensor:
    """Return normally distributed numbers, float64."""
    return torch.randn(shape, generator=seeded(seed), dtype=torch.float64)


def grid(height: int, width: int) -> tuple[Tensor, ...]:
    """Return the row and the column of each pixel, (H, W) each."""
    return torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")


def plane(height: int = 32, width: int = 48) -> Tensor:
    """Return disparities of a plane, (H, W)."""
    v, u = grid(height, width)
    return 6 + 0.05 * u - 0.03 * v


def step(size: int = 32, column: int = 14) -> tuple[Tensor, Tensor]:
    """Return disparities with a step in the midst of a block, and a photo with an edge there."""
    near = torch.arange(size) >= column
    return torch.where(near, 8.0, 4.0).double().expand(size, size), near.float().expand(3, size, size)


def random_scene(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return random disparities, (H, W), and a random photo."""
    rng = np.random.default_rng(seed)
    rgb = torch.from_numpy(rng.uniform(0, 1, (3, height, width))).float()
    return torch.from_numpy(rng.uniform(3, 9, (height, width))), rgb


def disparity_of(depth: Tensor, sample: DepthSample) -> Tensor:
    """Return the disparities, (H, W), of a depth map, (1, H, W)."""
    return to_range(depth, sample.camera, "disparity")[0]


def photos(height: int, width: int, count: int = 1) -> Tensor:
    """Return random photos, (B, 3, H, W)."""
    return torch.rand((count, 3, height, width), generator=torch.Generator().manual_seed(1))


def maps(height: int, width: int, count: int = 1) -> Tensor:
    """Return random disparities, (B, 1, H, W)."""
    return 20 + 9 * torch.rand((count, 1, height, width), generator=torch.Generator().manual_seed(2)).double()


def sphere_depth(rays: Tensor, centre: ArrayLike, radius: float) -> Tensor:
    """Return the depth, (H, W), at which rays with z = 1, (3, H, W), meet a sphere; infinity where they miss it."""
    middle = torch.as_tensor(centre, dtype=torch.float64)[:, None, None]
    square, half = rays.square().sum(dim=0), (rays * middle).sum(dim=0)
    root = half.square() - square * (middle.square().sum() - radius**2)
    return torch.where(root > 0, (half - root.clamp(min=0).sqrt()) / square, torch.inf)


def problem(scale: float, height: int, width: int, doffs: float = 0.0) -> DepthSample:
    """Return the problem of a random low-resolution map of this size and a random photo, without the truth."""
    fine = round(scale * height), round(scale * width)
    camera = Camera(fine[1], fine[0], 600.0, 600.0, 3.0, 4.0, baseline=0.2, doffs=doffs)
    low = camera.rescale(width, height)
    depth = from_range(maps(height, width)[0] * (width / fine[1]), low, "disparity")
    return DepthSample("test", "scene", photos(*fine)[0], depth, camera, low, scale)


def plane_map(height: int, width: int, along_u: float = 0.3, along_v: float = -0.2) -> Tensor:
    """Return disparities of a plane, (1, 1, H, W)."""
    v, u = grid(height, width)
    return (30 + along_u * u + along_v * v)[None, None]


def room(camera: Camera, turn: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return depth, and which surface is where: a room of 4 x 3 x 4 m with four balls, turned by some degrees."""
    rays = camera.rays().numpy().reshape(3, -1)
    turned = rotation(turn, turn / 2, turn / 3) @ rays
    with np.errstate(divide="ignore"):
        walls = np.stack([limit / turned[axis] for axis, limit in ((0, 2), (0, -2), (1, 1.5), (1, -1.5), (2, 4))])
    hits = [np.where(walls > 0, walls, np.inf)]
    for *place, radius in BALLS:
        centre = np.array(place)
        square, half = (rays**2).sum(axis=0), centre @ rays
        root = half**2 - square * (centre @ centre - radius**2)
        hits.append(np.where(root > 0, (half - np.sqrt(np.maximum(root, 0))) / square, np.inf)[None])
    hits = np.concatenate(hits)
    shape = (camera.height, camera.width)
    return hits.min(axis=0).reshape(shape), hits.argmin(axis=0).reshape(shape)

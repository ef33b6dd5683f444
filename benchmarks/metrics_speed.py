"""All metrics of one 512 x 512 pair: dsr against scikit-image and numpy, float64, on the CPU; then LPIPS_v alone.

    python benchmarks/metrics_speed.py [--repeats 15] [--device cpu]

Both ways share what can be shared (normals and renderings are computed once) and take turns within the run; the ratio
of the medians is the result. The largest relative difference of their values is printed too. LPIPS_v, whose trunk has
random weights here, is compared with a pass for each image of each light, channel after channel in memory.
"""

from __future__ import annotations

import argparse
import copy
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from skimage.filters import scharr_h, scharr_v
from skimage.metrics import structural_similarity

from dsr.geometry.camera import Camera
from dsr.geometry.surface import lights
from dsr.metrics.catalogue import catalogue, score_image
from dsr.metrics.functional import BUMPINESS_DISPARITY, SurfacePair
from dsr.metrics.lpips import _CONVOLUTIONS, LPIPS, lpips_v

CAMERA = Camera(width=512, height=512, fx=618.0, fy=618.0, cx=255.5, cy=255.5)
THRESHOLDS = (1, 5, 10)


def surfaces() -> tuple[np.ndarray, np.ndarray]:
    """Return a wavy surface with a step, and a noisy version of it, (H, W) in metres."""
    v, u = np.mgrid[:512, :512] / 512
    target = 3 + 0.2 * np.sin(9 * u + 4 * v) + 0.1 * np.cos(23 * v) + 0.5 * (u > 0.6)
    return target + np.random.default_rng(0).normal(0, 0.004, target.shape), target


def numpy_normals(depth: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the normals, (H, W, 3), as PyData users would write it."""
    points = depth[..., None] * rays
    along_u = np.diff(points, axis=1)
    along_v = np.diff(points, axis=0)
    along_u = np.concatenate((along_u, along_u[:, -1:]), axis=1)
    along_v = np.concatenate((along_v, along_v[-1:]), axis=0)
    normals = np.cross(along_v, along_u)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def without_border(values: np.ndarray) -> np.ndarray:
    """Return a copy with the outermost pixel set to 0."""
    out = np.zeros_like(values)
    out[1:-1, 1:-1] = values[1:-1, 1:-1]
    return out


def numpy_bumpiness(prediction: np.ndarray, target: np.ndarray) -> float:
    """Return Bumpiness_d by scikit-image's filters."""
    difference = BUMPINESS_DISPARITY * (1 / prediction - 1 / target)
    first = [without_border(scharr_h(difference)), without_border(scharr_v(difference))]
    second = [without_border(derive(values)) for values in first for derive in (scharr_h, scharr_v)]
    return 100 * np.minimum(np.sqrt(sum(values**2 for values in second)), 0.05).mean()


def numpy_way(prediction: np.ndarray, target: np.ndarray, rays: np.ndarray) -> list[float]:
    """Return every metric in the order of the catalogue; per light e1..e4, the worst, the average."""
    lengths = np.linalg.norm(rays, axis=-1)
    error = np.abs(prediction - target) * lengths
    values = [np.sqrt(np.mean(error**2))]
    values += [np.mean(error > t / 100) for t in THRESHOLDS]
    values += [np.mean(error > t / 100 * target * lengths) for t in THRESHOLDS]
    normals = [numpy_normals(depth, rays) for depth in (prediction, target)]
    shadings = [n @ lights().numpy().T for n in normals]  # (H, W, 4)
    first, second = (np.clip(shading, 0, 1) for shading in shadings)

    def with_summary(by_light: np.ndarray) -> list[float]:
        return [*by_light, by_light.max(), by_light.mean()]

    for t in THRESHOLDS:
        values += with_summary((np.abs(first - second) > t / 255).mean(axis=(0, 1)))
    ssim = [structural_similarity(first[..., i], second[..., i], data_range=2) for i in range(4)]
    values += with_summary(1 - np.array(ssim))
    values.append(np.sqrt(np.mean((normals[0] - normals[1]) ** 2)))
    values += with_summary(np.sqrt(((shadings[0] - shadings[1]) ** 2).mean(axis=(0, 1))))
    values.append(numpy_bumpiness(prediction, target))
    return [float(value) for value in values]


def in_turns(ways: dict[str, Callable[[], list[float]]], repeats: int) -> None:
    """Print the median time of each way, its ratio to the first, and how far the values of the last are from its."""
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    values: dict[str, list[float]] = {}
    for turn in range(repeats + 1):
        for name, way in ways.items():
            start = time.perf_counter()
            values[name] = way()
            if turn:  # the first turn warms up
                seconds[name].append(time.perf_counter() - start)
    medians = {name: statistics.median(each) for name, each in seconds.items()}
    (first, *_), (*_, last) = ways, ways
    for name, median in medians.items():
        print(f"{name:<32}{1e3 * median:8.1f} ms{medians[first] / median:8.2f}x")
    worst = max(abs(a - b) / max(abs(b), 1e-3) for a, b in zip(values[last], values[first], strict=True))
    print(f"largest difference of {len(values[last])} values, relative: {worst:.1e}")


def random_trunk() -> dict[str, torch.Tensor]:
    """Return random weights for the trunk of LPIPS."""
    generator, weights = torch.Generator().manual_seed(0), {}
    for index, (inputs, outputs, kernel, _, _) in _CONVOLUTIONS.items():
        shape = (outputs, inputs, kernel, kernel)
        scale = (inputs * kernel**2) ** -0.5
        weights[f"features.{index}.weight"] = scale * torch.randn(shape, generator=generator)
        weights[f"features.{index}.bias"] = torch.zeros(outputs)
    return weights


def image_by_image(pair: SurfacePair, network: LPIPS) -> list[float]:
    """Return LPIPS_v of each light, with a pass of the trunk for each image."""
    images = [(2 * maps[0].float() - 1)[:, None].expand(-1, 3, -1, -1) for maps in pair.renderings]
    values = []
    for light in range(len(images[0])):
        first, second = (network.features(each[light : light + 1].contiguous()) for each in images)
        levels = [
            ((a - b).square() * getattr(network, f"head{level}")).sum(dim=1).mean()
            for level, (a, b) in enumerate(zip(first, second, strict=True))
        ]
        values.append(float(torch.stack(levels).sum()))
    return values


def main() -> None:
    """Time both ways and print their ratio."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--device", default="cpu", help="of dsr; NumPy stays on the CPU")
    options = parser.parse_args()
    repeats, device = options.repeats, torch.device(options.device)
    torch.set_num_threads(2)
    prediction, target = surfaces()
    rays = CAMERA.rays()
    tensors = [torch.from_numpy(values)[None].to(device) for values in (prediction, target)]
    device_rays = rays.to(device)
    numpy_rays = np.ascontiguousarray(rays.permute(1, 2, 0).numpy())
    metrics = catalogue()
    ours = lambda: [score.value for score in score_image(*tensors, device_rays, metrics)]  # noqa: E731
    theirs = lambda: numpy_way(prediction, target, numpy_rays)  # noqa: E731
    in_turns({"scikit-image and numpy": theirs, "dsr": ours}, repeats)
    pair = SurfacePair(*(each[:, None] for each in tensors), device_rays[None])
    _ = pair.renderings  # computed before
    network = LPIPS(random_trunk()).to(device)
    plain = copy.deepcopy(network).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]

    def one_pass() -> list[float]:
        return [float(value) for value in lpips_v(pair, network)[0]]

    with torch.inference_mode():
        in_turns({"LPIPS_v, image by image": lambda: image_by_image(pair, plain), "LPIPS_v": one_pass}, repeats)


if __name__ == "__main__":
    main()

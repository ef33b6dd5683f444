# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""What neighbouring frames gain: RMSE_v and flicker with 1, 3 and 5 frames, fused before or after the network.

    python docs/measurements/scripts/sequences.py [--size 192] [--scale 2] [--noise kinect] [--procedural 3] [--ddrnet DIR]
                                   [--picture FILE.jpg]

On SimGeo's solids, rendered from seven places along a path, with the noise of a simulated sensor and exact poses; on
procedural scenes likewise, whose relief is finer than the noise; and on the six frames of DDRNet's sensor, whose poses
are found by rigid alignment (ICP), as they have none. RMSE_v is that
of the paper; flicker is the standard deviation over three successive results of the depth of a point, in millimetres:
the median over the points that all three see. The input is the map itself, enlarged by cubic interpolation. On DDRNet's
frames the person moves, so flicker is of what ICP can align.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import mean
from typing import NamedTuple

import cv2
import numpy as np
import torch
from scipy.ndimage import uniform_filter
from torch import Tensor

from dsr.data.ddrnet_frames import DDRNetFrames
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.degradation.noise import Kinect, Noise, TimeOfFlight
from dsr.geometry.camera import Camera
from dsr.geometry.poses import Matrix, relative
from dsr.geometry.resampling import warp_depth
from dsr.geometry.surface import depth_to_normals
from dsr.geometry.surface import render as render_lights
from dsr.inference import upsample_surface
from dsr.inference.sequences import View, fuse_views
from dsr.methods.base import Surface
from dsr.metrics.functional import SurfacePair, rmse_v
from dsr.metrics.sensor import SensorComparison
from dsr.sample import Scene
from dsr.synthetic.procedural.random_scene import make_camera, random_scene, render
from dsr.synthetic.raycast import shade
from dsr.synthetic.simgeo import build_scene

NOISES: dict[str, Callable[[], Noise]] = {"kinect": Kinect, "tof": TimeOfFlight}
SOLIDS = ("cube_no_texture", "cube_high_freq", "sphere_cylinder_low_freq", "sphere_cylinder_high_freq")
FRAMES, RESULTS = 7, 3
"""Frames that are rendered, and those in the middle whose results are compared."""
STEP = 0.03
"""Distance of successive camera positions as a fraction of the distance to what they look at."""


class Frame(NamedTuple):
    """A photo, (3, H, W), a depth map, (1, h, w), and the truth, (1, H, W), with camera and pose; metres."""

    rgb: Tensor
    depth_lr: Tensor
    camera: Camera
    pose: Matrix
    truth: Tensor

    @property
    def view(self) -> View:
        """The depth map as a view."""
        height, width = self.depth_lr.shape[-2:]
        return View(self.depth_lr, self.camera.rescale(width, height), self.pose)


def places(right: Matrix, down: Matrix, forward: Matrix, distance: float) -> list[Matrix]:
    """Return camera positions along a curve past a point ``distance`` ahead, relative to the middle one."""
    steps = [(number - FRAMES // 2) * STEP * distance for number in range(FRAMES)]
    return [step * (0.9 * right + 0.3 * forward) + 0.2 * abs(step) * down for step in steps]


def make_frame(name: str, rgb: Tensor, depth: Matrix, camera: Camera, pose: Matrix, scale: int, noise: Noise) -> Frame:
    """Return a rendered frame with the map of a simulated sensor."""
    scene = Scene("path", name, rgb, camera, torch.from_numpy(depth)[None])
    sample = make_sample(scene, scale, Downsampling("box"), "disparity", noise)
    if sample.depth is None:
        raise ValueError(f"{name}: expected a true depth")
    return Frame(sample.rgb, sample.depth_lr.float(), sample.camera, pose, sample.depth)


def solids(name: str, size: int, scale: int, noise: Noise) -> list[Frame]:
    """Return one of SimGeo's scenes as a camera on a path sees it."""
    world, camera, target = build_scene(name), Camera.from_fov(38, size, size), np.array([0.0, 0.0, 3.1])
    frames = []
    for number, eye in enumerate(places(*np.eye(3), float(target[2]))):
        forward = (target - eye) / np.linalg.norm(target - eye)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        axes = np.stack((right, np.cross(forward, right), forward))
        rays = axes.T @ camera.rays().numpy().reshape(3, -1)
        hits = np.stack([body.surface.intersect(np.tile(eye[:, None], rays.shape[1]), rays) for body in world.bodies])
        index, depth = hits.argmin(0), hits.min(0)
        linear = shade(world, eye[:, None] + depth * rays, index, world.lights[:, ::9])
        rgb = torch.from_numpy(linear.clip(0, 1) ** (1 / 2.2)).float().view(3, size, size)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = axes.T, eye
        frames.append(make_frame(f"{name}-{number}", rgb, depth.reshape(size, size), camera, pose, scale, noise))
    return frames


def rendered(index: int, size: int, scale: int, noise: Noise) -> list[Frame]:
    """Return a procedural scene as a camera on a path sees it."""
    scene = random_scene(np.random.default_rng(np.random.SeedSequence([77, index])))
    view = scene.viewpoint
    frames = []
    for number, place in enumerate(places(*view.axes(), float(np.linalg.norm(view.target - view.eye)))):
        moved = replace(view, eye=view.eye + place, roll=view.roll + 0.5 * number)
        made = render(replace(scene, viewpoint=moved, seed=scene.seed + number), size)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = moved.axes().T, scene.metres * moved.eye
        rgb = torch.from_numpy(made.rgb).permute(2, 0, 1).float() / 255
        frames.append(make_frame(f"{index}-{number}", rgb, made.depth, make_camera(moved, size), pose, scale, noise))
    return frames


def window(frames: Sequence[Frame], place: int, count: int) -> list[Frame]:
    """Return the frames nearest to one, itself first."""
    order = sorted(range(len(frames)), key=lambda number: (abs(number - place), number))
    return [frames[number] for number in order[:count]]


def before(frames: Sequence[Frame], method: str, device: str) -> Tensor:
    """Return the result of the first frame, from its depth map fused with those of the others."""
    depth_lr = fuse_views(frames[0].view, [frame.view for frame in frames[1:]]).depth
    return upsample_surface(frames[0].rgb, depth_lr, frames[0].camera, method=method, device=device).depth


def after(frames: Sequence[Frame], results: Sequence[Surface]) -> Tensor:
    """Return the result of the first frame, fused with those of the others."""
    views = [View(result.depth, frame.camera, frame.pose, result.depth_error)
             for frame, result in zip(frames, results, strict=True)]  # fmt: skip
    return fuse_views(views[0], views[1:]).depth


def flicker(results: Sequence[Tensor], frames: Sequence[Frame]) -> float:
    """Return the median standard deviation of the depth of points over successive results, in millimetres."""
    middle = frames[len(frames) // 2]
    seen = [
        warp_depth(result[None].double(), frame.camera, torch.from_numpy(relative(frame.pose, middle.pose))[None],
                   middle.camera)
        for result, frame in zip(results, frames, strict=True)
    ]  # fmt: skip
    stack = torch.cat(seen)
    near = (stack.amax(0) - stack.amin(0)) < 0.05 * stack.amin(0)  # not a surface that hides another
    return 1e3 * float(stack.std(0)[near & stack.isfinite().all(0)].median())


def enlarged(frame: Frame) -> Tensor:
    """Return a frame's own map at the photo's size, (1, H, W)."""
    size = (frame.camera.width, frame.camera.height)
    return torch.from_numpy(cv2.resize(frame.depth_lr[0].numpy(), size, interpolation=cv2.INTER_CUBIC))[None]


def score(result: Tensor, frame: Frame, *, measured: bool) -> float:
    """Return RMSE_v; for a measured truth over the pixels that :mod:`dsr.metrics.sensor` scores."""
    truth = frame.truth.double()
    pair = SurfacePair(
        result.double().nan_to_num(float(truth.nanmedian()))[None], truth[None], frame.camera.rays()[None]
    )
    if measured:
        compared = SensorComparison(pair)
        surfaces = compared.surfaces
        prediction, target = surfaces.given
        pair = SurfacePair(prediction, target, frame.camera.rays()[None], compared.scored)
    return float(rmse_v(pair))


def measure(frames: Sequence[Frame], method: str, device: str, *, measured: bool) -> dict[str, tuple[float, float]]:
    """Return RMSE_v and flicker by the way of fusing."""
    middle = range((len(frames) - RESULTS) // 2, (len(frames) - RESULTS) // 2 + RESULTS)
    singles = [upsample_surface(f.rgb, f.depth_lr, f.camera, method=method, device=device) for f in frames]
    ways: dict[str, list[Tensor]] = {
        "input": [enlarged(frames[place]) for place in middle],
        "1 frame": [singles[place].depth for place in middle],
    }
    for count in (3, 5):
        groups = [window(frames, place, count) for place in middle]
        ways[f"{count} frames, before"] = [before(group, method, device) for group in groups]
        numbers = [[next(i for i, f in enumerate(frames) if f is frame) for frame in group] for group in groups]
        ways[f"{count} frames, after"] = [
            after(group, [singles[number] for number in each]) for group, each in zip(groups, numbers, strict=True)
        ]
    centres = [frames[place] for place in middle]
    return {
        name: (
            float(np.mean([score(r, f, measured=measured) for r, f in zip(results, centres, strict=True)])),
            flicker(results, centres),
        )
        for name, results in ways.items()
    }


def aligned(depth: Tensor, camera: Camera, target: Tensor, start: Matrix, passes: int = 25) -> tuple[Matrix, float]:
    """Return the rigid transform from one depth map, (1, H, W), to another, and the median distance left in mm.

    Point-to-plane ICP with projective association (Chen and Medioni 1992; Blais and Levine 1995).
    """
    rays = camera.rays()
    points = target.double() * rays  # (3, H, W)
    known = target[0].isfinite().numpy()
    values, share = (
        uniform_filter(each, 5) for each in (target[0].double().nan_to_num(0).numpy(), known.astype(float))
    )
    smooth = torch.from_numpy(np.where(share > 0.9, values / np.maximum(share, 0.1), np.nan))[None]
    normals = depth_to_normals(smooth[None], rays[None])[0]
    source = (depth.double() * rays)[:, ::4, ::4].flatten(1)
    source = source[:, source.isfinite().all(0)]
    move, left = torch.from_numpy(start), torch.tensor(0.0)
    for number in range(passes):
        p = move[:3, :3] @ source + move[:3, 3:]
        u = (camera.fx * p[0] / p[2] + camera.cx).round().long()
        v = (camera.fy * p[1] / p[2] + camera.cy).round().long()
        inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        q, n = (each[:, v[inside], u[inside]] for each in (points, normals))
        p = p[:, inside]
        limit = 0.1 if number < 10 else 0.02
        good = (q - p).isfinite().all(0) & n.isfinite().all(0) & ((q - p).norm(dim=0) < limit)
        p, q, n = p[:, good], q[:, good], n[:, good]
        gap = (n * (q - p)).sum(0)
        rows = torch.cat((torch.linalg.cross(p, n, dim=0), n)).T
        twist = torch.linalg.lstsq(rows, gap[:, None]).solution[:, 0]
        generator = torch.zeros(4, 4, dtype=torch.float64)
        x, y, z = twist[:3]
        generator[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
        generator[:3, 3] = twist[3:]
        move = torch.linalg.matrix_exp(generator) @ move
        left = gap.abs().median()
    return move.numpy(), 1e3 * float(left)


def ddrnet(folder: Path) -> list[Frame]:
    """Return DDRNet's frames with poses by alignment with the frame before."""
    source = DDRNetFrames(str(folder), "found")
    frames: list[Frame] = []
    pose = np.eye(4)
    for name in source.scenes():
        scene = source.load(name)
        depth_lr = scene.measured[1].float()
        if frames:
            step, left = aligned(depth_lr, scene.camera, frames[-1].depth_lr, np.eye(4))
            pose = frames[-1].pose @ step
            angle = np.degrees(np.arccos(np.clip((np.trace(step[:3, :3]) - 1) / 2, -1, 1)))
            print(f"  {name}: {1e3 * np.linalg.norm(step[:3, 3]):.0f} mm, {angle:.1f} degrees, {left:.1f} mm left")
        frames.append(Frame(scene.rgb, depth_lr, scene.camera, pose, scene.depth))
    return frames


def draw(path: Path, frames: Sequence[Frame], method: str, device: str) -> None:
    """Draw the photo, the results of 1 and 5 frames and the truth, lit from above."""
    centre = frames[len(frames) // 2]
    group = window(frames, len(frames) // 2, 5)
    depths = (before(group[:1], method, device), before(group, method, device), centre.truth.float())
    rays = centre.camera.rays()[None]
    lit = [render_lights(depth_to_normals(depth[None].double(), rays))[0, 0].clamp(0, 1).numpy() for depth in depths]
    photo = centre.rgb.permute(1, 2, 0).numpy()[..., ::-1]
    panels = [photo, *(np.repeat(each[..., None], 3, axis=2) for each in lit)]
    titled = []
    for panel, title in zip(panels, ("photo", "1 frame", "5 frames", "truth"), strict=True):
        picture = cv2.resize((255 * panel).astype(np.uint8), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
        bar = np.full((28, picture.shape[1], 3), 255, np.uint8)
        cv2.putText(bar, title, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
        titled.append(np.vstack((bar, picture)))
    cv2.imwrite(str(path), np.hstack(titled), [cv2.IMWRITE_JPEG_QUALITY, 88])


def show(found: dict[str, tuple[float, float]]) -> None:
    """Print a table."""
    single = found["1 frame"][0]
    for name, (error, moved) in found.items():
        print(f"  {name:18s} RMSE_v {error:.4f} ({error / single - 1:+.0%})   flicker {moved:.2f} mm")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=192)
    parser.add_argument("--scale", type=int, default=2)
    parser.add_argument("--noise", choices=NOISES, default="kinect")
    parser.add_argument("--procedural", type=int, default=3, help="number of procedural scenes")
    parser.add_argument("--method", default="facets")
    shared = Path(os.environ.get("DSR_SHARED", "../shared"))
    parser.add_argument("--ddrnet", type=Path, default=shared / "real" / "ddrnet")
    parser.add_argument("--picture", type=Path, help="draw one scene, and measure nothing")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    noise = NOISES[arguments.noise]()
    if arguments.picture:
        frames = solids(SOLIDS[-1], arguments.size, arguments.scale, noise)
        draw(arguments.picture, frames, arguments.method, arguments.device)
        return
    made: dict[str, list[Callable[[], list[Frame]]]] = {
        "SimGeo's solids": [partial(solids, name, arguments.size, arguments.scale, noise) for name in SOLIDS],
        "procedural scenes": [
            partial(rendered, index, arguments.size, arguments.scale, noise) for index in range(arguments.procedural)
        ],
    }
    for group, makers in made.items():
        found = [measure(make(), arguments.method, arguments.device, measured=False) for make in makers]
        if found:
            print(f"{group}, {len(found)}, x{arguments.scale}, noise={arguments.noise}", flush=True)
            show({name: (mean(each[name][0] for each in found), mean(each[name][1] for each in found))
                  for name in found[0]})  # fmt: skip
    if arguments.ddrnet.is_dir():
        print("DDRNet's sensor")
        show(measure(ddrnet(arguments.ddrnet), arguments.method, arguments.device, measured=True))


if __name__ == "__main__":
    main()

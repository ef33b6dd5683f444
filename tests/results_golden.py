"""Results of the package's own code, to notice when they change: ``python tests/results_golden.py``.

Every method upsamples at each kind of ratio, with holes, with noise and from maps of sensors; low-resolution maps,
training patches, losses and prepared scenes are made, too. Of each map the means and standard deviations of 6 x 6
blocks are kept. Whether they are right is for other tests to say; these are the results that
:data:`dsr.utils.versions.RESULTS` and :data:`~dsr.utils.versions.SCENES` stand for.
"""

import hashlib
import math
import os
import sys
import tempfile
import warnings
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import torch
from methods_at_hand import AT_HAND
from reference_metrics import Intrinsics
from small_scenes import seeded
from torch import Tensor

import dsr
from dsr.data.reference_depth import fit, inpaint_depth
from dsr.data.rendered import Procedural, SimGeo
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.degradation.holes import Blobs, Shadows
from dsr.degradation.noise import GaussianMultiplicative, Kinect, TimeOfFlight
from dsr.degradation.random_degradation import Everything
from dsr.geometry.registration import find_displacement, undo
from dsr.geometry.resampling import warp_depth
from dsr.inference.any_ratio import upsample_surface
from dsr.inference.sequences import View, fuse_views
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.recipe import Known, Run, read_recipe
from dsr.methods.weights import packaged_names, packaged_weights
from dsr.sample import Scene
from dsr.training.degradation import Degradation
from dsr.training.module import SuperResolution
from dsr.training.objective import DepthObjective, SurfaceObjective
from dsr.training.patches import Patches
from dsr.training.settings import PatchSettings
from dsr.utils import compute_device
from dsr.utils.versions import RESULTS, SCENES, file_hash

FILE = Path(__file__).resolve().parent / "golden" / "results.npz"
INTRINSICS = Intrinsics(80.0, 76.0, 30.2, 33.1)
TOLERANCE = 1e-4  # Relative: processors round differently
_LOOSE = {"dip": 0.1, "srfs": 0.01, "pdn": 1e-3, "facets": 5e-4, "bicubic 2": 5e-4, "loss mse": 5e-4}
"""Tolerances by how names begin, where iterations, levels of a photo or errors' own errors make more of roundings."""
SIZES = {"1": 64, "1.07": 60, "1.23": 52, "1.4": 46, "2": 32, "2.06": 31, "2.67": 24, "4": 16, "8": 8, "16": 4}
"""Sizes of the low-resolution map by the ratio of the sizes."""
_NOISY = ("1.4", "2.67", "8")
_EVERYWHERE = ("facets", "msg_v", "bicubic", "bilateral", "guided_filter", "tgv")
_NETWORKS = ("msg", "pdn", "dg", "ddrnet", "sparse_to_dense", "facets_box", "dip", "dip_v", "eg", "srfs")
"""Methods that are run at all ratios, and at those of networks alone, the last ones because they are slow."""
_BLOCKS = 6


def upsampling():
    """Yield upsampled maps and their expected errors: each method at each ratio, and what the options change."""
    for method in AT_HAND:
        settings = {"steps": 2} if method.startswith("dip") else {}
        settings |= {"iterations": 30} if method == "tgv" else {"iterations": 4} if method == "srfs" else {}
        errors = method in ("facets", "bicubic", "msg_v")
        some = SIZES if method in _EVERYWHERE else ("2.67", "4") if method in _NETWORKS else ("1.4", "2.67", "8")
        for ratio in ("2", "4") if method == "msg_v_noisy" else some:
            yield f"{method} {ratio}", partial(_upsampled, ratio, method, errors=errors, **settings)
    for method in ("dip", "dip_v"):
        yield f"one step of {method}", partial(_upsampled, "4", method, steps=1)
    for ratio in ("1", "2", "4", "8"):
        for method in ("facets", "msg_v", "guided_filter"):
            yield f"{method} {ratio} scale=4", partial(_upsampled, ratio, method, scale=4)
    for more in ({"fill": "none"}, {"fill": "all"}, {"max_hole": 8}, {"clean": True}, {"noise": 0.01}, {"smooth": 0},
                 {"smooth": 2}, {"edges": "soft"}, {"kernel": "bicubic"}, {"max_error": 0.02},
                 {"noise": 0.01, "noise_growth": 2.0}):  # fmt: skip
        yield f"facets {more}", partial(_upsampled, "4", "facets", **more)
    for method in ("facets", "msg_v"):
        yield f"{method} repeated", partial(_repeated, method)
    for scale in (2, 4, 8, 16):
        yield f"facets told x{scale}", partial(_hinted, scale)
    for size in (1.15, 1.35, 1.5):
        yield f"nearly own size {size}", partial(_of_size, round(64 / size))


def _upsampled(ratio, method, *, errors=False, **more):
    """Return the upsampled map of a ratio, perhaps with its expected errors."""
    found = dsr.Upsampler(method, device="cpu", **more)(_photo(), _given(ratio), _camera())
    return [found.depth, found.depth_error, found.angle_error] if errors else found.depth


def _of_size(size):
    """Return the upsampling of a map of some size by a method that averages maps of the photo's size first."""
    return dsr.upsample(_photo(), _reduced(size), _camera(), method="guided_filter", device="cpu")


def _repeated(method):
    """Return the upsampling of a map that was enlarged by repeating pixels."""
    large = np.kron(_given("4"), np.ones((4, 4), np.float32))
    return dsr.upsample(_photo(), large, _camera(), method=method, device="cpu")


def _hinted(scale):
    """Return what facets makes of block means that it knows to be some."""
    method = read_recipe("facets").build(scale, Run(known=Known("box", "sharp", clean=True)))
    return method(make_sample(_scene(), scale, Downsampling("box"), method.range_type))


def sensors():
    """Yield upsampled maps of sensors: with noise of some extent, rounded, with outliers and with glass."""
    rgb = torch.from_numpy(cv2.resize(_photo(), (192, 144))).permute(2, 0, 1) / 255
    camera = dsr.Camera(192, 144, 180.0, 180.0, 95.5, 71.5)
    large, large_rgb = camera.rescale(384, 288), rgb.repeat_interleave(2, 1).repeat_interleave(2, 2)
    slanted = (0.4 + 0.001 * torch.arange(192) + 0.0007 * torch.arange(144)[:, None]).double().reciprocal()[None]

    def surface(extent, step=None, **more):
        given = (_waves(extent) if step is None else (slanted / step).round() * step).float()
        found = upsample_surface(rgb, given, camera, method="facets", device="cpu", **more)
        return [found.depth, found.depth_error, found.angle_error]

    yield "working size of a smaller map", lambda: upsample_surface(large_rgb, _waves(12).float(), large).depth
    for extent in (3, 12, 20):
        yield f"working size of {extent} pixels", partial(surface, extent)
    for step in (0.02, 0.001, 0.0005):
        yield f"rounded to {step} m", partial(surface, 1, step)
    yield "working size 4", partial(surface, 3, working_size=4)
    yield "RealSense D435", partial(surface, 12, sensor="RealSense D435")
    yield "PrimeSense", partial(surface, 12, sensor="Kinect v1")
    yield "Azure Kinect", partial(surface, 3, sensor="Azure Kinect")
    speckled = _waves(1).clone()
    speckled[:, 40:44, 60:64] = 0.2
    speckled[:, 100:103, 20:24] = 30
    yield "outliers left out", lambda: upsample_surface(rgb, speckled.float(), camera, method="bicubic").depth


def samples():
    """Yield low-resolution maps: of each downsampling model, noise and kind of holes."""
    scene, box = _scene(), Downsampling("box")
    for kernel in ("box", "nearest", "bilinear", "bicubic", "gaussian"):
        for kind in ("disparity", "orthogonal", "perspective"):
            yield f"{kernel} of {kind}", partial(_low, scene, 4, Downsampling(kernel), kind)
    large = _large_scene()
    holes = torch.rand((1, 192, 192), generator=seeded(0)) < 0.5
    holey = replace(large, depth=large.depth.masked_fill(holes, torch.nan))
    for kernel in ("box", "bicubic", "gaussian"):
        yield f"{kernel} of holes", partial(_low, holey, 4, Downsampling(kernel), "disparity")
    for noise in (GaussianMultiplicative(0.01), TimeOfFlight(), Kinect()):
        yield f"noise {type(noise).__name__}", partial(_low, large, 2, box, "disparity", noise)
    for name, kind in (("blobs", Blobs()), ("shadows", Shadows())):
        yield f"holes {name}", partial(_low, large, 2, box, "disparity", holes=kind)


def _low(*given, **more):
    return make_sample(*given, **more).depth_lr


def training():
    """Yield training patches, losses and the sizes of their gradients."""
    settings = PatchSettings(patch=48, batch=2)
    degradation = Degradation(4, Downsampling("box"))
    plain = Patches([[_large_scene()]], settings, degradation)
    drawn = Patches([[_large_scene()]], settings, degradation, everything=Everything())
    keys = ("depth", "disparity_lr", "rgb")
    for number in range(4):
        for name, patches in (("patch", plain), ("drawn patch", drawn)):
            yield f"{name} {number}", lambda p=patches, n=number: [p[n][key] for key in keys]
    many = Patches([[_large_scene()]], settings, degradation, everything=Everything(soft=1))
    yield "many drawn patches", lambda: torch.stack([many[n]["disparity_lr"].nanmean() for n in range(48)])
    yield "loss lap1", partial(_loss, DepthObjective(w=1.0), plain)
    yield "loss mse", partial(_loss, DepthObjective("mse", shading=1.0), plain)
    yield "loss surface", partial(_loss, SurfaceObjective(), drawn)


def _loss(objective, patches):
    """Return the terms of a loss and the norm of its gradient, and the network's weights after a step."""
    torch.manual_seed(0)
    net = FacetsUNet(4) if isinstance(objective, SurfaceObjective) else MSGNet(4)
    module = SuperResolution(net, objective)
    batch = torch.utils.data.default_collate([patches[0], patches[1]])
    terms = module.loss_terms(batch)
    terms["loss"].backward()
    norms = [p.grad.norm() for p in module.net.parameters() if p.grad is not None]
    return [torch.stack([value.detach() for value in terms.values()]), torch.stack(norms)]


def several():
    """Yield what several cameras and frames lead to: warped depth, frames that vote, a displacement that is undone."""
    scene, large, camera = _scene(), _large_scene(), _camera()
    moved = torch.eye(4, dtype=torch.float64)
    moved[0, 3], moved[2, 3] = 0.1, 0.05
    for name, each in (("", scene.depth), (" stairs", _stairs())):
        yield f"warped{name}", lambda each=each: warp_depth(each[None], camera, moved[None], camera)[0]
    noisy = [scene.depth * (1 + 0.002 * torch.randn(64, 64, generator=seeded(seed))) for seed in range(3)]
    views = [View(each, camera, np.linalg.matrix_power(moved.numpy(), number)) for number, each in enumerate(noisy)]
    yield "frames that vote", lambda: fuse_views(views[0], views[1:]).depth
    for shift, larger in ((5, 1.0), (0, 1.01), (0, 1.03), (3, 1.02)):
        yield f"displacement {shift}, {larger}", lambda shift=shift, larger=larger: _displaced(large, shift, larger)


def _displaced(scene, shift, larger):
    """Return a map that is moved and magnified, after the displacement that is found of it is undone."""
    size = round(192 * larger)
    depth = torch.nn.functional.interpolate(scene.depth[None], (size, size), mode="nearest-exact")
    start = (size - 192) // 2
    moved = depth[..., start : start + 192, start : start + 192].roll((3, shift), (2, 3))
    depth_lr = torch.nn.functional.avg_pool2d(moved, 2)[0]
    found = find_displacement(depth_lr, scene.rgb)
    return depth_lr if found is None else undo(depth_lr, found)


def scenes():
    """Yield the name and the function of each prepared scene."""
    scene = _scene()
    depth = scene.depth.clone()
    depth[:, 20:31, 24:43] = torch.nan
    holey = replace(scene, depth=depth)
    for size in (24, 48, 64, 90):
        yield f"fit {size}", lambda size=size: fit(holey, size).depth
        yield f"fit {size} rgb", lambda size=size: fit(holey, size).rgb
    wide = scene.crop(0, 0, 40, 64)
    yield "fit left", lambda: fit(wide, 32, 0.0).depth
    yield "fit whole", lambda: fit(wide, 32, None).depth
    stairs = replace(scene, depth=_stairs().masked_fill(depth.isnan(), torch.nan))
    for each in (holey, stairs):
        yield f"inpainted {each is stairs}", lambda each=each: inpaint_depth(each.depth)
    for size in (48, 80):
        yield f"stairs at {size}", lambda size=size: fit(stairs, size).depth
    for source in (SimGeo(size=64), Procedural(count=2, size=64)):
        for name in source.scenes():
            yield f"{source.name} {name}", lambda source=source, name=name: source.load(name).depth
            yield f"{source.name} {name} rgb", lambda source=source, name=name: source.load(name).rgb


_FILES = [file for name in packaged_names() if (file := packaged_weights(name)) is not None]
WEIGHTS = hashlib.sha256("".join(map(file_hash, _FILES)).encode()).hexdigest()[:16]
VERSIONS = {"RESULTS": RESULTS, "SCENES": SCENES, "WEIGHTS": WEIGHTS}
GROUPS = {
    "upsampling": ("RESULTS", upsampling), "sensors": ("RESULTS", sensors), "samples": ("RESULTS", samples),
    "training": ("RESULTS", training), "several": ("RESULTS", several), "scenes": ("SCENES", scenes),
}  # fmt: skip
"""Which version each group of results has."""


@cache
def _scene():
    """Return a wall, a floor and a ball, 64 x 64, traced in closed form without the package; grain in the photo."""
    rays = INTRINSICS.rays(64, 64)
    wall = 3.2 / (rays @ np.array([0.2, 0.0, 1.0]))
    downward = rays[..., 1]
    floor = np.where(downward > 0, 0.7 / np.where(downward > 0, downward, 1.0), np.inf)
    centre = np.array([0.1, 0.15, 2.2])
    along, squared = rays @ centre, (rays**2).sum(axis=-1)
    root = along**2 - squared * (centre @ centre - 0.45**2)
    ball = np.where(root > 0, (along - np.sqrt(np.maximum(root, 0))) / squared, np.inf)
    depths = np.stack((wall, floor, ball))
    depth, body = depths.min(axis=0), depths.argmin(axis=0)
    x, _, z = np.moveaxis(depth[..., None] * rays, -1, 0)
    checks = (np.floor(4 * x) + np.floor(4 * z)) % 2
    colours = np.array([[180, 170, 150], [120, 90, 60], [60, 110, 190]])[body]
    rgb = (colours - 30 * checks[..., None]).astype(np.uint8)
    grain = np.random.default_rng(0).normal(0, 6, (64, 64, 1))
    pixels = torch.from_numpy(np.clip(rgb + grain, 0, 255).astype(np.uint8)).permute(2, 0, 1) / 255
    true = torch.from_numpy(depth.astype(np.float32).astype(np.float64))[None]
    return Scene("golden", "small", pixels, _camera(), true)


def _photo():
    """Return the photo as bytes, (64, 64, 3)."""
    return (_scene().rgb * 255).round().byte().permute(1, 2, 0).numpy()


def _camera():
    return dsr.Camera(64, 64, *INTRINSICS)


@cache
def _reduced(size):
    """Return means of inverse depth over the pixels of a smaller map, as depth."""
    edges = np.arange(size + 1) * (64 / size)
    low, high = edges[:-1, None], edges[1:, None]
    pixels = np.arange(64)
    weights = np.clip(np.minimum(high, pixels + 1) - np.maximum(low, pixels), 0, None) / (high - low)
    depth = _scene().depth
    return (1 / (weights @ (1 / depth[0].numpy()) @ weights.T)).astype(np.float32)


@cache
def _given(ratio):
    """Return the map of a ratio, with holes, and with noise at some ratios."""
    size = SIZES[ratio]
    depth = _reduced(size).copy()
    random = np.random.default_rng(size)
    if ratio in _NOISY:
        depth *= 1 + 0.01 * random.standard_normal(depth.shape).astype(np.float32)
    if size > 4:
        depth[size // 2 : size // 2 + max(1, size // 6), size // 4 : size // 4 + max(1, size // 5)] = np.nan
        depth[random.random(depth.shape) < 0.02] = np.nan
    return depth


def _waves(extent):
    """Return depth of a floor, a wall and a box, (1, 144, 192), with noise that is alike over ``extent`` pixels."""
    v, u = np.mgrid[:144, :192].astype(np.float64)
    inverse = np.where(v > 96, 0.4 + 0.003 * (v - 96), 0.4 + 0.0003 * u)
    inverse = np.where((u > 20) & (u < 60) & (v > 24) & (v < 120), 0.9 - 0.0005 * v, inverse)
    random = np.random.default_rng(0)
    noise = random.standard_normal(inverse.shape)
    if extent > 1:
        noise = cv2.GaussianBlur(noise, (0, 0), extent / 2.355 / math.sqrt(2))
    inverse *= 1 + 0.004 * noise / noise.std()
    return torch.from_numpy(1 / inverse)[None]


@cache
def _large_scene():
    """Return a scene of 192 x 192 pixels: surfaces with and without depth steps between them, and a photo of them."""
    v, u = np.mgrid[:192, :192].astype(np.float64)
    depth = np.where(v > 130, 240 / (v + 1), 240 / 131 + 0.001 * (130 - v))
    ball = 40**2 - (u - 70) ** 2 - (v - 90) ** 2
    depth = np.where(ball > 0, 1.3 - 0.005 * np.sqrt(np.maximum(ball, 0)), depth)
    depth = np.where((u > 120) & (u < 170) & (v > 30) & (v < 150), 0.9 + 0.002 * (u - 120), depth)
    random = np.random.default_rng(1)
    colour = 0.3 + 0.4 * np.stack([depth / depth.max(), np.sin(u / 9) / 4 + 0.5, np.cos(v / 13) / 4 + 0.5])
    rgb = np.clip(colour + random.normal(0, 0.01, colour.shape), 0, 1)
    camera = dsr.Camera(192, 192, 190.0, 190.0, 95.5, 95.5)
    return Scene("golden", "large", torch.from_numpy(rgb).float(), camera, torch.from_numpy(depth)[None])


def _stairs():
    """Return depth, (1, 64, 64), with steps of 0.3 to 14 % along both axes, between surfaces that slope."""
    steps = np.cumsum(np.where(np.arange(64) % 4 == 0, np.linspace(0.003, 0.12, 64), 0.001))
    down = np.cumsum(np.where(np.arange(64) % 8 == 0, np.linspace(0.02, 0.005, 64), 0.0005))
    return torch.from_numpy(np.exp(0.5 + steps - down[:, None]))[None]


def compute(jobs):
    """Return the summary of each result, in float32 also where bfloat16 is faster."""
    found = {}
    with mock.patch.object(compute_device, "_FAST_ON_CPU", ()):
        for name, job in jobs:
            parts = job()
            for number, part in enumerate(parts if isinstance(parts, list) else [parts]):
                found[f"{name}, {number}" if number else name] = summary(part)
    return found


def summary(values):
    """Return the means and standard deviations of the known values of 6 x 6 blocks, and the share of known values.

    Of one row of numbers, these.
    """
    found = np.asarray(values.detach() if isinstance(values, Tensor) else values, dtype=np.float64)
    if found.ndim < 2:
        return found.astype(np.float32)
    rows, columns = (np.array_split(np.arange(n), min(n, _BLOCKS)) for n in found.shape[-2:])
    blocks = [found[..., r[0] : r[-1] + 1, c[0] : c[-1] + 1] for r in rows for c in columns]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of blocks without a known value
        parts = [np.array([function(each) for each in blocks]) for function in (np.nanmean, np.nanstd)]
    return np.concatenate([*parts, [np.isfinite(found).mean()]]).astype(np.float32)


def differing(before, now):
    """Return the names of results that differ, with how much."""
    lines = [f"{name}: {'new' if name in now else 'missing'}" for name in sorted(before.keys() ^ now.keys())]
    for name in (name for name in before if name in now):
        old, new = before[name].astype(np.float64), now[name].astype(np.float64)
        if old.shape != new.shape or not np.array_equal(np.isnan(old), np.isnan(new)):
            lines.append(f"{name}: other sizes or holes")
            continue
        size = np.abs(old) if len(old) < _BLOCKS**2 else np.maximum(np.abs(old), np.nanmean(np.abs(old)))
        off = np.nan_to_num(np.abs(new - old) / np.maximum(size, 1e-9))
        tolerance = next((each for method, each in _LOOSE.items() if name.startswith(method)), TOLERANCE)
        if off.size and off.max() > tolerance:
            lines.append(f"{name}: off by {off.max():.1e} at most")
    return lines


def read():
    """Return the versions in the file, and the results of each group."""
    with np.load(FILE) as file:
        parts = np.split(file["values"], np.cumsum(file["sizes"])[:-1])
        found = {}
        for name, part in zip(file["names"].tolist(), parts, strict=True):
            group, _, rest = name.partition(": ")
            found.setdefault(group, {})[rest] = part
        return {name: file[name].item() for name in VERSIONS}, found


def write(found):
    """Write the results of all groups, with 16 of the 23 bits of each number, which take half the room."""
    results = {f"{group}: {name}": values for group, now in found.items() for name, values in now.items()}
    values = np.concatenate(list(results.values())).view(np.uint32)
    rounded = ((values + 64) & 0xFFFFFF80).view(np.float32)
    sizes = [len(each) for each in results.values()]
    np.savez_compressed(FILE, values=rounded, sizes=sizes, names=list(results), **VERSIONS)


def main():
    """Write the file, unless results change whose version does not."""
    os.environ["DSR_CACHE"] = tempfile.mkdtemp()
    torch.set_num_threads(1)
    now = {group: compute(jobs()) for group, (_, jobs) in GROUPS.items()}
    versions, before = read() if FILE.is_file() else ({}, {})
    for group, (version, _) in GROUPS.items():
        lines = [line for line in differing(before.get(group, {}), now[group]) if not line.endswith(": new")]
        if lines and all(versions[each] == VERSIONS[each] for each in (version, "WEIGHTS")):
            sys.exit("\n".join([*lines, f"{version} in dsr/utils/versions.py: expected above {VERSIONS[version]}"]))
    write(now)


if __name__ == "__main__":
    main()

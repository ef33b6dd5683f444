"""How many times as fast as a plain way dsr does something: both in turns within one process, so only ratios count.

The plain way is what a tutorial would write: float32, PyTorch's default memory layout, the library's own layers, one
process. The first turn of each way warms up; ratios are those of the medians.
"""

from __future__ import annotations

import copy
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from skimage.filters import scharr_h, scharr_v
from skimage.metrics import structural_similarity
from torch import Tensor, nn
from torch.nn import functional

from dsr.data.middlebury import Middlebury
from dsr.data.rendered import SimGeo
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.degradation.noise import Kinect
from dsr.geometry.camera import Camera
from dsr.geometry.surface import lights
from dsr.methods.classical.interpolation import Interpolation
from dsr.methods.dip import upsampler
from dsr.methods.dip.upsampler import DeepImagePrior, PriorOptimisation
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.network import Answer, NetworkUpsampler
from dsr.metrics.catalogue import PROTOCOLS, catalogue, score_image
from dsr.metrics.functional import BUMPINESS_DISPARITY, SurfacePair
from dsr.metrics.lpips import _CONVOLUTIONS, LPIPS, lpips_v
from dsr.sample import DepthSample, Scene
from dsr.synthetic.procedural.random_scene import make_camera, random_scene, render
from dsr.training.degradation import Degradation
from dsr.training.objective import DepthObjective
from dsr.training.patches import Patches
from dsr.training.settings import PatchSettings
from dsr.utils.compute_device import fast_precision

ROOT = Path(__file__).resolve().parents[1]
BOX = Downsampling("box")
Scores = dict[str, float]
Ways = Mapping[str, Callable[[], object]]


def in_turns(ways: Ways, turns: int, clock: Callable[[], float] = time.perf_counter, *, warm: int = 1) -> Scores:
    """Return the median seconds of each way; they take turns, after ``warm`` ones that do not count."""
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for turn in range(warm + turns):
        for name, way in ways.items():
            start = clock()
            way()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            if turn >= warm:
                seconds[name].append(clock() - start)
    return {name: statistics.median(each) for name, each in seconds.items()}


def ratios(seconds: Mapping[str, float]) -> Scores:
    """Return how many times as fast as the first way each of the others is."""
    plain, *others = seconds
    return {name: seconds[plain] / seconds[name] for name in others}


def plain_layout(net: nn.Module) -> nn.Module:
    """Return a copy of a network in PyTorch's default memory layout."""
    return copy.deepcopy(net).to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]


def train_step(*, device: str = "cpu", patch: int = 96, batch: int = 5, turns: int = 9) -> Scores:
    """A training step of MSG-V x4, its patches included, against a plain float32 loop."""
    source = SimGeo(size=2 * patch)
    scenes = [source.load(name) for name in source.scenes()]
    patches = Patches([scenes], PatchSettings(patch=patch, batch=batch), Degradation(4, BOX))
    objective = DepthObjective("lap1", 0.1)
    fast = MSGNet(4, "dsr").to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    slow = plain_layout(fast)
    for layer in slow.modules():
        if isinstance(getattr(layer, "activation", None), nn.PReLU):
            layer.activation = nn.Sequential(PlainPReLU())

    def step(net: Any, *, mixed: bool) -> None:
        given = torch.utils.data.default_collate([patches[i] for i in range(batch)])
        given = {name: values.to(device) for name, values in given.items()}
        with torch.autocast(device, torch.bfloat16, enabled=mixed):
            disparity = net.upsample(given["rgb"], given["disparity_lr"], given["min_max"])
        objective(Answer(disparity.float()), given)["loss"].backward()
        net.zero_grad(set_to_none=True)

    ways = {
        "plain": lambda: step(slow, mixed=False),
        "float32": lambda: step(fast, mixed=False),
        "bfloat16": lambda: step(fast, mixed=True),
    }
    return ratios(in_turns(ways, turns))


class PlainPReLU(nn.PReLU):
    """The library's own, which MSG-Net would replace on the CPU."""

    def forward(self, x: Tensor) -> Tensor:
        """Return prelu(x) by way of a slope per channel."""
        return functional.prelu(x, self.weight.expand(x.shape[1]))


def msg(*, device: str = "cpu", size: int = 512, turns: int = 5) -> Scores:
    """MSG-V x4 with drift compensation, random weights, against two plain passes; each measure adds to those before."""
    torch.manual_seed(0)
    net = MSGNet(4)
    rgb, enlarged = (each.to(device) for each in disc_before_wall(size))
    disparity = functional.avg_pool2d(30 + 20 * enlarged.double(), 4)
    float32, bfloat16 = (NetworkUpsampler(net, each, device).net for each in ("float32", "bfloat16"))
    plain = copy.deepcopy(net).eval().to(device)

    def answer(net: MSGNet, mode: Any = torch.inference_mode) -> Callable[[], Tensor]:
        return mode()(lambda: net.upsample(rgb, disparity))

    ways = {
        "plain": answer(plain, torch.no_grad),
        "channels last": answer(float32, torch.no_grad),
        "float32": answer(float32),
        "bfloat16": answer(bfloat16),
    }
    found = ratios(in_turns(ways, turns))
    off = float((ways["bfloat16"]() - ways["plain"]()).abs().max() / (disparity.max() - disparity.min()))
    return found | {"bfloat16, largest difference / range": off}


def disc_before_wall(size: int) -> tuple[Tensor, Tensor]:
    """Return a photo, (1, 3, size, size), and a map, (1, 1, size, size), in [0, 1]: a disc before a wavy wall."""
    axis = torch.linspace(-1, 1, size)
    y, x = axis[:, None], axis[None, :]
    disc = torch.sigmoid(40 * (0.4 - x**2 - y**2))
    noise = torch.rand((3, size, size), generator=torch.Generator().manual_seed(0))
    rgb = 0.4 + 0.2 * torch.sin(40 * x * y) + 0.2 * disc + 0.1 * noise
    return rgb[None], (0.3 + 0.1 * torch.sin(9 * x + 4 * y) + 0.5 * disc)[None, None]


def dip_step(*, device: str = "cpu", size: int = 256, turns: int = 5) -> Scores:
    """A step of DIP-V with the original's 128 channels and with ours, against a plain float32 loop with 128."""
    sample = make_sample(SimGeo(size=size).load("statue"), 4, BOX, "orthogonal")
    wide: Any = {"widths": (128,) * 5}
    ways = {
        "plain": dip_stepper(sample, device, plain=True, border=0, **wide),
        "same network": dip_stepper(sample, device, plain=False, **wide),
        "default": dip_stepper(sample, device, plain=False),
    }
    return ratios(in_turns(ways, turns))


def dip_stepper(sample: DepthSample, device: str, *, plain: bool, **settings: Any) -> Callable[[], None]:
    """Return what does a step of an optimisation, in the plain way or in ours."""
    precision: Any = "float32" if plain else fast_precision(torch.device(device))
    prior = DeepImagePrior(scale=4, downsampling=BOX, precision=precision, device=device, **settings)
    module = PriorOptimisation(prior, sample, visual=True)
    optimiser = module.configure_optimizers()

    def in_plain_layout() -> tuple[Tensor, Tensor]:
        """Do what ``PriorOptimisation.forward`` does, with the library's layout and its bilinear upsampling."""
        draws = torch.randn(module.start.shape, generator=module.generator, device=module.start.device)
        before, upsampler.upsample_2x = upsampler.upsample_2x, library_upsample_2x
        try:
            y = module.net(torch.addcmul(module.start, draws, module.spread).contiguous())
        finally:
            upsampler.upsample_2x = before
        return module.near + (module.far - module.near) * y[:, :1].sigmoid(), y[:, 1:].sigmoid()

    if plain:
        module.net.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]

    def step() -> None:
        depth, intensity = in_plain_layout() if plain else module()
        loss = module.loss_terms(depth, intensity)["loss"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()

    return step


def library_upsample_2x(x: Tensor) -> Tensor:
    """Return the library's bilinear upsampling by 2."""
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


def metrics(*, device: str = "cpu", turns: int = 15) -> Scores:
    """All metrics of a 512 x 512 pair but LPIPS_v, in float64, against scikit-image and numpy on the CPU."""
    prediction, target = noisy_pair()
    rays = Camera(512, 512, 618.0, 618.0, 255.5, 255.5).rays()
    tensors = [torch.from_numpy(values)[None].to(device) for values in (prediction, target)]
    device_rays, wanted = rays.to(device), catalogue()
    numpy_rays = np.ascontiguousarray(rays.permute(1, 2, 0).numpy())
    ways = {
        "scikit-image and numpy": lambda: numpy_metrics(prediction, target, numpy_rays),
        "dsr": lambda: [score.value for score in score_image(*tensors, device_rays, wanted)],
    }
    found = ratios(in_turns(ways, turns))
    theirs, ours = (way() for way in ways.values())
    off = max(abs(a - b) / max(abs(b), 1e-3) for a, b in zip(ours, theirs, strict=True))
    return found | {"largest relative difference": off}


def noisy_pair() -> tuple[np.ndarray, np.ndarray]:
    """Return a noisy version of a wavy surface with a step, and the surface, (512, 512) in metres."""
    v, u = np.mgrid[:512, :512] / 512
    target = 3 + 0.2 * np.sin(9 * u + 4 * v) + 0.1 * np.cos(23 * v) + 0.5 * (u > 0.6)
    return target + np.random.default_rng(0).normal(0, 0.004, target.shape), target


def numpy_metrics(prediction: np.ndarray, target: np.ndarray, rays: np.ndarray) -> list[float]:
    """Return every metric in the order of the catalogue; of each light e1..e4, of the worst, the average."""
    lengths, thresholds = np.linalg.norm(rays, axis=-1), (1, 5, 10)
    error = np.abs(prediction - target) * lengths
    values = [np.sqrt(np.mean(error**2))]
    values += [np.mean(error > t / 100) for t in thresholds]
    values += [np.mean(error > t / 100 * target * lengths) for t in thresholds]
    normals = [numpy_normals(depth, rays) for depth in (prediction, target)]
    shadings = [n @ lights().numpy().T for n in normals]  # (H, W, 4)
    first, second = (np.clip(shading, 0, 1) for shading in shadings)

    def with_summary(by_light: np.ndarray) -> list[float]:
        return [*by_light, by_light.max(), by_light.mean()]

    for t in thresholds:
        values += with_summary((np.abs(first - second) > t / 255).mean(axis=(0, 1)))
    ssim = [structural_similarity(first[..., i], second[..., i], data_range=2) for i in range(4)]
    values += with_summary(1 - np.array(ssim))
    values.append(np.sqrt(np.mean((normals[0] - normals[1]) ** 2)))
    values += with_summary(np.sqrt(((shadings[0] - shadings[1]) ** 2).mean(axis=(0, 1))))
    values.append(numpy_bumpiness(prediction, target))
    return [float(value) for value in values]


def numpy_normals(depth: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the normals, (H, W, 3), as PyData users would write it."""
    points = depth[..., None] * rays
    along_u, along_v = np.diff(points, axis=1), np.diff(points, axis=0)
    along_u = np.concatenate((along_u, along_u[:, -1:]), axis=1)
    along_v = np.concatenate((along_v, along_v[-1:]), axis=0)
    normals = np.cross(along_v, along_u)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def numpy_bumpiness(prediction: np.ndarray, target: np.ndarray) -> float:
    """Return Bumpiness_d by scikit-image's filters, whose outermost pixel is set to 0."""

    def derivatives(values: np.ndarray) -> list[np.ndarray]:
        return [np.pad(each(values)[1:-1, 1:-1], 1) for each in (scharr_h, scharr_v)]

    first = derivatives(BUMPINESS_DISPARITY * (1 / prediction - 1 / target))
    second = [each for values in first for each in derivatives(values)]
    return 100 * np.minimum(np.sqrt(sum(values**2 for values in second)), 0.05).mean()


def lpips(*, device: str = "cpu", turns: int = 5) -> Scores:
    """LPIPS_v of a 512 x 512 pair in one pass, against one for each image of each light; random weights."""
    rays = Camera(512, 512, 618.0, 618.0, 255.5, 255.5).rays().to(device)
    pair = SurfacePair(*(torch.from_numpy(values)[None, None].to(device) for values in noisy_pair()), rays[None])
    network = LPIPS(random_trunk()).to(device)
    plain = plain_layout(network)
    images = [(2 * maps[0].float() - 1)[:, None].expand(-1, 3, -1, -1) for maps in pair.renderings]

    def image_by_image() -> list[float]:
        values = []
        for light in range(len(images[0])):
            features = (plain.features(each[light : light + 1].contiguous()) for each in images)
            levels = [
                ((a - b).square() * getattr(plain, f"head{level}")).sum(dim=1).mean()
                for level, (a, b) in enumerate(zip(*features, strict=True))
            ]
            values.append(float(torch.stack(levels).sum()))
        return values

    with torch.inference_mode():
        return ratios(in_turns({"image by image": image_by_image, "one pass": lambda: lpips_v(pair, network)}, turns))


def random_trunk() -> dict[str, Tensor]:
    """Return random weights for the trunk of LPIPS."""
    generator, weights = torch.Generator().manual_seed(0), {}
    for index, (inputs, outputs, kernel, _, _) in _CONVOLUTIONS.items():
        draws = torch.randn((outputs, inputs, kernel, kernel), generator=generator)
        weights[f"features.{index}.weight"] = (inputs * kernel**2) ** -0.5 * draws
        weights[f"features.{index}.bias"] = torch.zeros(outputs)
    return weights


def suite(*, turns: int = 3) -> Scores:
    """The other families of metrics of a 640 x 480 pair against the paper's with LPIPS_v, CPU seconds."""
    scene = SimGeo(None, ["statue"], 640).load("statue").crop(80, 0, 480, 640)
    sample = make_sample(scene, 4, BOX, "perspective")
    assert sample.depth is not None
    maps = Interpolation("bicubic")(sample).double(), sample.depth.double(), sample.camera.rays()
    network, names = LPIPS(random_trunk()), [name for name in PROTOCOLS if name not in ("field", "sensor", "plane")]

    def scores(name: str) -> Callable[[], object]:
        wanted = catalogue(network, protocols=[name])
        return lambda: list(score_image(*maps, wanted))

    ways = {name: scores(name) for name in ("paper", *(name for name in names if name != "paper"))}
    return ratios(in_turns(ways, turns, time.process_time))


def prepare(*, scenes: int = 4, height: int = 1944, width: int = 2880) -> Scores:
    """Scenes as large as Middlebury 2014's, resized together, or kept, against one by one."""
    with tempfile.TemporaryDirectory() as place:
        root, size = Path(place), (height // 16 * 16, width // 16 * 16)
        for number in range(scenes):
            write_middlebury(root / "data" / f"scene{number}", *size, seed=number)
        data = Middlebury(str(root / "data"), "found", fill=[], without_offset=[])
        names = data.scenes()

        def kept_in(name: str, action: Callable[[], object]) -> Callable[[], object]:
            def act() -> object:
                os.environ["DSR_CACHE"] = str(root / name)
                return action()

            return act

        def load() -> list[Scene]:
            return [data.load(name) for name in names]

        ways = {
            "one by one": kept_in("one by one", load),
            "together": kept_in("together", lambda: list(data.prepare(names))),
            "kept": kept_in("together", load),
        }
        return ratios(in_turns(ways, 1, warm=0))  # once: everything is kept from the second time on


def write_middlebury(folder: Path, height: int, width: int, seed: int) -> None:
    """Write a scene of slanted stripes with holes in the format of Middlebury 2014."""
    folder.mkdir(parents=True)
    random = np.random.default_rng(seed)
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    disparity = (60 + 40 * (columns // 300 % 2) + 0.01 * rows + random.normal(0, 0.02, (height, width))).astype("<f4")
    disparity[random.random((height // 16, width // 16)).repeat(16, 0).repeat(16, 1) < 0.03] = np.inf
    header = f"Pf\n{width} {height}\n-1\n".encode()
    (folder / "disp0.pfm").write_bytes(header + disparity[::-1].tobytes())
    photo = random.integers(0, 256, (height // 8, width // 8, 3), np.uint8)
    cv2.imwrite(str(folder / "im0.png"), cv2.resize(photo, (width, height), interpolation=cv2.INTER_CUBIC))
    (folder / "calib.txt").write_text(
        f"cam0=[{width} 0 {width / 2}; 0 {width} {height / 2}; 0 0 1]\ndoffs=0\nbaseline=180\n"
        f"width={width}\nheight={height}\n"
    )


def python(*arguments: str, checkout: Path = ROOT, cores: int | None = None, cwd: Path | None = None) -> None:
    """Run a checkout's command, with one thread on so many cores; with its own choice of threads if None is given."""
    environment = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    environment["PYTHONPATH"] = str(checkout / "src")
    if cores is not None:
        environment["OMP_NUM_THREADS"] = "1"
    chosen = set(sorted(os.sched_getaffinity(0))[:cores])
    subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env=environment,
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: os.sched_setaffinity(0, chosen),
    )


def workers(
    *, device: str = "cpu", rgb: str = "", depth: str = "", method: str = "facets", only: str = "", ratio: int = 4,
    frames: int = 24, turns: int = 2,
) -> Scores:  # fmt: skip
    """``dsr upsample`` of a folder with two workers on two cores, against one on one, without the time to start."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        pair = (Path(rgb), Path(depth)) if rgb and depth else write_frame(folder, ratio)
        for number in range(frames):
            for kind, path in zip(("rgb", "depth"), pair, strict=True):
                target = folder / "many" / kind / f"{number:05}{path.suffix}"
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, target)
        options = ("--method", method, "--device", device, "--fov", "60", *(("--only", only) if only else ()))

        def command(count: int, *shard: str) -> Callable[[], None]:
            def act() -> None:
                place = ("--workers", str(count), "-o", str(folder / "out"), *shard)
                python("-m", "dsr", "upsample", str(folder / "many"), *options, *place, cores=count)
                shutil.rmtree(folder / "out")

            return act

        some = ("--shard", "1/6")
        ways = {"1": command(1), "1 some": command(1, *some), "2": command(2), "2 some": command(2, *some)}
        taken = in_turns(ways, turns, warm=0)
    return {"two workers": (taken["1"] - taken["1 some"]) / (taken["2"] - taken["2 some"])}


def write_frame(folder: Path, ratio: int) -> tuple[Path, Path]:
    """Write a photo of 640 x 480 and a noisy map in millimetres that is smaller by a ratio, or of the same size."""
    scene = random_scene(np.random.default_rng(5))
    made = render(scene, 640)
    camera = make_camera(scene.viewpoint, 640).crop(80, 0, 480, 640)
    rgb, true = made.rgb[80:560], torch.from_numpy(made.depth[80:560].copy())[None]
    photo = torch.from_numpy(np.ascontiguousarray(rgb)).permute(2, 0, 1).float() / 255
    if ratio == 1:
        depth_lr = Kinect()(true, torch.Generator().manual_seed(0))
    else:
        depth_lr = make_sample(Scene("speed", "frame", photo, camera, true), ratio, BOX, "disparity", Kinect()).depth_lr
    cv2.imwrite(str(folder / "photo.jpg"), rgb[..., ::-1])
    millimetres = (1e3 * depth_lr[0].nan_to_num(0)).round().clamp(0, 65535).numpy().astype(np.uint16)
    cv2.imwrite(str(folder / "map.png"), millimetres)
    return folder / "photo.jpg", folder / "map.png"


def evaluation(*, before: str = "", overrides: str = "", turns: int = 3) -> Scores:
    """``python eval.py OVERRIDES`` against that of another checkout, ``before``."""
    if not before:
        raise FileNotFoundError("needs another checkout: --set before=DIR")
    with tempfile.TemporaryDirectory() as place:

        def command(checkout: Path) -> Callable[[], None]:
            def act() -> None:
                run = tempfile.mkdtemp(dir=place)
                arguments = (f"output_dir={run}/run", *overrides.split())
                python(str(checkout / "eval.py"), *arguments, checkout=checkout, cwd=Path(place))

            return act

        return ratios(in_turns({"before": command(Path(before).resolve()), "now": command(ROOT)}, turns, warm=0))


def report(*, runs: str = "", turns: int = 1) -> Scores:
    """``dsr report`` with two workers against one, of RUNS or of three of the embedded scenes."""
    with tempfile.TemporaryDirectory() as place:
        for method in () if runs else ("nearest", "bicubic", "facets"):
            python("eval.py", "dataset=simgeo", f"method={method}", f"output_dir={place}/runs/{method}", cwd=ROOT)

        def command(count: str) -> Callable[[], None]:
            folder = runs or f"{place}/runs"
            return lambda: python("-m", "dsr", "report", folder, "-o", f"{place}/{count}", "--workers", count, cores=2)

        return ratios(in_turns({"one worker": command("1"), "two workers": command("2")}, turns, warm=0))


CASES: Sequence[Callable[..., Scores]] = (
    train_step, msg, dip_step, metrics, lpips, suite, prepare, workers, report, evaluation,
)  # fmt: skip

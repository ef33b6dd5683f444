# Frozen: this measured once what the documentation says of it. It is not maintained.
"""What Steady gains for a camera that stands still, what it leaves behind moving objects, and what it costs.

    python docs/measurements/scripts/still_camera.py [--method facets] [--noises kinect,structured,stereo]
                                   [--scenes 0,1,2] [--frames 16]

Procedural scenes of 256 x 256, x2, with noise that is new in each frame and whose parameters stay, and photos with noise
of 0.01. In moving ones a striped ball moves by 4 pixels a frame. Flicker is the mean of `dsr.metrics.temporal.flicker`.
The error behind moving objects is that of pixels whose true depth changed within three frames, over that of single
frames.
"""

import argparse
import time

import cv2
import torch
from torch.nn import functional

from dsr.data.rendered import Procedural
from dsr.degradation import noise as noises
from dsr.inference import Steady, upsampler
from dsr.metrics.temporal import flicker

FIELD, WAVES, FRESH = noises.field_of, noises.waves_of, torch.Generator().manual_seed(123)


def noisy(kind, inverse, luma, seed):
    """Return a map with noise whose parameters depend on the seed, and whose fields are new."""
    if kind == "kinect":
        return noises.Kinect()(inverse.reciprocal(), FRESH)
    noises.field_of = lambda values, width, _: FIELD(values, width, FRESH)
    noises.waves_of = lambda values, length, _, *more: WAVES(values, length, FRESH, *more)
    try:
        return noises.NOISES[kind](inverse, luma, torch.Generator().manual_seed(seed)).reciprocal()
    finally:
        noises.field_of, noises.waves_of = FIELD, WAVES


def frames(number, kind, count, *, moving):
    """Yield photo, low-resolution map and truth, and the camera."""
    data = Procedural(count=4, size=256)
    scene = data.load(data.scenes()[number])
    rows, columns = torch.meshgrid(torch.arange(256.0), torch.arange(256.0), indexing="ij")
    for place in range(count):
        rgb, depth = scene.rgb.float().clone(), scene.depth.double().clone()
        if moving:
            ball = (rows - 128) ** 2 + (columns - 60 - 4 * place) ** 2 < 40**2
            depth[0][ball] = 0.8 * float(scene.depth.nanmedian())
            stripes = 0.5 + 0.3 * torch.sin((columns - 4 * place) / 5)
            rgb[:, ball] = stripes[ball] * torch.tensor([1, 0.6, 0.3])[:, None]
        inverse = functional.avg_pool2d(depth.reciprocal()[None], 2)[0]
        luma = functional.avg_pool2d(rgb.mean(0, keepdim=True)[None], 2)[0].double()
        photo = (rgb + 0.01 * torch.randn(rgb.shape, generator=FRESH)).clamp(0, 1)
        yield photo, noisy(kind, inverse, luma, 100 * number + 7).float(), depth.float(), scene.camera


def left_behind(found, single, truth):
    """Return the error where the truth has just changed, over that of single frames."""
    ratios = []
    for now in range(3, len(truth)):
        steps = (truth[now - 2 : now + 1] - truth[now - 3 : now]).abs()
        mask = (steps > 0.05 * truth[now]).any(0) & single[now].isfinite()
        ratios.append([float((each[now] - truth[now]).abs()[mask].mean()) for each in (found, single)])
    return sum(one for one, _ in ratios) / sum(other for _, other in ratios)


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", default="facets")
    parser.add_argument("--noises", default="kinect,structured,stereo")
    parser.add_argument("--scenes", default="0,1,2")
    parser.add_argument("--frames", type=int, default=16)
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    run = upsampler(options.method)
    for kind in options.noises.split(","):
        for number in map(int, options.scenes.split(",")):
            for moving in (False, True):
                steady, singles, means, truths = Steady(), [], [], []
                for photo, depth_lr, truth, camera in frames(number, kind, options.frames, moving=moving):
                    singles.append(run.upsample(photo, depth_lr, camera))
                    means.append(steady(singles[-1], photo))
                    truths.append(truth)
                half = options.frames // 2
                truth = torch.stack(truths)
                single, mean = (torch.stack([each.depth for each in some]) for some in (singles, means))
                told = [
                    float(((depth - truth)[half:].abs() / torch.stack([s.depth_error for s in some])[half:]).nanmedian())
                    for depth, some in ((single, singles), (mean, means))
                ]
                text = f"{kind} {number}: "
                if moving:
                    text += f"error behind the ball {left_behind(mean, single, truth):.3f} of a single frame's"
                else:
                    whole, late = (float(flicker(mean[k:])) / float(flicker(single[k:])) for k in (0, half))
                    text += f"flicker {float(flicker(single)):.4f}, times {whole:.2f}, times {late:.2f} in the second half"
                print(f"{text}; error / expected {told[0]:.2f}, {told[1]:.2f}", flush=True)
    big, photo = torch.rand(1, 480, 640) + 1, torch.rand(3, 480, 640)
    surface = means[-1]._replace(depth=big, depth_error=0.01 * big, angle_error=None, filled=None)
    steady(surface, photo)
    times = {"Steady": [], "OpenCV's bilateral filter of 19 pixels": []}
    for _ in range(30):
        for name, work in zip(times, (lambda: steady(surface, photo),
                                      lambda: cv2.bilateralFilter(big[0].numpy(), 19, 0.03, 3)), strict=True):  # fmt: skip
            began = time.process_time()
            work()
            times[name].append(1e3 * (time.process_time() - began))
    print(", ".join(f"{name}: {sorted(each)[15]:.1f} ms of a core" for name, each in times.items()), "at 640 x 480")


if __name__ == "__main__":
    main()

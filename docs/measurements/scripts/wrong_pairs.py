# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""How often photos and depth maps that do not belong together are noticed, and right ones suspected.

python docs/measurements/scripts/wrong_pairs.py --shared DIR [--rendered 500] [--workers 2]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from dsr.app.upsample.checks import align
from dsr.data.cleargrasp import read_depth
from dsr.data.detection import find_scenes
from dsr.data.frame_files import read_picture
from dsr.degradation.downsampling import scene_generator
from dsr.degradation.random_degradation import Everything
from dsr.geometry.agreement import depth_outlines, find_misplaced, judge, photo_outlines, reduce_photo, significances
from dsr.geometry.camera import Camera
from dsr.io.depth_files import Encoding
from dsr.io.inputs import Picture
from dsr.notes import LIMITS
from dsr.sample import AllHolesError, Scene
from dsr.synthetic.procedural.random_scene import render_random_scene
from dsr.synthetic.simgeo import SCENES, render_scene

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
    parser = argparse.ArgumentParser(prog="wrong_pairs.py", description=pairs.__doc__)
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


if __name__ == "__main__":
    pairs(sys.argv[1:])

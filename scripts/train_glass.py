"""Train what finds glass: ``python scripts/train_glass.py [--scenes 4200] [--workers 2] [-o FILE]``.

Rendered scenes get clear, mirroring and glossy objects, three quarters of them, and before all of them stands a
simulated sensor; some of their pixels are learnt from. About 20 minutes on two cores, most of it for the scenes, and
8 more to render 400 of them the first time. Equal options give equal weights.
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import lightning
import safetensors.torch
import torch
from torch import Tensor
from torch.nn import functional
from torch.utils.data import DataLoader, TensorDataset

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY / "src"))

from dsr.data.rendered import Procedural  # noqa: E402
from dsr.degradation.glass import add_glass  # noqa: E402
from dsr.degradation.random_degradation import Everything  # noqa: E402
from dsr.degradation.random_fields import chance, draw, uniform  # noqa: E402
from dsr.methods.glass import GRID, GlassFinder, glass_features  # noqa: E402
from dsr.sample import AllHolesError, Scene  # noqa: E402
from dsr.utils.files import replacing  # noqa: E402

WEIGHTS = REPOSITORY / "src" / "dsr" / "methods" / "glass.safetensors"
RENDERED = 400
"""Scenes, each of which is used several times."""
KINDS = {"vessel": 0.55, "ball": 0.08, "box": 0.12, "pane": 0.08, "mirror": 0.07, "gloss": 0.1}
SENSORS = Everything(
    kernels={"box": 0.6, "nearest": 0.4},
    noises={"waves": 0.12, "structured": 0.25, "flight": 0.13, "lidar": 0.1, "stereo": 0.3, "none": 0.1},
    relief=0, folds=0.1, textured=0.1, photo=0.6, soft=0,
)  # fmt: skip
WRONG = 0.02
"""Relative error of depth from which it is not that of the surface."""
INSIDE, OUTSIDE = 600, 900
"""Pixels of each scene to learn from: of objects, and of the rest."""
MOST = 200.0
"""Pixels that one of them stands for, at most; its weight in the loss is the root of that."""
Pixels = tuple[Tensor, Tensor, Tensor]


def pixels_of(scene: Scene, generator: torch.Generator) -> Pixels | None:
    """Return pixels of a scene as a sensor sees it: features, whether depth is wrong, and for how many each stands."""
    assert scene.depth is not None  # noqa: S101 - rendered
    scene = replace(scene, depth=scene.depth.float())
    if chance(0.6, generator):
        size = 32 * int(uniform(8, 15, generator))
        top, left = (int(uniform(0, n - size + 1, generator)) for n in scene.rgb.shape[-2:])
        scene = scene.crop(top, left, size, size)
    full, seen = add_glass(scene, generator, KINDS) if chance(0.75, generator) else (scene, scene.depth)
    if seen is None or full.depth is None or scene.depth is None or not bool(seen.isfinite().any()):
        return None
    scale = int(draw({"1": 2, "2": 1, "4": 1}, generator))
    try:
        sample, _ = SENSORS(replace(full, depth=seen), scale, generator)
    except AllHolesError:
        return None
    grid = int(GRID * draw_scale(generator))
    features = glass_features(sample.rgb, sample.depth_lr.float().reciprocal(), grid, wide=None)
    object_, truth, measured = (
        functional.interpolate(each[None], features.shape[-2:], mode="nearest-exact").flatten()
        for each in ((full.depth != scene.depth).float(), full.depth, sample.depth_lr.float())
    )
    off = (measured / truth - 1).abs()
    known, inside = off.isfinite(), object_ > 0
    wrong = inside & (off > WRONG)
    chosen, counts = [], []
    for places, most in ((inside & known, INSIDE), (~inside & known, OUTSIDE)):
        found = places.nonzero()[:, 0]
        if len(found):
            picked = found[torch.randperm(len(found), generator=generator)[:most]]
            chosen.append(picked)
            counts.append(torch.full((len(picked),), len(found) / len(picked)))
    if not chosen:
        return None
    places = torch.cat(chosen)
    return features.flatten(1)[:, places].T.half(), wrong[places], torch.cat(counts)


def draw_scale(generator: torch.Generator) -> float:
    """Return by how much finer or coarser the grid is than in use, as objects have all sizes."""
    return uniform(0.8, 1.6, generator)


def pixels_of_number(number: int, rendered: int) -> Pixels | None:
    """Return the pixels of the training's scene of a number."""
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(number)
    source = Procedural(rendered)
    return pixels_of(source.load(source.scenes()[int(torch.randint(rendered, (1,), generator=generator))]), generator)


def gather(scenes: int, rendered: int, workers: int) -> Pixels:
    """Return the pixels of all scenes."""
    found: list[Pixels] = []
    with contextlib.ExitStack() as stack:
        numbers: Iterator[Pixels | None]
        work = partial(pixels_of_number, rendered=rendered)
        if workers:
            pool = stack.enter_context(multiprocessing.get_context("spawn").Pool(workers))
            numbers = pool.imap(work, range(scenes), chunksize=4)
        else:
            numbers = map(work, range(scenes))
        for number, each in enumerate(numbers, start=1):
            found += [] if each is None else [each]
            if number % 100 == 0:
                print(f"{number} of {scenes} scenes", flush=True)
    features, wrong, counts = (torch.cat(each) for each in zip(*found, strict=True))
    return features, wrong, counts


class GlassTraining(lightning.LightningModule):
    """Learns from pixels, with features missing and changed at random."""

    def __init__(self, finder: GlassFinder, steps: int) -> None:
        super().__init__()
        self.finder, self._steps = finder, steps

    def training_step(self, batch: Pixels, _: int) -> Tensor:
        """Return the mean negative log-likelihood."""
        features, wrong, weight = batch
        shown = self.finder.normalise(features.float())
        shown = (shown + 0.1 * torch.randn_like(shown)) * (torch.rand_like(shown) > 0.05)
        found = self.finder(shown)
        target = wrong[:, None].float().expand_as(found)
        loss = functional.binary_cross_entropy_with_logits(found, target, weight[:, None])
        self.log("train/loss", loss, prog_bar=True)
        return loss

    def configure_optimizers(self) -> Any:
        """Return AdamW whose rate falls to 0 as a cosine."""
        optimizer = torch.optim.AdamW(self.parameters(), lr=3e-3, weight_decay=1e-2)
        scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, self._steps)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}


def main() -> None:
    """Gather, train and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=4200)
    parser.add_argument("--rendered", type=int, default=RENDERED)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("-o", "--output", type=Path, default=WEIGHTS)
    options = parser.parse_args()
    features, wrong, counts = gather(options.scenes, options.rendered, options.workers)
    print(f"{len(wrong)} pixels, {float((counts * wrong).sum() / counts.sum()):.1%} of all are wrong", flush=True)
    lightning.seed_everything(0)
    finder = GlassFinder()
    finder.middle.copy_(features.float().mean(dim=0))
    finder.scale.copy_(features.float().std(dim=0) + 1e-3)
    weight = counts.clamp(max=MOST).sqrt()
    data = TensorDataset(features, wrong, weight / weight.mean())
    sampler = torch.utils.data.RandomSampler(data, replacement=True, num_samples=4096 * options.steps)
    batches = torch.utils.data.BatchSampler(sampler, 4096, drop_last=True)
    loader = DataLoader(data, sampler=batches, batch_size=None)
    trainer = lightning.Trainer(
        max_steps=options.steps, accelerator="cpu", logger=False, enable_checkpointing=False, enable_model_summary=False
    )
    trainer.fit(GlassTraining(finder, options.steps), loader)
    with replacing(options.output) as temporary:
        safetensors.torch.save_file({name: each.contiguous() for name, each in finder.state_dict().items()}, temporary)
    print(f"weights: {options.output}")


if __name__ == "__main__":
    main()

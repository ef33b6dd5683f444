# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""How fast the published networks of the field run here, against their authors' own code on the same device.

Both run on the same enlarged map and photo in one process, in turns; the ratios are of CPU seconds on one thread, or of
the seconds until a GPU is done. The authors' code and weights are not part of dsr: the first argument is a directory
with their repositories under the names that `git clone` gives them, the second one with their weights
(docs/methods.md):

    python docs/measurements/scripts/peers_speed.py CHECKOUTS WEIGHTS
    python docs/measurements/scripts/peers_speed.py CHECKOUTS WEIGHTS --only pgsr fdkn --size 256 [--device cuda]

What the authors' files import for their training only and is not installed is replaced by a placeholder.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import torch
from torch import Tensor, nn

from dsr.methods.images import normalise_imagenet
from dsr.methods.networks.peers.peer import Peer
from dsr.methods.networks.peers import read_tensors
from dsr.methods.recipe import Run, read_recipe

TRAINING_ONLY = (
    *("h5py", "kornia", "skimage", "skimage.color", "skimage.io"),
    *("torchvision", "torchvision.transforms", "torchvision.transforms.functional"),
)
"""Libraries that the authors' files import beside their networks."""
SCALES = {"fdkn": 8}
"""The factor of each network's weights, unless it is 4."""


def load_module(folder: Path, name: str) -> ModuleType:
    """Import a module of an author's folder, and forget its neighbours' names, which other authors use as well."""
    known = set(sys.modules)
    missing = [each for each in TRAINING_ONLY if importlib.util.find_spec(each.partition(".")[0]) is None]
    sys.modules |= {each: MagicMock() for each in missing}
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(folder))
        for module in set(sys.modules) - known:
            del sys.modules[module]


def pgsr(checkouts: Path) -> tuple[nn.Module, Callable[[nn.Module, Tensor, Tensor], Tensor]]:
    """Return the authors' network and how it is called with a photo and an enlarged map."""
    settings = SimpleNamespace(embed_ch=32, n_rcablocks=2, front_RBs=2, back_RBs=2)
    net: nn.Module = load_module(checkouts / "PGSR" / "src", "PDSR").PDSR(settings)
    return net, lambda net, rgb, values: net(values, normalise_imagenet(rgb))


def fdkn(checkouts: Path) -> tuple[nn.Module, Callable[[nn.Module, Tensor, Tensor], Tensor]]:
    """Return the authors' network and how it is called with a photo and an enlarged map."""
    net: nn.Module = load_module(checkouts / "dkn", "models").FDKN(kernel_size=3, filter_size=15, residual=True)
    return net, lambda net, rgb, values: net((rgb, values))


def svlrm(checkouts: Path) -> tuple[nn.Module, Callable[[nn.Module, Tensor, Tensor], Tensor]]:
    """Return the authors' network and how it is called with a photo and an enlarged map."""
    net: nn.Module = load_module(checkouts / "SVLRM", "model").SVLRM()
    grey = torch.tensor((0.299, 0.587, 0.114)).view(3, 1, 1)
    return net, lambda net, rgb, values: net(values, (rgb * grey.to(rgb)).sum(dim=1, keepdim=True))[0]


def dctnet(checkouts: Path) -> tuple[nn.Module, Callable[[nn.Module, Tensor, Tensor], Tensor]]:
    """Return the authors' network and how it is called with a photo and an enlarged map.

    Their transforms call functions that torch has no longer; here they are those of ``torch.fft``.
    """
    module = load_module(checkouts / "GDSR-DCTNet", "model")
    transforms = vars(module)["dct_2d"].__globals__
    transforms["torch"] = SimpleNamespace(
        **{name: getattr(torch, name) for name in ("arange", "cat", "cos", "sin")},
        rfft=lambda x, _, onesided: torch.view_as_real(torch.fft.fft(x)),
        irfft=lambda x, _, onesided: torch.fft.irfft(torch.view_as_complex(x), n=x.shape[1]),
    )
    net: nn.Module = module.DCTNet()
    return net, lambda net, rgb, values: net(values, normalise_imagenet(rgb))


def dornet(checkouts: Path) -> tuple[nn.Module, Callable[[nn.Module, Tensor, Tensor], Tensor]]:
    """Return the authors' network and how it is called with a photo and an enlarged map."""
    net: nn.Module = load_module(checkouts / "DORNet", "net.dornet").Net(tiny_model=True)
    return net, lambda net, rgb, values: net(x_query=values, rgb=rgb)


AUTHORS = {"pgsr": pgsr, "dctnet": dctnet, "dornet": dornet, "fdkn": fdkn, "svlrm": svlrm}
NEEDED = {"dctnet": "kornia", "dornet": "mmcv"}
"""Libraries that the authors' networks need, and that dsr does not."""


def scene(size: int) -> tuple[Tensor, Tensor]:
    """Return a photo, (1, 3, size, size), and an enlarged map, (1, 1, size, size): a disc before a wavy wall."""
    axis = torch.linspace(-1, 1, size)
    y, x = axis[:, None], axis[None, :]
    disc = torch.sigmoid(40 * (0.4 - x**2 - y**2))
    noise = torch.rand((3, size, size), generator=torch.Generator().manual_seed(0))
    rgb = 0.4 + 0.2 * torch.sin(40 * x * y) + 0.2 * disc + 0.1 * noise
    return rgb[None], (0.3 + 0.1 * torch.sin(9 * x + 4 * y) + 0.5 * disc)[None, None]


def ways(name: str, checkouts: Path, weights: Path, size: int, device: torch.device) -> dict[str, Callable[[], Tensor]]:
    """Return the authors' way and ours of refining the same map."""
    scale = SCALES.get(name, 4)
    recipe = read_recipe(name).with_weights(weights)
    upsampler = recipe.build(scale, Run(device=device))
    if not isinstance(upsampler, Peer):
        raise TypeError(f"method={name}: expected a published network of the field")
    theirs, call = AUTHORS[name](checkouts)
    theirs.load_state_dict(read_tensors(recipe.weights(scale)))
    theirs.eval().to(device)
    rgb, values = (each.to(device) for each in scene(size))
    return {
        "authors": torch.no_grad()(lambda: call(theirs, rgb, values)),
        "dsr": torch.inference_mode()(lambda: upsampler.net(rgb, values)),
    }


def measure(functions: dict[str, Callable[[], Tensor]], runs: int) -> dict[str, float]:
    """Return the median seconds of each function, of the CPU or until the GPU is done; they take turns."""
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for i in range(runs + 1):
        for name, function in functions.items():
            start, cpu = time.perf_counter(), time.process_time()
            if on_gpu := function().is_cuda:
                torch.cuda.synchronize()
            if i > 0:  # the first run warms up
                seconds[name].append(time.perf_counter() - start if on_gpu else time.process_time() - cpu)
    return {name: statistics.median(values) for name, values in seconds.items()}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("checkouts", nargs="?", type=Path, help="directory with the authors' repositories")
    parser.add_argument("weights", nargs="?", type=Path, help="directory with their weights")
    parser.add_argument("--only", nargs="+", choices=AUTHORS, default=list(AUTHORS))
    parser.add_argument("--size", type=int, default=512, help="rows and columns, a multiple of 16")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--device", type=torch.device, default="cpu")
    arguments = parser.parse_args()
    if arguments.weights is None:
        print("published networks of the field: skipped, needs their authors' repositories and weights (see --help)")
        return
    torch.set_num_threads(1)
    if arguments.device.type != "cuda":  # the authors' code asks for a GPU
        torch.Tensor.cuda = lambda self, *_, **__: self  # type: ignore[method-assign,assignment]
    print(f"{'method':10} {'authors, s':>10} {'dsr, s':>8} {'ratio':>6}  max difference")
    for name in arguments.only:
        if name in NEEDED and importlib.util.find_spec(NEEDED[name]) is None:
            print(f"{name:10} left out: its authors' code needs {NEEDED[name]}")
            continue
        functions = ways(name, arguments.checkouts, arguments.weights, arguments.size, arguments.device)
        seconds = measure(functions, arguments.runs)
        difference = float((functions["dsr"]() - functions["authors"]()).abs().max())
        ratio = seconds["authors"] / seconds["dsr"]
        print(f"{name:10} {seconds['authors']:10.2f} {seconds['dsr']:8.2f} {ratio:6.2f}  {difference:.1e}", flush=True)


if __name__ == "__main__":
    main()

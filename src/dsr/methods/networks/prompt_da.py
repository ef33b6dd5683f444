"""Prompt Depth Anything: a foundation network of photos, with the metric depth of a low-resolution map.

Lin, Peng, Chen, Peng, Sun, Liu, Bao, Feng, Zhou, Kang, *Prompting Depth Anything for 4K Resolution Accurate Metric
Depth Estimation*, CVPR 2025. The network is that of Hugging Face's ``transformers``
(PromptDepthAnythingForDepthEstimation, ``pip install -e '.[transformers]'``), the weights are its authors'. As in its
image processor, but without rounding to 8 bits, the photo is resized by Pillow's bicubic kernel to multiples of the
patches and normalised as for ImageNet, the result by a bicubic kernel with a = -0.75 to the photo's size. The network
itself brings the prompt's minimum and maximum to 0 and 1. It was trained on the 256 x 192 pixels of ARKit's lidar.
"""

import contextlib
import itertools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.base import Abilities, Cost, Method
from dsr.methods.external import within_limits
from dsr.methods.images import inpaint, normalise_imagenet, resize_bicubic
from dsr.sample import DepthSample
from dsr.utils.configuration import expect_library
from dsr.utils.guards import expect_bytes, parse_json, read_limited, refusing
from dsr.utils.progress import Steps
from dsr.utils.versions import hash_once

SIZE = 756  # side in pixels to which the authors' processor brings photos, that which has to be changed less
CONFIG, WEIGHTS = "config.json", "model.safetensors"
_HUB_NAME = re.compile(r"[\w.-]+/[\w.-]+")
# what is read of a configuration; the rest can name code and files that are to be fetched
_NETWORK = (
    "patch_size", "reassemble_hidden_size", "reassemble_factors", "neck_hidden_sizes", "fusion_hidden_size",
    "head_in_index", "head_hidden_size", "depth_estimation_type", "max_depth",
)  # fmt: skip
_BACKBONE = (
    "hidden_size", "num_hidden_layers", "num_attention_heads", "mlp_ratio", "hidden_act", "layer_norm_eps",
    "image_size", "patch_size", "num_channels", "qkv_bias", "layerscale_value", "use_swiglu_ffn", "out_indices",
    "out_features", "apply_layernorm", "reshape_hidden_states", "use_mask_token",
)  # fmt: skip
_LARGEST = 4096  # largest whole number in a configuration


class PromptDA(Method):
    """A method that is Prompt Depth Anything.

    Holes of the low-resolution map are filled before, so that the range that the network normalises by is that of
    depths. Large photos are resized, which limits the memory and what is seen of them. Nothing but ``config.json`` and
    ``model.safetensors`` of the weights' folder is read, and no code in them is executed.
    """

    abilities = Abilities(ratios="any", own_size=True, cost=Cost(60, program=5e9))
    range_type = "orthogonal"

    def __init__(self, weights: str, size: int = SIZE, device: torch.device | str = "cpu") -> None:
        expect_library("weights", "transformers", "transformers")
        self._folder = _find(str(weights))
        self._size, self.device = size, torch.device(device)
        net, self._patch = _load(self._folder)
        self.net = net.to(self.device)
        if size < self._patch:
            raise ValueError(f"size: expected {self._patch} or more, got {size}")

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution orthogonal depth, (1, H, W) in metres on the sample's device."""
        prompt = inpaint(sample.depth_lr.to(torch.float64)[None])
        depth = self.predict(sample.rgb[None], prompt)[0]
        if progress is not None:
            progress(1, 1)
        return within_limits(depth).to(sample.depth_lr)

    def predict(self, rgb: Tensor, prompt: Tensor) -> Tensor:
        """Return depth in metres, (B, 1, H, W), of photos (B, 3, H, W) in 0..1 and depth (B, 1, h, w) without holes."""
        size = (rgb.shape[-2], rgb.shape[-1])
        factor = min((self._size / n for n in size), key=lambda each: abs(1 - each))
        height, width = (max(1, round(factor * n / self._patch)) * self._patch for n in size)
        photo = resize_bicubic(rgb.to(torch.float64), (height, width)).clamp(0, 1)  # as exact as Pillow's
        flat = prompt.amax(dim=(-2, -1), keepdim=True) == prompt.amin(dim=(-2, -1), keepdim=True)
        corner = torch.zeros_like(prompt)
        corner[..., 0, 0] = 1e-6  # gives a constant map a range, which the network divides by
        prompt = torch.where(flat, prompt * (1 + corner), prompt)
        given = (each.to(self.device, torch.float32) for each in (normalise_imagenet(photo), prompt))
        depth = self.net(*given).predicted_depth[:, None]
        return functional.interpolate(depth, size, mode="bicubic", align_corners=False)

    def content(self, dataset: str, scene: str, scale: float) -> str:
        """Return the SHA-256 of the network's files."""
        return ", ".join(hash_once(self._folder / name) for name in (CONFIG, WEIGHTS))


def _find(weights: str) -> Path:
    """Return the folder with the files of a network: a name of the hub is taken from its cache, or fetched."""
    folder = Path(weights).expanduser()
    if not folder.is_dir() and _HUB_NAME.fullmatch(weights):
        import huggingface_hub  # noqa: PLC0415 - it comes with an extra

        arguments: dict[str, Any] = {"repo_id": weights, "allow_patterns": [CONFIG, WEIGHTS]}
        with contextlib.suppress(Exception):
            folder = Path(huggingface_hub.snapshot_download(local_files_only=True, **arguments))
        if not all((folder / name).is_file() for name in (CONFIG, WEIGHTS)):
            message = (
                f"weights: expected a folder, or a name of the Hugging Face hub that can be reached, got {weights}"
            )
            with refusing(message, Exception):
                folder = Path(huggingface_hub.snapshot_download(**arguments))
    missing = [name for name in (CONFIG, WEIGHTS) if not (folder / name).is_file()]
    if missing:
        raise ValueError(f"weights: expected a folder with {CONFIG} and {WEIGHTS}, got {weights} (no {missing[0]})")
    return folder


def _load(folder: Path) -> tuple[nn.Module, int]:
    """Return the network of a folder, in float32 on the CPU, and the side of its patches."""
    from transformers import (  # noqa: PLC0415 - it comes with an extra, and takes seconds
        Dinov2Config,
        PromptDepthAnythingConfig,
        PromptDepthAnythingForDepthEstimation,
    )

    path, weights = folder / CONFIG, folder / WEIGHTS
    network, backbone = _read_config(path)
    with refusing(f"{path}: expected the configuration of a network, got one that makes none", Exception):
        config = PromptDepthAnythingConfig(**network, backbone_config=Dinov2Config(**backbone))
        with torch.device("meta"):  # takes no memory
            net = PromptDepthAnythingForDepthEstimation(config)
    expect_bytes(weights, sum(each.numel() for each in net.parameters()), weights.stat().st_size)
    message = f"{weights}: expected the tensors that {CONFIG} describes, got others or a damaged file"
    with refusing(message, Exception), _silent():
        net, found = PromptDepthAnythingForDepthEstimation.from_pretrained(
            folder, config=config, use_safetensors=True, local_files_only=True, trust_remote_code=False,
            dtype=torch.float32, output_loading_info=True,
        )  # fmt: skip
    lacking = sorted(map(str, (*found["missing_keys"], *found["mismatched_keys"])))
    if lacking:
        raise ValueError(f"{weights}: expected the tensors that {CONFIG} describes, but {lacking[0]} does not fit")
    if not all(bool(each.isfinite().all()) for each in net.parameters()):
        raise ValueError(f"{weights}: expected finite numbers, got others")
    return net.eval().requires_grad_(requires_grad=False), int(config.patch_size)


def _read_config(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    with refusing(f"{path}: expected a configuration of JSON, got something else", ValueError, RecursionError):
        content = parse_json(read_limited(path))
    kind = content.get("model_type") if isinstance(content, Mapping) else None
    if kind != "prompt_depth_anything":
        raise ValueError(f"{path}: expected model_type prompt_depth_anything, got {kind!r}")
    backbone = content.get("backbone_config")
    kind = backbone.get("model_type") if isinstance(backbone, Mapping) else None
    if kind != "dinov2":
        raise ValueError(f"{path}: expected a backbone_config of model_type dinov2, got {kind!r}")
    network = {key: content[key] for key in _NETWORK if key in content}
    backbone = {key: backbone[key] for key in _BACKBONE if key in backbone}
    numbers = itertools.chain.from_iterable(
        value if isinstance(value, list) else [value] for value in (*network.values(), *backbone.values())
    )
    too_large = any(isinstance(n, int) and abs(n) > _LARGEST for n in numbers)
    if too_large or not isinstance(content.get("patch_size", 14), int):
        raise ValueError(f"{path}: expected sizes of a network of at most {_LARGEST}")
    return network, backbone


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Silence the progress and the notes of transformers, which are reported as errors here."""
    from transformers.utils import logging  # noqa: PLC0415 - it comes with an extra

    level, shown = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity(logging.CRITICAL)
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if shown:
            logging.enable_progress_bar()

"""LPIPS v0.1 with the AlexNet trunk, without torchvision.

Zhang et al., *The Unreasonable Effectiveness of Deep Features as a Perceptual Metric*, CVPR 2018. The linear heads come
with torchmetrics. The trunk is torchvision's ImageNet AlexNet, found by :func:`find_trunk`.
"""

import http.client
import importlib.metadata
import socket
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.utils import skip_init

from dsr.metrics.functional import SurfacePair
from dsr.utils.arrays import read_tensors
from dsr.utils.compute_device import in_own_precision
from dsr.utils.guards import naming

TRUNK_FILE = "alexnet-owt-7be5be79.pth"
TRUNK_URL = f"https://download.pytorch.org/models/{TRUNK_FILE}"
# what to do where the trunk is missing, for messages
GET_TRUNK = f"get {TRUNK_URL} and set metrics.lpips_trunk=FILE or $DSR_LPIPS_TRUNK"
TRUNK_HASH = "7be5be79"  # first digits of the official file's SHA-256, as in its name
_CONVOLUTIONS = {  # index in torchvision's `features`: (in, out, kernel, stride, padding)
    0: (3, 64, 11, 4, 2),
    3: (64, 192, 5, 1, 2),
    6: (192, 384, 3, 1, 1),
    8: (384, 256, 3, 1, 1),
    10: (256, 256, 3, 1, 1),
}
_POOL_BEFORE = (3, 6)
_DOWNLOAD_TIMEOUT = 15.0
MIN_SIZE = 31  # smallest height and width in pixels for which the trunk's last level has a feature


class LPIPS(nn.Module):
    """Learned perceptual image patch similarity, version 0.1, of the state dict of torchvision's AlexNet."""

    mean: Tensor
    std: Tensor

    def __init__(self, trunk: dict[str, Tensor]) -> None:
        super().__init__()
        self.convolutions = nn.ModuleDict(
            {str(i): skip_init(nn.Conv2d, a, b, k, stride=s, padding=p) for i, (a, b, k, s, p) in _CONVOLUTIONS.items()}
        )
        for index, layer in self.convolutions.items():
            for name, parameter in layer.named_parameters():
                value = trunk.get(f"features.{index}.{name}")
                shape, came = tuple(parameter.shape), tuple(value.shape) if isinstance(value, Tensor) else "nothing"
                if value is None or came != shape:
                    raise ValueError(f"features.{index}.{name}: expected a tensor of shape {shape}, got {came}")
                parameter.data.copy_(value)
        wheel = importlib.metadata.distribution("torchmetrics")  # importing it takes two seconds
        file = wheel.locate_file("torchmetrics/functional/image/lpips_models/alex.pth")
        heads = torch.load(str(file), map_location="cpu", weights_only=True)
        for level in range(len(_CONVOLUTIONS)):
            self.register_buffer(f"head{level}", heads[f"lin{level}.model.1.weight"])  # (1, C, 1, 1)
        self.register_buffer("mean", torch.tensor((-0.030, -0.088, -0.188)).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor((0.458, 0.448, 0.450)).view(1, 3, 1, 1))
        self.requires_grad_(requires_grad=False)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs
        self.eval()

    def features(self, images: Tensor) -> list[Tensor]:
        """Return the five feature maps of (B, 3, H, W) images in [-1, 1], each of unit length along its channels."""
        maps, values = [], (images - self.mean) / self.std
        for index, layer in self.convolutions.items():
            if int(index) in _POOL_BEFORE:
                values = nn.functional.max_pool2d(values, 3, stride=2)
            values = nn.functional.relu(layer(values))
            maps.append(values / (values.square().sum(dim=1, keepdim=True) + 1e-20).sqrt())
        return maps

    @in_own_precision
    def forward(self, first: Tensor, second: Tensor, mask: Tensor | None = None) -> Tensor:
        """Return the distance of images (B, 3, H, W) in [-1, 1], (B,); features weigh by their share of ``mask``."""
        if min(first.shape[-2:]) < MIN_SIZE:
            came = tuple(first.shape[-2:])
            raise ValueError(f"LPIPS: expected images of at least {MIN_SIZE} x {MIN_SIZE} pixels, got {came}")
        total = first.new_zeros(len(first))
        images = torch.cat((first, second)).contiguous(memory_format=torch.channels_last)
        for level, features in enumerate(self.features(images)):
            a, b = features.chunk(2)
            distance = ((a - b).square() * getattr(self, f"head{level}")).sum(dim=1)  # (B, h, w)
            if mask is None:
                total = total + distance.mean(dim=(-2, -1))
                continue
            weight = nn.functional.adaptive_avg_pool2d(mask.to(a.dtype), (a.shape[-2], a.shape[-1])).squeeze(1)
            weighted = torch.where(weight > 0, distance * weight, 0)  # no 0 * NaN in gradients
            total = total + weighted.sum(dim=(-2, -1)) / weight.sum(dim=(-2, -1))
        return total


def lpips_v(pair: SurfacePair, network: LPIPS) -> Tensor:
    """Return LPIPS_v per light, (B, 4): LPIPS of the renderings, repeated to three channels, scaled to [-1, 1]."""
    network.to(pair.target.device)
    batch, count, height, width = pair.renderings[0].shape
    first, second = (
        (2 * maps.to(network.mean.dtype) - 1).reshape(batch * count, 1, height, width).expand(-1, 3, -1, -1)
        for maps in pair.renderings
    )
    mask = None if pair.complete else pair.normal_mask.repeat_interleave(count, dim=0)
    return network(first, second, mask).view(batch, count)


def find_trunk(configured: Path | None) -> Path:
    """Return the file of AlexNet's weights: the configured one, the torch hub cache's, or downloaded into it."""
    if configured is not None:
        if not configured.is_file():
            raise FileNotFoundError(f"expected a file, got {configured} (no such file)")
        return configured
    cached = Path(torch.hub.get_dir()) / "checkpoints" / TRUNK_FILE
    if cached.is_file():
        return cached
    cached.parent.mkdir(parents=True, exist_ok=True)
    timeout = socket.getdefaulttimeout()
    socket.setdefaulttimeout(_DOWNLOAD_TIMEOUT)
    try:
        torch.hub.download_url_to_file(TRUNK_URL, str(cached), hash_prefix=TRUNK_HASH, progress=True)
    except (OSError, http.client.HTTPException, RuntimeError) as error:  # RuntimeError: another hash
        raise OSError(f"could not be downloaded: {getattr(error, 'reason', error)}") from error
    finally:
        socket.setdefaulttimeout(timeout)
    return cached


def load_lpips(configured: Path | None = None) -> LPIPS:
    """Return the LPIPS network with the trunk that :func:`find_trunk` finds."""
    path = find_trunk(configured)
    trunk = read_tensors(path)
    with naming(f"{path}: expected the weights of torchvision's AlexNet"):
        return LPIPS(trunk)

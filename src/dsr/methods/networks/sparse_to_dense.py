"""Sparse-to-Dense: a residual encoder-decoder that completes a few samples of depth.

Ma and Karaman, *Sparse-to-Dense: Depth Prediction from Sparse Depth Samples and a Single Image*, ICRA 2018. The photo
and an image that holds the samples, and 0 elsewhere, are one input. ResNet-18 (He et al., CVPR 2016) encodes it at 1/32
of its size; four up-projections (Laina et al., 3DV 2016) double the size, and a bilinear enlargement follows.

What differs: the samples are a low-resolution map, each next to the centre of its block; the original draws random
pixels of the true depth. It works on disparity, normalised by the low-resolution map to 1..2, so that 0 is no value.
The trunk has half the channels by default, and starts from random weights.
"""

import itertools

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.images import pad_to_multiple
from dsr.methods.networks.network import NormalisedNetwork
from dsr.utils.ratios import check_scale

_STRIDE = 32  # the photo's pixels, along an axis, for each pixel of the encoder's result
_STAGES = 4


class SparseToDense(NormalisedNetwork):
    """The network, which processes an image as a whole: the receptive field is wider than most images."""

    def __init__(self, scale: int, width: int = 32) -> None:
        super().__init__()
        check_scale(scale)
        if width < 4 or width % 4:
            raise ValueError(f"width: expected a positive multiple of 4, got {width}")
        self.scale, self.width = scale, width
        widths = [width * 2**stage for stage in range(_STAGES)]
        self.stem = nn.Sequential(nn.Conv2d(4, width, 7, 2, 3, bias=False), BatchNorm(width), nn.ReLU())
        self.encoder = nn.Sequential()
        for before, after in itertools.pairwise([width, *widths]):
            self.encoder.extend([ResidualBlock(before, after), ResidualBlock(after, after)])
        half = widths[-1] // 2
        self.middle = nn.Sequential(nn.Conv2d(widths[-1], half, 1, bias=False), BatchNorm(half))
        self.decoder = nn.Sequential(*(UpProjection(half // 2**stage) for stage in range(_STAGES)))
        self.head = nn.Conv2d(half // 2**_STAGES, 1, 3, padding=1, bias=False)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
        nn.init.kaiming_normal_(self.head.weight, nonlinearity="linear")

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Return normalised disparity (B, 1, H, W) for (B, 3, H, W) and (B, 1, h, w); see the base class."""
        height, width = rgb.shape[-2:]
        factor = max(_STRIDE // self.scale, 1)
        samples = place_samples(pad_to_multiple(values, factor) + 1, self.scale)
        x = torch.cat((pad_to_multiple(rgb, self.scale * factor), samples.to(rgb)), dim=1).to(self.head.weight.dtype)
        x = functional.max_pool2d(self.stem(x), 3, stride=2, padding=1)
        x = self.decoder(self.middle(self.encoder(x)))  # (B, C, H / 2, W / 2)
        with torch.autocast(rgb.device.type, enabled=False):
            dtype = torch.promote_types(x.dtype, torch.float32)
            result = functional.conv2d(x.to(dtype), self.head.weight.to(dtype), padding=1)
            result = functional.interpolate(result, scale_factor=2, mode="bilinear", align_corners=False)
            return result[..., :height, :width].to(values.dtype) - 1


def place_samples(values: Tensor, scale: int) -> Tensor:
    """Return (B, 1, scale h, scale w) with values (B, 1, h, w) at the pixel next to each block's centre, else 0."""
    *lead, height, width = values.shape
    before, after = scale // 2, scale - 1 - scale // 2
    blocks = functional.pad(values.view(*lead, height, 1, width, 1), (before, after, 0, 0, before, after))
    return blocks.view(*lead, height * scale, width * scale)


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions and a shortcut; a block that changes the number of channels halves the size."""

    def __init__(self, before: int, after: int) -> None:
        super().__init__()
        stride = 1 if before == after else 2
        self.branch = nn.Sequential(
            nn.Conv2d(before, after, 3, stride, 1, bias=False),
            BatchNorm(after),
            nn.ReLU(),
            nn.Conv2d(after, after, 3, 1, 1, bias=False),
            BatchNorm(after),
        )
        self.shortcut = nn.Sequential()
        if before != after:
            self.shortcut.extend([nn.Conv2d(before, after, 1, stride, bias=False), BatchNorm(after)])

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, before, H, W) to (B, after, H, W), or half the size."""
        return functional.relu(self.branch(x) + self.shortcut(x))


class UpProjection(nn.Module):
    """An up-projection to twice the size and half the channels: 5 x 5 and 3 x 3 convolutions, plus a 5 x 5 one alone.

    Zeros between the pixels and a 5 x 5 convolution are one transposed convolution, which takes a quarter of the time.
    """

    def __init__(self, before: int) -> None:
        super().__init__()
        after = before // 2
        upper, lower = (nn.ConvTranspose2d(before, after, 5, 2, 2, output_padding=1, bias=False) for _ in range(2))
        self.upper = nn.Sequential(
            upper, BatchNorm(after), nn.ReLU(), nn.Conv2d(after, after, 3, padding=1, bias=False), BatchNorm(after)
        )
        self.lower = nn.Sequential(lower, BatchNorm(after))

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, before, H, W) to (B, before / 2, 2 H, 2 W)."""
        return functional.relu(self.upper(x) + self.lower(x))


class BatchNorm(nn.Module):
    """Batch normalisation without the library's counter of batches, so that its state is real numbers alone."""

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise (B, C, H, W) with the statistics of the batch in a training, and else with their moving average."""
        return functional.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias, self.training)

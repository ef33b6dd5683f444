"""DDRNet: a network that denoises a depth map, then one that refines it with the photo.

Yan, Wu, Wang, Xu, An, Guo and Liu, *DDRNet: Depth Map Denoising and Refinement for Consumer Depth Cameras Using
Cascaded CNNs*, ECCV 2018; sizes and losses are those of the authors' code for single frames,
github.com/neycyanshi/DDRNet. Both maps are compared with the reference depth, and the second one's shading with the
photo (:func:`dsr.training.objective.shading_loss`).

What differs: the input is the bicubic upsampling of a low-resolution map, exact on planes, of disparity normalised to
-1..1; the refinement network learns a residual, too; the sizes are halved once at x2 and twice otherwise.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from dsr.methods.images import grey, upsample_linear_border
from dsr.methods.networks.network import NormalisedNetwork
from dsr.utils.ratios import check_scale

_HALVINGS = 2
_BLOCKS = 2
_SLOPE = 0.2
_GAIN = 0.05  # of the last layers' outputs: a step of the optimiser changes maps that are nearly right by less
_UPSAMPLING = 4  # receptive-field radius of the upsampling in low-resolution pixels


class DDRNet(NormalisedNetwork):
    """The network."""

    def __init__(self, scale: int, denoising: int = 32, refinement: int = 16) -> None:
        super().__init__()
        check_scale(scale)
        if denoising < 1 or refinement < 4 or refinement % 4:
            raise ValueError(f"model: expected denoising from 1, refinement 4, 8, ..., got {denoising}, {refinement}")
        self.scale, self.denoising, self.refinement = scale, denoising, refinement
        halvings = min(_HALVINGS, scale.bit_length() - 1)
        self.denoise = Denoising(denoising, halvings)
        self.refine = Refinement(refinement, halvings)
        radius_hr = self.denoise.radius + self.refine.radius
        self.receptive_field_radius = -(-radius_hr // scale) + _UPSAMPLING

    def forward(self, rgb: Tensor, values: Tensor) -> Tensor:
        """Return the refined map, (B, 1, H, W), normalised to 0..1."""
        return self.compute_stages(rgb, values)[-1]

    def compute_stages(self, rgb: Tensor, values: Tensor, *context: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the denoised and the refined map, (B, 1, H, W) each, normalised to 0..1."""
        dtype = self.denoise.last.weight.dtype
        enlarged = 2 * upsample_linear_border(values, self.scale) - 1
        denoised = enlarged + self.denoise(enlarged.to(dtype)).to(values.dtype)
        intensity = 2 * grey(rgb).to(dtype) - 1
        refined = denoised + self.refine(denoised.to(dtype), intensity).to(values.dtype)
        return (denoised + 1) / 2, (refined + 1) / 2


class Denoising(nn.Module):
    """Denoising: a U-net whose coarsest level has residual blocks; its channels double with each halving."""

    def __init__(self, width: int, halvings: int) -> None:
        super().__init__()
        widths = [width * 2**level for level in range(halvings + 1)]
        self.first = nn.Conv2d(1, width, 3, padding=1)
        self.down = nn.ModuleList(nn.Conv2d(n, 2 * n, 3, stride=2, padding=1) for n in widths[:-1])
        self.blocks = nn.ModuleList(_PreactivatedBlock(widths[-1]) for _ in range(_BLOCKS))
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(4 * n, n, 3, stride=2, padding=1, output_padding=1) for n in reversed(widths[:-1])
        )
        self.last = nn.Conv2d(2 * width, 1, 3, padding=1)
        coarsest = 2**halvings
        # of the receptive field in pixels of the map
        self.radius = 2 + (coarsest - 1) + 2 * _BLOCKS * coarsest + 2 * (coarsest - 1)
        _initialise(self, self.last)

    def forward(self, depth: Tensor) -> Tensor:
        """Map (B, 1, H, W) to the residual, (B, 1, H, W)."""
        x = _relu(self.first(depth))
        skips = [x]
        for layer in self.down:
            x = _relu(layer(x))
            skips.append(x)
        for block in self.blocks:
            x = block(x)
        for layer in self.up:
            x = _relu(layer(torch.cat((skips.pop(), x), dim=1)))
        return (_GAIN * self.last(torch.cat((skips.pop(), x), dim=1))).tanh()


class Refinement(nn.Module):
    """The refinement network: features of depth and intensity at three sizes, brought to the first (*hypercolumns*)."""

    def __init__(self, width: int, halvings: int) -> None:
        super().__init__()
        self.depth, self.intensity = (nn.Conv2d(1, width // 2, 3, padding=1) for _ in range(2))
        self.joined = nn.Conv2d(width, width, 3, padding=1)
        self.levels = nn.ModuleList()
        before, columns = 2 * width, width
        self.radius = 2 + 2 * 2**halvings - 1  # of the receptive field: of convolutions, pooling and enlargement
        for level in range(1, halvings + 1):
            after = width * 2**level
            layers = [nn.Conv2d(n, after, 3, padding=1) for n in (before, *[after] * level)]
            self.levels.append(nn.ModuleList(layers))
            before, columns = 2 * after, columns + after
            self.radius += len(layers) * 2**level
        self.mix = nn.ModuleList([nn.Conv2d(columns, width, 1), nn.Conv2d(width, width // 4, 1)])
        self.last = nn.Conv2d(width // 4, 1, 1)
        _initialise(self, self.last)

    def forward(self, depth: Tensor, intensity: Tensor) -> Tensor:
        """Map depth and intensity, (B, 1, H, W) each, to the residual, (B, 1, H, W)."""
        first = _relu(torch.cat((self.depth(depth), self.intensity(intensity)), dim=1))
        x = _relu(self.joined(first))
        columns, features = [x], torch.cat((first, x), dim=1)
        for layers in self.levels:
            x = functional.max_pool2d(features, 2)
            made = []
            for layer in layers:  # type: ignore[attr-defined]
                x = _relu(layer(x))
                made.append(x)
            features = torch.cat((made[0], x), dim=1)
            columns.append(functional.interpolate(x, size=depth.shape[-2:], mode="bilinear", align_corners=False))
        x = torch.cat(columns, dim=1)
        for layer in self.mix:
            x = _relu(layer(x))
        return (_GAIN * self.last(x)).tanh()


class _PreactivatedBlock(nn.Module):
    """A residual block that applies its rectifiers before the convolutions."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = (nn.Conv2d(width, width, 3, padding=1) for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(functional.relu(self.first(functional.relu(x))))


def _relu(x: Tensor) -> Tensor:
    return functional.leaky_relu(x, _SLOPE)


def _initialise(net: nn.Module, last: nn.Conv2d) -> None:
    """Initialise the convolutions of a network; its last one gives no residual at first."""
    for layer in net.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.kaiming_normal_(layer.weight, a=_SLOPE)
            nn.init.zeros_(layer.get_parameter("bias"))
    nn.init.zeros_(last.weight)

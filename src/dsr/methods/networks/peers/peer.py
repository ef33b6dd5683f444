"""The method that runs a published network of the field.

Such a network maps a photo and an enlarged map in 0..1 to a refined map in 0..1. Most authors normalise by the minimum
and the maximum of the *true* map, which no method can know. :class:`Peer` takes those of the low-resolution map, and
the true ones only on request, to reproduce the authors' figures.
"""

import copy
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Literal, get_args

import torch
from torch import Tensor

from dsr.geometry.camera import RANGE_TYPES, RangeType, from_range, to_range
from dsr.methods.base import Abilities, Method
from dsr.methods.images import compute_min_max, inpaint, normalise, pad_to_multiple
from dsr.methods.networks.network import DTYPES, Precision, blend_tiles, split_image
from dsr.methods.networks.peers import PeerNetwork, load_peer
from dsr.methods.networks.peers.dctnet import DCTNet
from dsr.methods.networks.peers.dornet import DORNet
from dsr.methods.networks.peers.local_filters import FDKN, SVLRM
from dsr.methods.networks.peers.pgsr import PGSR
from dsr.methods.networks.weight_files import nearest_scale
from dsr.sample import DepthSample
from dsr.utils.configuration import Node
from dsr.utils.guards import expect_one_of
from dsr.utils.progress import Steps
from dsr.utils.versions import file_hash

Range = Literal["measured", "truth"]
PEERS: MappingProxyType[str, type[PeerNetwork]] = MappingProxyType(
    {"dctnet": DCTNet, "dornet": DORNet, "fdkn": FDKN, "pgsr": PGSR, "svlrm": SVLRM}
)
_OVERLAP = 16  # of neighbouring tiles in pixels


class Peer(Method):
    """A method that is a published network; it takes maps of any ratio, as the network works at the photo's size.

    At a whole factor that the network was trained for, the file must be for that factor; at another one, any may be
    taken. Weights with a ``depth_range`` of their own get orthogonal depth, normalised by it. With ``range=truth``,
    which is how the authors get their figures, it reads ``sample.depth``, and ``flag`` marks its scores.
    """

    abilities = Abilities(ratios="any", needs="weights")

    @classmethod
    def abilities_of(cls, node: Node) -> Abilities:
        """Return the abilities of the network that a node names."""
        network = PEERS.get(str(node.get("peer")))
        return cls.abilities if network is None else replace(cls.abilities, cost=network.cost)

    def __init__(
        self,
        peer: str | PeerNetwork,
        weights: Path | None = None,
        scale: float = 1,
        weights_files: Mapping[str, float] = MappingProxyType({}),
        range_type: RangeType = "disparity",
        range: Range = "measured",  # noqa: A002 - the key's name
        precision: Precision = "float32",
        device: torch.device | str = "cpu",
        tile: int | None = None,
    ) -> None:
        expect_one_of("range_type", range_type, RANGE_TYPES)
        expect_one_of("range", range, get_args(Range))
        expect_one_of("precision", precision, tuple(DTYPES))
        if isinstance(peer, str):
            net = _load(peer, weights, scale, weights_files)
        elif weights is None:
            net = peer
        else:
            raise ValueError(f"weights: expected no file beside a network, got {weights}")
        if net.depth_range is not None and range == "truth":
            low, high = net.depth_range
            raise ValueError(
                f"range: expected measured for weights trained on depth of {low:g} to {high:g} m, got truth"
            )
        self.range_type = range_type if net.depth_range is None else "orthogonal"
        self.device, self._dtype, self._tile = torch.device(device), DTYPES[precision], tile
        self._uses_truth = range == "truth"
        net = copy.deepcopy(net).eval().requires_grad_(False).to(self.device)
        self.net: PeerNetwork = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs

    @property
    def flag(self) -> str:
        """Mark for scores: ``true-range`` if the true map's minimum and maximum were used, else empty."""
        return "true-range" if self._uses_truth else ""

    def describe(self, sample: DepthSample) -> str:
        """Return a note for the scores where the weights were trained for another factor, else an empty text."""
        trained = self.net.scale
        return "" if math.isclose(trained, sample.scale, rel_tol=0.01) else f"weights trained for x{trained:.3g}"

    @torch.inference_mode()
    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        """Return the high-resolution orthogonal depth, (1, H, W) in metres, NaN where it is at or beyond infinity."""
        if self.range_type == "disparity":
            values_lr = sample.disparity_lr()
        else:
            values_lr = to_range(sample.depth_lr, sample.camera_lr, self.range_type)
        min_max = None  # the low-resolution map's own
        if self.net.depth_range is not None:
            min_max = torch.tensor(self.net.depth_range).view(1, 2, 1, 1)
        elif self._uses_truth:
            if sample.depth is None:
                raise ValueError(f"{sample.scene}: range=truth expects a scene with a true depth map, there is none")
            min_max = compute_min_max(to_range(sample.depth, sample.camera, self.range_type)[None])
        values_lr, rgb = values_lr.to(self.device)[None], sample.rgb.to(self.device)[None]
        values, minimum, value_range = normalise(inpaint(values_lr), min_max)
        refined = self._refine(rgb, values, progress).to(values_lr.dtype) * value_range + minimum
        return from_range(refined[0], sample.camera, self.range_type).to(sample.depth_lr.device)

    def _refine(self, rgb: Tensor, values_lr: Tensor, progress: Steps | None) -> Tensor:
        """Return a map in 0..1, (B, 1, h, w), enlarged to the photo's size and refined, in tiles if that is large."""
        multiple, radius = self.net.multiple, self.net.receptive_field_radius
        height, width = rgb.shape[-2:]
        enlarged = self.net.enlarge(values_lr.float(), (height, width))
        rgb, enlarged = (pad_to_multiple(each.float(), multiple) for each in (rgb, enlarged))
        margin = None if radius is None else math.ceil(radius / multiple)
        size, overlap = (rgb.shape[-2], rgb.shape[-1]), max(_OVERLAP // multiple, 2)
        rows, columns = split_image(size, multiple, margin, self._tile, overlap)

        def compute(row: slice, column: slice) -> Tensor:
            down, across = (slice(multiple * each.start, multiple * each.stop) for each in (row, column))
            with torch.autocast(self.device.type, self._dtype, enabled=self._dtype != torch.float32):
                return self.net(rgb[..., down, across], enlarged[..., down, across]).float()

        return blend_tiles(compute, rows, columns, multiple, progress)[..., :height, :width]


def _load(peer: str, weights: Path | None, scale: float, files: Mapping[str, float]) -> PeerNetwork:
    """Load a network of its authors' file, which has to suit the scale of the run."""
    expect_one_of("peer", peer, PEERS)
    if weights is None:
        raise ValueError(f"weights: expected a file of {peer}'s weights, got none")
    path = Path(weights)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such weights file")
    named = (factor for name, factor in files.items() if path.as_posix().endswith(f"/{name}"))
    trained = PEERS[peer].checksums.get(file_hash(path)[:16]) or next(named, None)
    if trained is not None and scale != trained and scale in files.values() and float(scale).is_integer():
        raise ValueError(f"{path}: weights are for scale {trained:g}, the run is at scale {scale:g}")
    return load_peer(path, PEERS[peer], trained or nearest_scale(files.values(), scale))

"""LPIPS, against its own example pair and against AlexNet written out here, with random weights."""

import hashlib
import http.client
import io
import pickle
import socket
import urllib.error
from email.message import Message
from pathlib import Path

import numpy as np
import pytest
import torch
import torchmetrics.functional.image as heads_home
from bombs import Trap
from PIL import Image
from small_lpips import random_lpips, random_trunk
from torch import nn

from dsr.geometry.camera import Camera
from dsr.geometry.surface import depth_to_normals, render
from dsr.metrics import lpips
from dsr.metrics.functional import SurfacePair
from dsr.metrics.lpips import LPIPS, TRUNK_FILE, TRUNK_URL, find_trunk, load_lpips, lpips_v


@pytest.fixture(scope="module")
def network():
    return random_lpips()


def _images(seed, size=(40, 47), batch=1):
    return 2 * torch.rand(batch, 3, *size, generator=torch.Generator().manual_seed(seed)) - 1


def _reference(trunk, first, second, mask=None):
    """Return LPIPS v0.1, from torchvision's AlexNet as a stack of layers, in float64."""
    first_layers = nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)
    second_layers = nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)
    sizes = ((192, 384), (384, 256), (256, 256))
    others = [layer for size in sizes for layer in (nn.Conv2d(*size, 3, padding=1), nn.ReLU())]
    features = nn.Sequential(*first_layers, *second_layers, *others).double()
    features.load_state_dict({name.removeprefix("features."): value for name, value in trunk.items()})
    heads = torch.load(Path(heads_home.__file__).parent / "lpips_models" / "alex.pth", "cpu", weights_only=True)
    shift, scale = (
        torch.tensor(v).double().view(1, 3, 1, 1) for v in ((-0.030, -0.088, -0.188), (0.458, 0.448, 0.450))
    )
    x, y = ((image.double() - shift) / scale for image in (first, second))
    total = torch.zeros(len(x), dtype=torch.float64)
    level = 0
    for i, layer in enumerate(features):
        x, y = layer(x), layer(y)
        if i in (1, 4, 7, 9, 11):  # relu1 ... relu5
            difference = (nn.functional.normalize(x, dim=1) - nn.functional.normalize(y, dim=1)) ** 2
            maps = nn.functional.conv2d(difference, heads[f"lin{level}.model.1.weight"].double())[:, 0]
            weight = torch.ones_like(maps)
            if mask is not None:
                weight = torch.stack([_shares(m[0], maps.shape[-2:]) for m in mask])
            total += (maps * weight).sum(dim=(1, 2)) / weight.sum(dim=(1, 2))
            level += 1
    return total.detach()


def _shares(mask, size):
    """Return the share of known pixels of each feature's part of the picture."""
    height, width = mask.shape
    shares = torch.empty(size, dtype=torch.float64)
    for i, j in np.ndindex(*size):
        top, bottom = i * height // size[0], -(-(i + 1) * height // size[0])
        left, right = j * width // size[1], -(-(j + 1) * width // size[1])
        shares[i, j] = mask[top:bottom, left:right].double().mean()
    return shares


@pytest.mark.parametrize(("name", "expected"), [("ex_p0", 0.7219), ("ex_p1", 0.1376)])
def test_example_pairs_of_the_authors_have_the_published_distance(shared, name, expected):
    def picture(stem):
        with Image.open(shared / "lpips_example" / f"{stem}.png") as image:
            return torch.from_numpy(np.array(image.convert("RGB"))).permute(2, 0, 1)[None].float() / 127.5 - 1

    with torch.no_grad():
        network = load_lpips(shared / "weights" / "alexnet_imagenet_features.pth")
        assert network(picture("ex_ref"), picture(name)).item() == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("size", [(31, 31), (40, 47), (64, 33)])
def test_distance_equals_that_of_alexnets_normalised_features(network, size):
    first, second = _images(1, size, 2), _images(2, size, 2)
    torch.testing.assert_close(
        network(first, second).double(), _reference(random_trunk(), first, second), rtol=1e-4, atol=0
    )


def test_masked_features_are_weighted_by_the_valid_fraction_of_their_pixels(network):
    first, second = _images(1, batch=2), _images(2, batch=2)
    mask = torch.rand(2, 1, 40, 47, generator=torch.Generator().manual_seed(3)) > 0.3
    mask[0, :, :20] = False
    expected = _reference(random_trunk(), first, second, mask)
    torch.testing.assert_close(network(first, second, mask).double(), expected, rtol=1e-4, atol=0)


def test_features_that_are_all_zero_have_a_finite_gradient():
    trunk = random_trunk()
    for name in trunk:
        if name.endswith("bias"):
            trunk[name] = torch.full_like(trunk[name], -100.0)
    first = _images(1).requires_grad_()
    distance = LPIPS(trunk)(first, _images(2))
    assert distance.item() == 0
    distance.sum().backward()
    assert bool(first.grad.isfinite().all())


@pytest.mark.parametrize("holes", [False, True])
def test_lpips_v_is_the_distance_of_each_lights_rendering_in_three_channels(network, holes):
    random = np.random.default_rng(0)
    prediction, target = (torch.from_numpy(2 + 0.05 * random.random((1, 1, 36, 40))) for _ in range(2))
    if holes:
        target[..., 4:20, 6:16] = torch.nan
    pair = SurfacePair(prediction, target, Camera(40, 36, 40.0, 40.0, 20.0, 18.0).rays()[None])
    depths = (torch.where(pair.depth_mask, depth, torch.nan) for depth in (pair.prediction, pair.target))
    renderings = [render(depth_to_normals(depth, pair.rays)).nan_to_num(nan=0) for depth in depths]
    values = lpips_v(pair, network)
    assert values.shape == (1, 4)
    for light in range(4):
        first, second = (2 * maps[:, light : light + 1].expand(-1, 3, -1, -1) - 1 for maps in renderings)
        expected = _reference(random_trunk(), first, second, pair.normal_mask)
        torch.testing.assert_close(values[:, light].double(), expected, rtol=1e-4, atol=0)


def test_missing_or_misshapen_tensor_is_refused_by_name():
    trunk = random_trunk()
    del trunk["features.8.bias"]
    with pytest.raises(ValueError, match=r"features.8.bias: expected"):
        LPIPS(trunk)
    with pytest.raises(ValueError, match=r"features.0.weight: expected"):
        LPIPS(random_trunk() | {"features.0.weight": torch.zeros(64, 3, 7, 7)})


DAMAGES = {
    "text": lambda path: path.write_bytes(b"<html>404 not found</html>\nsecond line\n"),
    "cut": lambda path: (torch.save(random_trunk(), path), path.write_bytes(path.read_bytes()[:-5000])),
    "list": lambda path: torch.save([1], path),
    "other": lambda path: torch.save({"state": torch.ones(2)}, path),
    "trap": lambda path: path.write_bytes(pickle.dumps(Trap(path.parent / "sprung"))),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_damaged_or_foreign_weights_file_is_refused_in_one_line(tmp_path, kind):
    path = tmp_path / "alexnet.pth"
    DAMAGES[kind](path)
    with pytest.raises(ValueError, match=r"expected (the weights|a torch file|a network's tensors)") as caught:
        load_lpips(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "sprung").exists()


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """Return torch's hub cache, empty, in a place of its own."""
    monkeypatch.setattr(torch.hub, "_hub_dir", str(tmp_path / "hub"))
    return tmp_path / "hub" / "checkpoints"


class _Response(io.BytesIO):
    """A download: its bytes, and then an error or the end."""

    def __init__(self, content, error=None):
        super().__init__(content)
        self.error = error
        self.headers = Message()
        self.headers["Content-Length"] = str(len(content))

    def info(self):
        return self.headers

    def read(self, size=-1):
        part = super().read(size)
        if not part and self.error is not None:
            raise self.error
        return part


def test_download_goes_into_the_cache_and_is_left_out_for_configured_or_cached_weights(hub, tmp_path, monkeypatch):
    content, asked = b"weights", []
    monkeypatch.setattr(lpips, "TRUNK_HASH", hashlib.sha256(content).hexdigest()[:8])

    def respond(request, *_, **__):
        asked.append(request.full_url)
        return _Response(content)

    monkeypatch.setattr(torch.hub, "urlopen", respond)
    (tmp_path / "mine.pth").touch()
    assert find_trunk(tmp_path / "mine.pth") == tmp_path / "mine.pth"
    assert find_trunk(None).read_bytes() == content
    assert find_trunk(None) == hub / TRUNK_FILE
    assert asked == [TRUNK_URL]


FAILURES = {
    "offline": urllib.error.URLError("no route to host"),
    "incomplete": _Response(b"half of it", http.client.IncompleteRead(b"", 7)),
    "hash": _Response(b"another file altogether"),
}


@pytest.mark.parametrize("kind", FAILURES)
def test_failed_download_is_an_os_error_and_leaves_nothing(hub, monkeypatch, kind):
    def respond(*_, **__):
        if isinstance(FAILURES[kind], Exception):
            raise FAILURES[kind]
        return FAILURES[kind]

    before = socket.getdefaulttimeout()
    monkeypatch.setattr(torch.hub, "urlopen", respond)
    with pytest.raises(OSError, match="could not be downloaded"):
        find_trunk(None)
    assert list(hub.iterdir()) == []
    assert socket.getdefaulttimeout() == before

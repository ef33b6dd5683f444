"""ZipDepth: what its authors' code computes, their files, and the fit to the low-resolution map."""

from __future__ import annotations

import math
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from small_scenes import plane, random_scene, sample_of
from torch import Tensor

from dsr.methods.base import NoSolutionError
from dsr.methods.networks.zipdepth import Sizes, ZipDepth, ZipDepthMonocular
from dsr.methods.recipe import read_recipe
from dsr.utils.configuration import ConfigError

CHANNELS, BLOCKS = (8, 16, 24, 32), (1, 2, 1, 2)
AUTHORS = {
    True: [
        2.13381, 1.7389, 1.9248, 1.98179, 2.00208, 1.69398, 2.84532, 2.18414, 2.20237, 2.4901, 2.67719, 2.342,
        2.89038, 2.12622, 2.66656, 2.42447, 2.61732, 2.55095, 3.18594, 2.93172, 3.00687, 2.96766, 3.66777, 3.07056,
    ],
    False: [
        2.14019, 2.32881, 2.17948, 2.16385, 2.07059, 2.37012, 2.52514, 2.26719, 2.57527, 2.31118, 2.42973, 2.35174,
        2.68437, 2.46446, 2.76725, 2.79053, 3.03853, 2.98774, 2.98643, 2.68085, 3.11133, 3.12043, 3.49823, 3.3948,
    ],
}  # fmt: skip
"""Results of fabiotosi92/ZipDepth at commit a302e54 with the parameters of :func:`parameters`, at some pixels."""


def parameters(*, unfold: bool = True) -> dict[str, Tensor]:
    """Return values that depend on the names of the parameters alone."""
    with torch.device("meta"):
        shapes = {
            name: each.shape for name, each in ZipDepth(Sizes(CHANNELS, BLOCKS, 6, 8, unfold)).state_dict().items()
        }
    found = {}
    for name, shape in shapes.items():
        random = np.random.default_rng(zlib.crc32(name.encode()))
        kernel = len(shape) == 4 and name.endswith("weight")
        values = (
            random.normal(0, math.sqrt(2 / math.prod(shape[1:])), shape) if kernel else random.uniform(0.5, 1.5, shape)
        )
        found[name] = torch.from_numpy(values).float()
    return found


@pytest.mark.parametrize("unfold", [True, False])
@pytest.mark.parametrize("prefix", ["", "module._orig_mod."])
def test_network_computes_what_its_authors_code_does(tmp_path: Path, *, unfold: bool, prefix: str) -> None:
    tensors = {prefix + name: value for name, value in parameters(unfold=unfold).items()}
    tensors |= {f"{prefix}encoder.stem_half.bn.num_batches_tracked": torch.tensor(7), "edges.weight": torch.ones(3)}
    torch.save({"epoch": 3, "model_state_dict": tensors} if prefix else tensors, tmp_path / "net.pth")
    rgb = torch.from_numpy(np.random.default_rng(0).uniform(0, 1, (1, 3, 64, 96))).float()
    found = ZipDepthMonocular(tmp_path / "net.pth", size=64).relative(rgb)
    torch.testing.assert_close(found[0, 0, 3::16, 5::16].flatten(), torch.tensor(AUTHORS[unfold]), rtol=0, atol=1e-4)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    torch.save(parameters(), tmp_path / "zipdepth_base.pth")
    return tmp_path / "zipdepth_base.pth"


def test_photo_keeps_its_shape_at_multiples_of_32(file: Path) -> None:
    seen: list[torch.Size] = []
    method = ZipDepthMonocular(file, size=64)
    method.net.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].shape[2:]))
    for size in ((100, 150), (150, 100), (40, 41), (64, 200)):
        assert method.relative(torch.rand(1, 3, *size)).shape == (1, 1, *size)
    assert seen == [(64, 96), (96, 64), (64, 64), (64, 192)]


def test_result_is_fitted_without_the_truth(file: Path) -> None:
    rgb = random_scene(64, 96)[1]
    method = ZipDepthMonocular(file, size=64)
    relative = method.relative(rgb[None])[0, 0].double()
    problem = sample_of(5 + 2 * relative, rgb, scale=4)  # disparities that rise with the network's result
    truth = problem.depth
    assert truth is not None
    object.__setattr__(problem, "depth", None)
    problem.depth_lr[:, 2:5, 3:9] = torch.nan
    torch.testing.assert_close(method(problem), truth, rtol=1e-3, atol=0)
    assert "affine" in method.describe(problem)
    with pytest.raises(NoSolutionError, match=r"zipdepth_base.pth: expected values that rise"):
        method(sample_of(30 - 2 * relative, rgb, scale=4))


def test_directory_of_the_authors_files_is_enough(file: Path) -> None:
    problem = sample_of(plane(64, 96), random_scene(64, 96)[1])
    recipe = read_recipe("zipdepth", {"size": 64}).with_weights(file.parent)
    assert recipe.weights(4) == file
    assert read_recipe("zipdepth", {"weights": str(file.parent)}).weights(4) == file
    assert isinstance(recipe.build(4), ZipDepthMonocular)
    assert recipe.build(4).abilities.takes(problem.scale)
    with pytest.raises(ConfigError, match=r"weights: method=zipdepth: .* needs weights=FILE, .*zipdepth_base.pth"):
        read_recipe("zipdepth").weights(4)
    with pytest.raises(ConfigError, match=r"method.size: expected 32 or more, got 16"):
        read_recipe("zipdepth", {"size": 16}).with_weights(file).build(4)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([1, 2], r"net.pth: expected the tensors of ZipDepth, got those of another network"),
        ({"model_state_dict": {"a": 1}}, r"net.pth: expected the tensors of ZipDepth by name"),
        ({"weight": torch.ones(2)}, r"net.pth: expected the tensors of ZipDepth, got those of another network"),
    ],
)
def test_file_of_something_else_is_named(tmp_path: Path, content: object, message: str) -> None:
    torch.save(content, tmp_path / "net.pth")
    with pytest.raises(ValueError, match=message):
        ZipDepthMonocular(tmp_path / "net.pth")


def test_file_without_a_tensor_or_with_numbers_that_are_none_is_named(tmp_path: Path) -> None:
    tensors = parameters()
    for name, value in (("decoder.head_half.bias", None), ("decoder.head_half.bias", torch.tensor([torch.nan]))):
        changed = {key: each for key, each in tensors.items() if key != name} | ({} if value is None else {name: value})
        torch.save(changed, tmp_path / "net.pth")
        with pytest.raises(
            ValueError, match=rf"net.pth: expected the tensors of ZipDepth, but {name} (is missing|holds)"
        ):
            ZipDepthMonocular(tmp_path / "net.pth")

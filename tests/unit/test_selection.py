"""Methods of fixed factors at other scales: what ``dsr.upsample`` gives, and a note."""

from typing import Any

import pytest
import safetensors.torch
import torch
from omegaconf import OmegaConf
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.inference import upsample_surface, upsampler
from dsr.inference.any_ratio import AnyRatio, Selection
from dsr.methods.base import Method, Surface
from dsr.methods.recipe import Recipe, Run, read_recipe
from dsr.sample import DepthSample
from dsr.utils.progress import Steps

CAMERA = Camera(48, 36, 50.0, 50.0, 23.5, 17.5)


def _sample(width: int, height: int, hole: bool = False) -> DepthSample:
    generator = torch.Generator().manual_seed(0)
    depth_lr = 2 + torch.linspace(0, 1, width).expand(1, height, width).clone()
    if hole:
        depth_lr[0, 2, 3] = torch.nan
    photo = torch.rand(3, 36, 48, generator=generator)
    scale = CAMERA.ratio_to(width, height)
    return DepthSample("set", "hall", photo, depth_lr, CAMERA, CAMERA.reduce(width, height), scale)


@pytest.mark.parametrize(
    ("name", "scales"),
    [
        ("bicubic", (1, 1.5, 2, 3)), ("guided_filter", (1, 1.5, 2, 3)), ("joint_bilateral", (1, 1.5, 2, 3)),
        ("fast_global_smoother", (1, 1.5, 2, 3)), ("bilateral", (1, 1.5, 2, 3)), ("dornet", (1, 1.5, 2, 3)),
        ("tgv", (1, 2, 3)), ("dip", (1, 2, 3)), ("dip_v", (1, 2, 3)),
        ("facets_box", (2,)), ("srfs", (2,)), ("eg", (2,)),
    ],
)  # fmt: skip
def test_methods_take_the_scales_that_they_are_made_for(name: str, scales: tuple[float, ...]) -> None:
    abilities = read_recipe(name).abilities
    assert tuple(scale for scale in (1, 1.5, 2, 3) if abilities.takes(scale)) == scales


def test_method_that_reproduces_block_means_only_fills_holes_at_a_scale_of_1() -> None:
    sample = _sample(48, 36, hole=True)
    depth = read_recipe("tgv", {"iterations": 50}).build(4)(sample)
    valid = sample.mask_lr
    torch.testing.assert_close(depth[valid], sample.depth_lr[valid], rtol=1e-5, atol=0)
    assert bool(depth.isfinite().all())


@pytest.mark.parametrize("name", ["tgv", "eg", "srfs"])
def test_method_of_whole_scales_refuses_another_by_itself(name: str) -> None:
    with pytest.raises(ValueError, match=r"^hall: expected a whole scale for this method, got 1\.5$"):
        read_recipe(name).build(4)(_sample(32, 24))


def _resized(name: str, scale: float, settings: dict[str, Any] | None = None) -> Selection:
    return Selection(read_recipe(name, settings), scale, direct=False)


@pytest.mark.parametrize("size", [(48, 36), (32, 24)])
@pytest.mark.parametrize("name", ["facets_box", "eg"])
def test_method_at_another_scale_gives_what_upsample_gives(name: str, size: tuple[int, int]) -> None:
    sample = _sample(*size, hole=True)
    settings = {"ensemble": 1} if name == "facets_box" else {"radius": 2}
    depth = _resized(name, sample.scale, settings).build(Run())(sample)
    expected = upsample_surface(
        sample.rgb,
        sample.depth_lr,
        CAMERA,
        method=name,
        settings=settings,
        device="cpu",
        fill="none" if name == "eg" else "all",
    ).depth
    assert torch.equal(depth.isnan(), expected.isnan())
    assert torch.equal(depth.nan_to_num(), expected.nan_to_num())
    assert bool(depth.isnan().any()) == (name == "eg")


class Sure(Method):
    """Repeats pixels, and says that it is off by a tenth of the depth."""

    def __call__(self, sample: DepthSample, progress: Steps | None = None) -> Tensor:
        return sample.depth_lr.repeat_interleave(4, 1).repeat_interleave(4, 2)

    def surface(self, sample: DepthSample, progress: Steps | None = None) -> Surface:
        depth = self(sample, progress)
        return Surface(depth, depth / 10, torch.full_like(depth, 7.0))


@pytest.mark.parametrize("size", [(12, 9), (16, 12), (48, 36)])
def test_method_of_fixed_factors_states_its_own_errors(size: tuple[int, int]) -> None:
    sample = _sample(*size)
    recipe = Recipe("sure", OmegaConf.create({"_target_": f"{__name__}.Sure"}))
    surface = AnyRatio(recipe, torch.device("cpu"), scale=4).upsample(sample.rgb, sample.depth_lr, CAMERA)
    assert surface.depth_error is not None
    assert surface.angle_error is not None
    torch.testing.assert_close(surface.depth_error, surface.depth / 10)
    assert bool((surface.angle_error == 7).all())


def test_upsampler_loads_its_weights_once(monkeypatch: pytest.MonkeyPatch) -> None:
    load, read = safetensors.torch.load, []
    monkeypatch.setattr(safetensors.torch, "load", lambda data: (read.append(len(data)), load(data))[1])
    run, sample = upsampler("facets_box", device="cpu"), _sample(12, 9)
    first, second = (run.upsample(sample.rgb, sample.depth_lr, CAMERA).depth for _ in range(2))
    assert len(read) == 1
    assert torch.equal(first, second)

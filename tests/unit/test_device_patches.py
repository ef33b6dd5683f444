"""Patches made on the training's device, a batch at a time: those of the CPU, but for the values of random fields."""

from dataclasses import replace

import lightning
import numpy as np
import pytest
import torch
from pretend_cuda import pretend_cuda
from scipy import ndimage, stats
from small_scenes import SceneList, sample_of

from dsr.degradation.downsampling import KERNELS, Downsampling
from dsr.degradation.holes import HOLES
from dsr.degradation.noise import NOISES, GaussianMultiplicative, Kinect
from dsr.degradation.random_degradation import Everything
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.msg_net import MSGNet
from dsr.sample import Scene
from dsr.training.data_module import Part, PatchData
from dsr.training.degradation import Degradation
from dsr.training.device_patches import DevicePatches, blur, made_by_workers, normal_field
from dsr.training.module import SuperResolution
from dsr.training.objective import DepthObjective, SurfaceObjective
from dsr.training.patches import Patches
from dsr.training.settings import PatchSettings

CPU = torch.device("cpu")
CLEAN = dict.fromkeys(("folds", "relief", "displaced", "rounded", "soft", "photo", "textured", "clear"), 0)
UNMADE = tuple(name for name in CLEAN if name != "relief")
CLEAN |= {
    "kernels": dict.fromkeys(KERNELS, 1),
    "noises": {"none": 1, **dict.fromkeys(NOISES, 0)},
    "holes": {"none": 1, **dict.fromkeys(HOLES, 0)},
}


def _scene(number, height=48, width=64):
    """Return a scene of waves before a slope, by a stereo camera whose disparities have an offset."""
    v, u = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    generator = torch.Generator().manual_seed(number)
    rgb = (255 * torch.rand(3, height, width, generator=generator)).round() / 255
    sample = sample_of(6 + number + 0.02 * u + 0.3 * torch.sin(v / 7) + 2 * (u > 30 + v / 4), rgb)
    return Scene("set", f"scene{number}", rgb, replace(sample.camera, doffs=0.7), sample.depth)


def _patches(kind, settings=None, degradation=None, everything=None, **named):
    settings = settings or PatchSettings(patch=32, photo=0)
    groups = [[_scene(0), _scene(1, 40, 52)], [_scene(2)]]
    degradation = degradation or Degradation(4, Downsampling("box"))
    made = kind(groups, settings, degradation, shares=[0.3, 0.7], seed=4, everything=everything, **named)
    if kind is DevicePatches:
        made.store(CPU)
    return made


def _made(patches, numbers):
    return patches.make(patches.collate([patches[number] for number in numbers]))


@pytest.mark.parametrize("kernel", KERNELS)
def test_patches_without_noise_are_those_of_workers(kernel):
    degradation = Degradation(4, Downsampling(kernel))
    here, there = (_patches(kind, degradation=degradation) for kind in (Patches, DevicePatches))
    batch = _made(there, range(24))
    for number in range(24):
        for name, value in here[number].items():
            rough = 1e-3 if name == "rgb" else 1e-6 * float(value.abs().max())
            torch.testing.assert_close(batch[name][number], value, rtol=2e-5, atol=rough, msg=name)


def test_patch_is_a_function_of_its_number_whatever_batch_it_is_in():
    settings = PatchSettings(patch=32, photo=0.5)
    patches = _patches(DevicePatches, settings, Degradation(4, Downsampling("bicubic"), GaussianMultiplicative(0.02)))
    together, alone = _made(patches, [5, 2, 9]), _made(patches, [2])
    for name, value in alone.items():
        if name != "kernels":
            torch.testing.assert_close(together[name][1], value[0], rtol=1e-5, atol=1e-6, msg=name)
    assert not torch.equal(together["disparity_lr"][0], together["disparity_lr"][2])


def test_noise_of_maps_is_as_strong_as_its_model_says():
    noise = GaussianMultiplicative(0.02)
    clean, noisy = (
        _patches(DevicePatches, degradation=Degradation(4, Downsampling("box"), each)) for each in (None, noise)
    )
    ratio = _made(noisy, range(64))["disparity_lr"] / _made(clean, range(64))["disparity_lr"] - 1
    assert float(ratio.mean()) == pytest.approx(0, abs=0.001)
    assert float(ratio.std()) == pytest.approx(0.02, rel=0.03)


def test_random_fields_are_normal_independent_and_functions_of_their_seeds():
    seeds = torch.tensor([3, 4, 3])
    field = normal_field(seeds, torch.Size((3, 1, 200, 200))).double()
    assert torch.equal(field[0], field[2])
    first, second = (each.flatten().numpy() for each in field[:2])
    assert stats.kstest(first, "norm").pvalue > 0.01
    for a, b in ((first, second), (first[1:], first[:-1]), (first[200:], first[:-200])):
        assert abs(np.corrcoef(a, b)[0, 1]) < 0.02


def test_blur_is_scipy_s_and_keeps_the_variance_of_noise():
    images, sigmas = torch.rand(3, 2, 30, 30), torch.tensor([0.0, 0.6, 1.0])
    found = blur(images, sigmas, (4 * sigmas + 0.5).floor())
    for each, image, sigma in zip(found, images, sigmas.tolist(), strict=True):
        expected = ndimage.gaussian_filter(image.numpy(), (0, sigma, sigma), mode="nearest")
        np.testing.assert_allclose(each, expected, atol=1e-6)
    noise = torch.randn(1, 1, 400, 400, generator=torch.Generator().manual_seed(0))
    assert float(blur(noise, torch.tensor([1.5]), torch.tensor([6.0]), power=2).std()) == pytest.approx(1, abs=0.02)


def test_random_kernels_noise_relief_and_hints_are_distributed_as_workers_make_them():
    noises = {"none": 0.5, "white": 0.5, **{name: 0 for name in NOISES if name != "white"}}
    everything = Everything(**{**CLEAN, "noises": noises, "relief": 0.5})
    settings, count = PatchSettings(patch=32, photo=0), 400
    here = [_patches(Patches, settings, everything=everything)[number] for number in range(count)]
    there = _made(_patches(DevicePatches, settings, everything=everything), range(count))

    def describe(facts, disparity, noise):
        change = (disparity[..., 1:] / disparity[..., :-1]).log().abs()
        return [
            facts.mean(0).tolist(),
            [float(change.median().log10())],
            [float((noise.amax((1, 2, 3)) > 0).float().mean())],
        ]

    names = ("facts", "disparity_lr", "noise")
    expected = describe(*(torch.stack([each[name] for each in here]) for name in names))
    for a, b in zip(describe(*(there[name] for name in names)), expected, strict=True):
        np.testing.assert_allclose(a, b, atol=0.08)
    assert there["soft"].tolist() == [0] * count


@pytest.mark.parametrize(
    ("change", "key"),
    [({"noise": Kinect()}, "noise"), ({"noise": GaussianMultiplicative(0.3)}, "noise"),
     ({"downsampling": Downsampling("box", range_type="orthogonal")}, "downsampling"),
     *(({"everything": {name: 0.1}}, f"degradation.{name}") for name in UNMADE),
     ({"everything": {"holes": {"none": 1, "blobs": 1}}}, "degradation.holes"),
     ({"everything": {"noises": {"stereo": 1}}}, "degradation.noises"),
     ({"everything": {"kernels": {"spread": 1}}}, "degradation.kernels"),
     ({"everything": {"scales": {1: 1, 2: 1}}}, "degradation.scales"),
     ({"everything": {}}, ""), ({}, "")],
)  # fmt: skip
def test_what_workers_alone_make_is_named(change, key):
    everything = Everything(**{**CLEAN, **change["everything"]}) if "everything" in change else None
    degradation = Degradation(4, change.get("downsampling", Downsampling("box")), change.get("noise"))
    assert made_by_workers(degradation, everything).startswith(key)
    assert bool(made_by_workers(degradation, everything)) == bool(key)


def _data(*scenes, device="cpu", everything=None, **settings):
    named = {"patch": 32, "batch": 2, "validation_scenes": 1, **settings}
    degradation = Degradation(4, Downsampling("box"))
    parts = [Part(SceneList(scenes or map(_scene, range(3))))]
    return PatchData(parts, PatchSettings(**named), degradation, everything=everything, device=device)


def test_holes_of_a_truth_are_left_to_workers_and_refused_where_a_device_is_to_make_the_patches():
    holed = _scene(0)
    depth = holed.depth.clone()
    depth[:, 3, 3] = torch.nan
    scenes = replace(holed, depth=depth), _scene(1)
    with pytest.raises(ValueError, match=r"^on_device: .* a true depth with holes is left"):
        _data(*scenes, on_device=True).setup()
    with pytest.raises(ValueError, match=r"^on_device: .* degradation\.folds is left"):
        _data(on_device=True, everything=Everything())
    data = _data(*scenes, device="cuda", on_device="auto")
    data.setup()
    assert "places" not in data.first_patches(1)[0]


@pytest.mark.parametrize("net", [MSGNet, FacetsUNet])
@pytest.mark.filterwarnings(
    "ignore:.*does not have many workers", "ignore:.*LeafSpec", "ignore:.*`self.log", "ignore:.*not resumable"
)
def test_trainings_with_patches_of_the_device_learn_and_go_on_with_the_same_ones(net, tmp_path):
    everything = Everything(**CLEAN) if net is FacetsUNet else None
    objective = SurfaceObjective() if net is FacetsUNet else DepthObjective("lap1", 0.1)
    small = {"width": 8, "deep": 8} if net is FacetsUNet else {}
    weights = []
    for steps in ([3], [1, 3]):
        for last in steps:
            torch.manual_seed(0)
            module = SuperResolution(net(4, **small), objective)
            trainer = lightning.Trainer(
                max_steps=last, accelerator="cpu", logger=False, enable_progress_bar=False, limit_val_batches=0,
                default_root_dir=tmp_path, enable_model_summary=False, enable_checkpointing=False,
            )  # fmt: skip
            again = tmp_path / "last.ckpt" if last != steps[0] else None
            trainer.fit(module, _data(on_device=True, everything=everything), ckpt_path=again)
            trainer.save_checkpoint(tmp_path / "last.ckpt")
        weights.append(module.net.state_dict())
    for name, value in weights[0].items():
        assert torch.equal(weights[1][name], value), name


def test_gpu_makes_the_patches_that_the_cpu_makes():
    patches = _patches(DevicePatches, PatchSettings(patch=32), everything=Everything(**{**CLEAN, "relief": 1}))
    expected = _made(patches, range(4))
    with pretend_cuda() as gpu:
        patches.store(gpu)
        drawn = patches.collate([patches[number] for number in range(4)])
        found = patches.make({k: v.to(gpu) if isinstance(v, torch.Tensor) else v for k, v in drawn.items()})
        for name, value in expected.items():
            if isinstance(value, torch.Tensor):
                torch.testing.assert_close(found[name].cpu(), value, rtol=1e-4, atol=1e-5, msg=name)

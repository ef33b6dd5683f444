"""Nothing is left behind on the CPU: methods, samples, metrics and trainings on a GPU, a pretended one by default.

The results have to be those of the CPU. ``DSR_DEVICE=cuda`` runs the same tests on a real GPU.
"""

import contextlib
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from methods_at_hand import AT_HAND, SLOW, build
from pretend_cuda import pretend_cuda
from small_lpips import random_lpips
from small_scenes import sample_of
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten
from torch.utils.data import default_collate

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.degradation.holes import Blobs, Shadows
from dsr.degradation.noise import GaussianMultiplicative, Kinect, TimeOfFlight
from dsr.degradation.random_degradation import Everything
from dsr.inference import upsample_surface
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.msg_net import MSGNet
from dsr.metrics import evalmde
from dsr.metrics.catalogue import PROTOCOLS, catalogue, score_image
from dsr.metrics.classes import compute_means, visual_metrics
from dsr.metrics.functional import SurfacePair
from dsr.sample import CENTIMETRES, Scene
from dsr.training.degradation import Degradation
from dsr.training.module import SuperResolution
from dsr.training.objective import DepthObjective, SurfaceObjective
from dsr.training.patches import Patches
from dsr.training.settings import PatchSettings
from dsr.utils.compute_device import in_own_precision, pick_device
from dsr.utils.configuration import ConfigError

METHODS = [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in AT_HAND]
CPU = torch.device("cpu")


@pytest.fixture
def gpu(device):
    """The device of $DSR_DEVICE, or a pretended GPU where that is the CPU."""
    if device.type != "cpu":
        yield device
        return
    with pretend_cuda() as pretended:
        yield pretended


def _sample(size=48):
    """Return a slope and a nearer plate with an oblique edge, and a photo that shows it, waves and noise."""
    v, u = torch.meshgrid(*2 * [torch.arange(size).double()], indexing="ij")
    near = u > 0.6 * v + 9
    disparity = torch.where(near, 9 - 0.01 * v, 5 + 0.02 * u)
    noise = torch.rand(3, size, size, generator=torch.Generator().manual_seed(0))
    rgb = (0.3 + 0.4 * near + 0.1 * torch.sin(u / 3) + 0.1 * noise).float()
    return sample_of(disparity, rgb)


def _on(sample, device):
    return replace(sample, **{name: getattr(sample, name).to(device) for name in ("rgb", "depth_lr", "depth")})


@pytest.mark.parametrize("name", METHODS)
def test_method_predicts_on_a_gpu_what_it_predicts_on_the_cpu(name, tmp_path, gpu):
    sample = _sample(96 if name == "eg" else 48)
    expected = build(name, tmp_path)(sample)
    method = build(name, tmp_path, gpu)
    for given in (_on(sample, gpu),) if name in SLOW else (sample, _on(sample, gpu)):
        found = method(given)
        assert found.device == given.depth_lr.device
        torch.testing.assert_close(found.cpu(), expected, rtol=1e-3, atol=1e-3, equal_nan=True)


@pytest.mark.parametrize("noise", [Kinect(), TimeOfFlight(), GaussianMultiplicative(0.01)])
@pytest.mark.parametrize("holes", [Blobs(), Shadows()])
def test_scene_of_a_gpu_is_degraded_like_one_of_the_cpu(noise, holes, gpu):
    """The random numbers are the CPU's, so that a seed gives the same map on all devices."""
    sample, found = _sample(), []
    for device in (CPU, gpu):
        scene = Scene("set", "hall", sample.rgb.to(device), sample.camera, sample.depth.to(device))
        made = make_sample(scene, 4, Downsampling("box"), "disparity", noise, 0, holes)
        assert made.depth_lr.device.type == device.type
        found.append(made.depth_lr.cpu())
    torch.testing.assert_close(found[1], found[0], equal_nan=True)


def _pair(device):
    """Return two maps, of which the first one has holes, and their truth."""
    sample, generator = _sample(), torch.Generator().manual_seed(1)
    target = sample.depth[None].repeat(2, 1, 1, 1)
    prediction = target + 0.01 * torch.randn(target.shape, generator=generator, dtype=target.dtype)
    prediction[0, :, 5:9, 3:11] = torch.nan
    return SurfacePair(prediction.to(device), target.to(device), sample.camera.rays(device=device)[None])


@pytest.mark.slow
def test_metrics_have_the_values_of_the_cpu(gpu, monkeypatch):
    monkeypatch.setattr(evalmde, "PAIRS", 10**4)  # whose drawing takes most of the time
    monkeypatch.setattr(evalmde, "sobol_pairs", evalmde.sobol_pairs.__wrapped__)  # so few are not kept for others
    network, found = random_lpips(), []
    for device in (CPU, gpu):
        pair, metrics = _pair(device), catalogue(network.to(device), (), tuple(PROTOCOLS))
        prediction, target = pair.given
        scores = score_image(prediction[0], target[0], pair.rays[0], metrics)
        means = visual_metrics(network, (), tuple(PROTOCOLS)).to(device)
        means.update(SurfacePair(prediction[1:], target[1:], pair.rays))
        found.append([each.value for each in scores] + [float(each) for each in compute_means(means).values()])
        network.to(CPU)
    np.testing.assert_allclose(found[1], found[0], rtol=1e-4)
    assert len(found[0]) > 40


@pytest.mark.slow
@pytest.mark.parametrize("model", ["facets", "msg_v"])
@pytest.mark.filterwarnings("ignore:You are trying to `self.log.*")
def test_training_step_on_a_gpu_is_that_of_the_cpu(model, gpu):
    net, objective, everything = {
        "facets": (FacetsUNet, SurfaceObjective(), Everything()),
        "msg_v": (MSGNet, DepthObjective("lap1", 0.1, shading=0.1), None),
    }[model]
    sample, degradation = _sample(), Degradation(4, Downsampling("box"), GaussianMultiplicative(0.01))
    scene = Scene("set", "hall", sample.rgb, sample.camera, sample.depth)
    patches = Patches([[scene]], PatchSettings(patch=32, batch=2), degradation, everything=everything)
    batch, found = default_collate([patches[0], patches[1]]), []
    for device in (CPU, gpu):
        torch.manual_seed(0)
        module = SuperResolution(net(4), objective).to(device)
        moved = {key: value.to(device) for key, value in batch.items()}
        loss = module.training_step(moved, 0)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(module.net.parameters(), 1.0)
        module.configure_optimizers().step()
        with torch.no_grad():
            module.validation_step({**moved, "unit": asdict(CENTIMETRES)}, 0)
        means = compute_means(module.metrics[0])
        found.append([float(each.detach()) for each in (loss, norm, *means.values())])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-3)


class _Operations(TorchDispatchMode):
    """Counts operations that launch something, and notes those that a GPU's queue would have to be waited for."""

    def __init__(self):
        super().__init__()
        self.count, self.waits = 0, []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += not func.is_view
        tensors = [each for each in tree_flatten((args, kwargs or {}))[0] if isinstance(each, torch.Tensor)]
        name = func.overloadpacket.__name__
        if name in ("_local_scalar_dense", "nonzero") or any(each.device.type == "cpu" for each in tensors):
            self.waits.append(name)
        return func(*args, **(kwargs or {}))


def test_step_of_facets_waits_for_no_gpu_and_takes_as_many_operations_for_any_batch():
    sample, degradation = _sample(64), Degradation(4, Downsampling("box"))
    scene, counts = Scene("set", "hall", sample.rgb, sample.camera, sample.depth), []
    patches = Patches([[scene]], PatchSettings(patch=32), degradation, everything=Everything())
    with pretend_cuda() as gpu:
        module = SuperResolution(FacetsUNet(4, width=8, deep=8), SurfaceObjective()).to(gpu)
        optimizer = torch.optim.AdamW(module.net.parameters(), fused=True)
        for size in (1, 6):
            for warm, numbers in ((False, range(24)), (True, range(24, 24 + size))):  # all kernels, then other images
                batch = module.net.prepare(default_collate([patches[number] for number in numbers]))
                moved = {key: each.to(gpu) if isinstance(each, torch.Tensor) else each for key, each in batch.items()}
                operations = _Operations()
                with operations if warm else contextlib.nullcontext():
                    module.loss_terms(moved)["loss"].backward()
                    optimizer.step()
                    optimizer.zero_grad()
            counts.append(operations.count)
            assert operations.waits == []
    assert counts[1] < 1.15 * counts[0]
    assert counts[1] < 1500


@pytest.mark.parametrize(("net", "breaks"), [(MSGNet, 0), pytest.param(FacetsUNet, 1, marks=pytest.mark.nightly)])
@pytest.mark.filterwarnings("ignore")
def test_network_is_one_graph_beside_what_differs_from_step_to_step(net, breaks):
    """Its C++ is not compiled here, which takes minutes."""
    sample, everything = _sample(), Everything() if net is FacetsUNet else None
    scene = Scene("set", "hall", sample.rgb, sample.camera, sample.depth)
    patches = Patches([[scene]], PatchSettings(patch=32), Degradation(4, Downsampling("box")), everything=everything)
    small = {"width": 8, "deep": 8} if net is FacetsUNet else {}
    found, batch = [], default_collate([patches[0], patches[1]])
    torch._dynamo.utils.counters.clear()
    for compiled in (False, True):
        torch.manual_seed(0)
        network = net(4, **small).train()
        if compiled:
            network.compile(dynamic=False, backend="aot_eager")
        answer = network.answer_patches(network.prepare(batch)).disparity
        answer.sum().backward()
        found.append([answer.detach(), *(each.grad for each in network.parameters())])
    for before, after in zip(*found, strict=True):
        torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-4 * float(before.abs().max() + 1e-9))
    assert len(torch._dynamo.utils.counters["graph_break"]) == breaks


@pytest.mark.parametrize("method", ["facets", "bicubic"])
def test_any_photo_and_map_are_upsampled_on_a_gpu(method, gpu):
    sample = _sample()
    depth = sample.depth_lr.clone()
    depth[:, 2:4, 5:6] = torch.nan
    expected = upsample_surface(sample.rgb, depth, sample.camera, method=method, device="cpu")
    for device in (CPU, gpu):
        given = sample.rgb.to(device), depth.to(device), sample.camera
        found = upsample_surface(*given, method=method, device=str(gpu))
        assert found.depth.device == given[1].device
        for mine, other in zip(found[:3], expected[:3], strict=True):
            if other is not None:  # a GPU computes in bfloat16, and a processor without it in float32
                torch.testing.assert_close(mine.cpu(), other, rtol=5e-2, atol=1e-3, equal_nan=True)


def test_what_is_left_on_the_cpu_is_an_error_and_what_cuda_allows_is_none(gpu):
    here = torch.rand(8, 8)
    there = here.to(gpu)
    left = (
        lambda: there + here,
        lambda: nn.functional.conv2d(there[None, None], here[None, None, :3, :3]),
        lambda: here[there > 0],
        there.numpy,
        lambda: torch.randn(3, device=gpu, generator=torch.Generator()),
    )
    for act in left:
        with pytest.raises((RuntimeError, TypeError), match=r"device|cuda|numpy"):
            act()
    values = torch.arange(6.0, device=gpu)
    assert (values + torch.tensor(1.0))[torch.tensor([0, 1])][[1]].item() == 2
    values[torch.tensor([1])] = 7
    values[2:3].copy_(torch.tensor([9.0]))
    assert values.cpu().tolist() == [0, 7, 9, 3, 4, 5]


def test_auto_is_the_device_of_the_environment(monkeypatch, gpu):
    for name, device in (("cpu", CPU), (str(gpu), gpu)):
        monkeypatch.setenv("DSR_DEVICE", name)
        assert (pick_device("auto"), pick_device("cpu")) == (device, CPU)
    monkeypatch.setenv("DSR_DEVICE", "abacus")
    with pytest.raises(ConfigError, match=r"^\$DSR_DEVICE: expected auto, .*, got 'abacus'"):
        pick_device("auto")


def test_tf32_is_for_convolutions_of_those_who_ask_for_it_and_not_for_losses():
    backends = torch.backends.cudnn, torch.backends.cuda.matmul

    def used(_=None):
        return [backend.allow_tf32 for backend in backends]

    before = used()
    with pretend_cuda():
        for precision, expected in (("tf32", [True, False]), ("float32", [False, False])):
            pick_device("cuda", precision=precision)
            assert used() == expected
            assert in_own_precision(used)(torch.ones(1)) == [False, False]
            assert used() == expected
    for backend, allowed in zip(backends, before, strict=True):
        backend.allow_tf32 = allowed


@pytest.mark.parametrize(
    ("name", "precision", "error"),
    [("cpu", "tf32", "precision: expected auto, float32 or bfloat16 on device=cpu, got tf32"),
     ("mps", "float32", "device: expected auto, cpu or cuda, got 'mps'")],
)  # fmt: skip
def test_what_a_device_cannot_compute_is_refused(name, precision, error):
    with pytest.raises(ConfigError, match=f"^{error}"):
        pick_device(name, precision=precision)


@pytest.mark.parametrize("name", ["gpu", "cuda:99", "meta", "", "cpu:x"])
def test_device_that_this_machine_lacks_is_refused(name):
    with pytest.raises(ConfigError, match=r"^device: expected auto, cpu or a device of this machine, got "):
        pick_device(name)

"""Steps wait for no value of a GPU: networks, losses, metrics and whole steps on tensors without values.

On the device ``meta`` a value that is read (``item``, ``bool``, ``tolist``, an index by a mask) is an error, and so is
a tensor that was left on the CPU.
"""

import contextlib
from unittest import mock

import pytest
import torch
from lightning.fabric.utilities import move_data_to_device
from small_lpips import random_lpips
from small_scenes import sample_of, step
from torch import Tensor
from torch.utils.data import default_collate

from dsr.degradation.downsampling import Downsampling, encode_facts
from dsr.methods.dip.upsampler import DeepImagePrior, PriorOptimisation
from dsr.methods.networks.network import Answer
from dsr.methods.networks.peers.peer import PEERS
from dsr.methods.networks.trained import NETWORKS
from dsr.metrics.calibration import measured_errors
from dsr.metrics.catalogue import PROTOCOLS, catalogue
from dsr.metrics.classes import visual_metrics
from dsr.metrics.functional import SurfacePair
from dsr.metrics.losses import VisualLoss
from dsr.sample import CENTIMETRES, Unit
from dsr.training.degradation import to_tensors
from dsr.training.module import SuperResolution
from dsr.training.objective import DepthObjective, SurfaceObjective

META = torch.device("meta")
VALIDATED = ("paper", "field", "sensor")
"""Protocols for validations; the metrics of the others sort, count and search edges, which takes values."""
METRICS = [metric for name in VALIDATED for metric in PROTOCOLS[name]]

pytestmark = pytest.mark.filterwarnings("ignore:.*the `self.trainer` reference is not registered.*")


@pytest.fixture(autouse=True)
def _meta_is_not_autocast():
    """``torch.autocast`` knows no such device."""
    real = torch.autocast
    named = lambda kind, *args, **more: contextlib.nullcontext() if kind == "meta" else real(kind, *args, **more)  # noqa: E731
    with mock.patch("torch.autocast", named):
        yield


def _batch():
    """Return two patches with holes on the CPU, of one of which the kernel is given."""
    disparity, photo = step(64)
    patch = to_tensors(sample_of(disparity, photo))
    patch["disparity_lr"][0, 3:5, 4] = torch.nan
    patch["depth"][0, 40, 9] = torch.nan
    hints = {"noise": torch.zeros_like(patch["disparity_lr"]), "soft": torch.zeros(())}
    return default_collate([{**patch, **hints, "facts": encode_facts(kernel)} for kernel in ("box", None)])


def _on_meta(batch):
    return move_data_to_device(batch, META)


def _maps(*, differentiable=False):
    """Return a prediction, a target and rays of 40 x 40 pixels without values."""
    prediction, target = (torch.empty(2, 1, 40, 40, dtype=torch.float64, device=META) for _ in range(2))
    return prediction.requires_grad_(differentiable), target, torch.empty(1, 3, 40, 40, device=META)


@pytest.mark.parametrize("name", NETWORKS)
def test_training_step_reads_no_value(name):
    net = NETWORKS[name](4)
    objective = SurfaceObjective() if net.states_errors else DepthObjective("lap1", 0.1, shading=0.1)
    module = SuperResolution(net, objective).to(META)
    module.training_step(_on_meta(net.prepare(_batch()))).backward()
    assert all(each.grad is not None for each in module.net.parameters())
    optimizer = torch.optim.AdamW(module.net.parameters())
    optimizer.defaults["fused"] = True  # as trainings have it; torch has no such kernel for tensors without values
    module.configure_gradient_clipping(optimizer, 1.0, "norm")
    del optimizer.found_inf
    module.optimizer_step(0, 0, optimizer, lambda: None)


@pytest.mark.parametrize("visual", ["mse_v", "dssim", "lpips"])
@pytest.mark.parametrize("depth_loss", ["lap1", "l1", "mse"])
def test_loss_of_a_training_reads_no_value(depth_loss, visual):
    batch = _on_meta(_batch())
    disparity = torch.empty_like(batch["depth"], requires_grad=True)
    loss = VisualLoss(visual, random_lpips() if visual == "lpips" else None)
    DepthObjective(depth_loss, 1.0, loss, shading=0.1)(Answer(disparity, stages=(disparity,)), batch)["loss"].backward()
    assert disparity.grad is not None


@pytest.mark.parametrize("metric", METRICS, ids=lambda metric: metric.name)
def test_metric_reads_no_value(metric):
    [metric] = [each for each in catalogue(random_lpips(), protocols=VALIDATED) if each.name == metric.name]
    unit = CENTIMETRES if metric.unit is None else Unit(metric.unit, inverse=True, factor=30.0, offset=0.0)
    pair = SurfacePair(*_maps(differentiable=True), unit=unit)
    for value in metric.variants(pair).values():
        assert value.shape == (2,)
    metric.valid_fraction(pair)


def test_collection_of_metrics_reads_no_value():
    metrics = visual_metrics(random_lpips(), protocols=VALIDATED).to(META)
    assert all(value.is_meta for value in metrics(*_maps()).values())
    assert all(value.is_meta for value in metrics.compute().values())
    assert all(value.is_meta for value in measured_errors(*_maps()))


@pytest.mark.parametrize("name", PEERS)
def test_peers_read_no_value(name):
    net = PEERS[name](4).to(META)
    net(torch.empty(1, 3, 64, 64, device=META), torch.empty(1, 1, 64, 64, device=META)).sum().backward()


@pytest.mark.parametrize("loss", [{}, {"data_loss": "mse", "w": 0.0}])
def test_step_of_a_deep_image_prior_reads_no_value(loss):
    prior = DeepImagePrior(scale=4, downsampling=Downsampling("box"), **loss)
    module = PriorOptimisation(prior, sample_of(*step(64)), visual=True)
    for name, value in vars(module).items():
        if isinstance(value, Tensor):
            setattr(module, name, value.to(META))
    module.to(META)
    with mock.patch("torch.randn", lambda shape, **_: torch.empty(shape, device=META)):  # the generator is the CPU's
        module.loss_terms(*module())["loss"].backward()
    assert all(each.grad is not None for each in module.net.parameters())

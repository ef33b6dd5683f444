"""The objective, schedule, module, divergence and processes of a training, against numbers worked out by hand."""

import copy
import functools
import math
import os
import re
from dataclasses import replace

import lightning
import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins.environments import LightningEnvironment, SLURMEnvironment
from lightning.pytorch.utilities import rank_zero_only
from small_lpips import random_lpips
from small_networks import with_any_weights
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2
from torch.utils.data import DataLoader

from dsr.app.train import find_processes
from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera
from dsr.methods.networks.facets_method import AnyMap
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.network import Answer
from dsr.methods.networks.sparse_to_dense import SparseToDense
from dsr.methods.recipe import read_recipe
from dsr.metrics import functional as scores
from dsr.metrics.classes import visual_metrics
from dsr.metrics.functional import SurfacePair
from dsr.sample import CENTIMETRES, Scene, Unit
from dsr.training.callbacks import log_layout
from dsr.training.data_module import WholeScenes
from dsr.training.degradation import Degradation, to_tensors
from dsr.training.module import SuperResolution, WarmupCosine
from dsr.training.objective import DepthObjective, SurfaceObjective, balance_weight, shading_loss, to_depth
from dsr.training.patches import Patches
from dsr.training.settings import PatchSettings
from dsr.utils.checkpoints import Divergence, DivergenceError, fit, make_trainer
from dsr.utils.configuration import ConfigError

CPU = torch.device("cpu")
BOX = Downsampling("box")
X2 = Degradation(2, BOX)
CAMERA = Camera(width=40, height=36, fx=40.0, fy=40.0, cx=20.0, cy=18.0)

pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.filterwarnings("ignore:.*does not have many workers.*"),
    pytest.mark.filterwarnings("ignore:.*LeafSpec.*"),
    pytest.mark.filterwarnings("ignore:.*smaller than the logging interval.*"),
    pytest.mark.filterwarnings("ignore:.*have no `val_dataloader`.*"),
]


STEREO = Camera(width=13, height=12, fx=20.0, fy=25.0, cx=4.0, cy=7.0, baseline=0.5, doffs=1.0)


def _wall():
    """Return a wall at 2 m whose disparity is 0.5 * 20 / 2 - 1 = 4 pixels, of low-resolution ones from 3 to 5."""
    return {
        "depth": torch.full((1, 1, 12, 13), 2.0, dtype=torch.float64),
        "rays": STEREO.rays()[None],
        "bf": torch.full((1, 1, 1, 1), 10.0, dtype=torch.float64),
        "doffs": torch.ones((1, 1, 1, 1), dtype=torch.float64),
        "disparity_lr": torch.tensor([[[[3.0, 5.0]]]], dtype=torch.float64),
    }


def _ramp(slope, height=4.0):
    """Return a disparity that grows by ``slope`` per column."""
    return (height + slope * torch.arange(13, dtype=torch.float64)).expand(1, 1, 12, 13)


@pytest.mark.parametrize(("depth_loss", "expected"), [("l1", 0.25), ("lap1", 0.25), ("mse", 0.0625)])
def test_offset_counts_as_its_fraction_of_the_low_resolution_range(depth_loss, expected):
    terms = DepthObjective(depth_loss, 3.0)(Answer(torch.full((1, 1, 12, 13), 4.5, dtype=torch.float64)), _wall())
    assert float(terms[depth_loss]) == pytest.approx(expected, rel=1e-13)
    assert float(terms["mse_v"]) == pytest.approx(0, abs=1e-25)  # a wall elsewhere looks the same
    assert float(terms["loss"]) == pytest.approx(expected, rel=1e-13)


def test_visual_term_is_that_of_the_angle_between_two_planes():
    """d + doffs = a u + b is the plane a fx X + (a cx + b) Z = baseline fx; the wall's normal is the optical axis."""
    slope = 0.3
    along, axis = slope * 20, slope * 4 + 5
    expected = (2 - 2 * axis / math.hypot(along, axis)) / 3
    terms = DepthObjective("l1", 0.5)(Answer(_ramp(slope)), _wall())
    assert float(terms["mse_v"]) == pytest.approx(expected, rel=1e-12)
    assert float(terms["l1"]) == pytest.approx(slope * 6 / 2, rel=1e-12)
    assert float(terms["loss"]) == pytest.approx(slope * 3 + 0.5 * expected, rel=1e-12)


def test_intermediate_stages_get_the_depth_loss_too():
    terms = DepthObjective("l1", 2.0)(Answer(_ramp(0, 4.0), stages=(_ramp(0, 4.5), _ramp(0, 6.0))), _wall())
    assert {name: float(value) for name, value in terms.items()} == pytest.approx(
        {"loss": 1.25, "l1": 0, "l1_stage1": 0.25, "l1_stage2": 1.0, "mse_v": 0}, abs=1e-13
    )


def test_shading_term_is_that_of_the_surface_and_the_photo():
    batch = {**_wall(), "rgb": torch.rand((1, 3, 12, 13), generator=torch.Generator().manual_seed(0)).double()}
    disparity = _ramp(0.3)
    expected = shading_loss(SurfacePair(to_depth(disparity, batch), batch["depth"], batch["rays"]), batch["rgb"])
    terms = DepthObjective("l1", shading=0.5)(Answer(disparity), batch)
    assert terms.keys() == {"loss", "l1", "shading"}
    assert float(terms["shading"]) == pytest.approx(float(expected), rel=1e-12)
    assert float(terms["loss"]) == pytest.approx(float(terms["l1"]) + 0.5 * float(expected), rel=1e-12)


@pytest.mark.parametrize(("coarse", "expected"), [((4.0, 4.0), 0.5 / 0.004), ((3.0, 5.0, math.nan), 0.25)])
def test_range_is_that_of_the_known_low_resolution_pixels_and_never_zero(coarse, expected):
    batch = {**_wall(), "disparity_lr": torch.tensor(coarse, dtype=torch.float64).view(1, 1, 1, -1)}
    assert float(DepthObjective("l1")(Answer(_ramp(0, 4.5)), batch)["loss"]) == pytest.approx(expected, rel=1e-9)


def test_disparity_at_or_beyond_infinity_has_no_depth():
    disparity = torch.tensor([[[[-1.5, -1.0, -0.5]]]], dtype=torch.float64)
    assert to_depth(disparity, _wall())[0, 0, 0].isnan().tolist() == [True, True, False]
    assert to_depth(disparity, _wall())[0, 0, 0, 2] == pytest.approx(20)


def _plane(baseline=None, doffs=0.0, slope=0.02, fx=80.0):
    """Return the tensors of the plane with d + doffs = slope u + 3, 100 columns wide."""
    camera = Camera(width=100, height=4, fx=fx, fy=70.0, cx=40.0, cy=2.0, baseline=baseline, doffs=doffs)
    depth = (baseline or 0.2) * fx / (3 + slope * torch.arange(100, dtype=torch.float64)).expand(1, 4, 100)
    return to_tensors(
        make_sample(Scene("set", "plane", torch.rand(3, 4, 100), camera, depth.clone()), 4, BOX, "disparity")
    )


@pytest.mark.parametrize(("baseline", "doffs", "fx"), [(None, 0.0, 80.0), (0.12, 0.0, 80.0), (0.12, 1.5, 123.0)])
def test_balanced_weight_of_a_plane_is_its_closed_form(baseline, doffs, fx):
    stereo = (baseline or 0.2) * fx
    middle, spread = stereo / (3 + 0.02 * 50), 0.02 * 96  # the median's column; coarse centres from 1.5 to 97.5
    tilt = math.asin(5 / 255)
    as_disparity = (stereo / middle - stereo / (middle * (1 + 1e-6 * math.tan(tilt) / fx))) / 1e-6 / spread
    expected = as_disparity / ((2 - 2 * math.cos(tilt)) / 3)
    assert balance_weight([_plane(baseline, doffs, fx=fx)]) == pytest.approx(expected, rel=2e-6)


def test_balanced_weight_is_the_median_over_the_patches():
    patches = [_plane(slope=slope) for slope in (0.01, 0.05, 0.03)]
    assert balance_weight(patches) == balance_weight(patches[2:])


def _rates(steps, warmup, count):
    """Return the learning rates of a schedule as fractions of the highest."""
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule, rates = WarmupCosine(optimizer, steps, warmup), []
    for _ in range(count):
        rates += schedule.get_last_lr()
        optimizer.step()
        schedule.step()
    return rates


def test_learning_rate_warms_up_linearly_and_falls_as_a_cosine_to_zero():
    rates = _rates(20, 4, 26)
    assert rates[:5] == pytest.approx([0.25, 0.5, 0.75, 1, 1])
    assert rates[12] == pytest.approx(0.5)  # halfway down
    assert rates[8] == pytest.approx((1 + math.sqrt(0.5)) / 2)
    assert rates[20] == rates[25] == pytest.approx(0, abs=1e-15)


def _scene(seed, holes=0.0):
    """Return a wavy surface with a photo that shows its waves."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[:36, :40]
    waves = np.sin(u / random.uniform(2, 4) + random.uniform(0, 6)) * np.cos(v / random.uniform(2, 4))
    depth = torch.from_numpy(2 + 0.01 * u + 0.1 * waves)[None]
    depth[torch.from_numpy(random.random((1, 36, 40)) < holes)] = torch.nan
    rgb = torch.from_numpy(0.5 + 0.4 * waves).float().expand(3, 36, 40)
    return Scene("set", f"s{seed}", rgb, CAMERA, depth)


def _module(network=None, **settings):
    torch.manual_seed(0)
    metrics = functools.partial(visual_metrics, network)
    return SuperResolution(MSGNet(2, "dsr"), DepthObjective("lap1", 0.1), metrics=metrics, **settings)


def _trainer(folder, **settings):
    quiet = dict.fromkeys(("logger", "enable_progress_bar", "enable_model_summary"), False)
    return lightning.Trainer(
        accelerator="cpu", default_root_dir=folder, enable_checkpointing=False, **{**quiet, **settings}
    )


class _Watch(Callback):
    """Keeps what ``look`` finds in the module and in what a training step returned, after each step."""

    def __init__(self, look):
        self.look, self.seen = look, []

    def on_train_batch_end(self, trainer, pl_module, outputs, *_):
        self.seen.append(self.look(pl_module, outputs))


def _one_batch():
    patches = Patches([[_scene(0), _scene(1)]], PatchSettings(patch=32, batch=2), X2)
    return DataLoader([patches[0], patches[1]], batch_size=2)


@pytest.mark.parametrize("mixed", [False, True])
def test_training_loss_is_the_objective_of_the_networks_output_in_full_precision(tmp_path, mixed):
    losses, module = _Watch(lambda _, outputs: float(outputs["loss"])), _module()
    [batch] = _one_batch()
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=mixed):
        disparity = module.net.upsample(batch["rgb"], batch["disparity_lr"], batch["min_max"])
    expected = float(module.objective(Answer(disparity), batch)["loss"])
    precision = "bf16-mixed" if mixed else "32-true"
    _trainer(tmp_path, max_steps=1, callbacks=[losses], precision=precision).fit(module, _one_batch())
    assert losses.seen == pytest.approx([expected], rel=2e-5)


def test_weight_average_follows_the_weights_with_its_decay(tmp_path):
    watch, module = _Watch(lambda module, _: module.net.stem.conv.weight.detach().clone()), _module(average=0.3)
    expected = module.net.stem.conv.weight.detach().clone()
    assert all(map(torch.equal, module.net.parameters(), module.average.parameters()))
    _trainer(tmp_path, max_epochs=9, callbacks=[watch]).fit(module, _one_batch())
    for step, weight in enumerate(watch.seen, start=1):
        decay = min(0.3, step / (step + 9))
        expected = decay * expected + (1 - decay) * weight
    torch.testing.assert_close(module.average.stem.conv.weight, expected)
    assert not torch.equal(module.net.stem.conv.weight, expected)
    assert not any(parameter.requires_grad for parameter in module.average.parameters())


def test_average_has_the_statistics_of_batch_normalisation(tmp_path):
    torch.manual_seed(0)
    module = SuperResolution(SparseToDense(2, width=8), DepthObjective("l1"))  # with 4, torch crashes where AVX2 is all
    _trainer(tmp_path, max_epochs=2).fit(module, _one_batch())
    assert all(map(torch.equal, module.net.buffers(), module.average.buffers()))
    assert all(bool(mean.any()) for name, mean in module.average.named_buffers() if name.endswith("mean"))


@pytest.mark.parametrize("algorithm", [None, "norm", "value"])
def test_gradient_is_clipped_as_the_trainer_says_and_its_norm_logged(algorithm, tmp_path):
    found = []

    class _Gradient(Callback):
        def on_before_zero_grad(self, trainer, pl_module, *_):
            grads = [p.grad.flatten() for p in pl_module.net.parameters() if p.grad is not None]
            if grads:  # of the step before
                found.append((torch.cat(grads), float(trainer.callback_metrics["train/gradient_norm"])))

    clipping = {} if algorithm is None else {"gradient_clip_val": 1e-3, "gradient_clip_algorithm": algorithm}
    _trainer(tmp_path, max_epochs=2, callbacks=[_Gradient()], **clipping).fit(_module(), _one_batch())
    gradient, logged = found[-1]
    assert logged > 1e-2
    size = gradient.abs().max() if algorithm == "value" else gradient.norm()
    assert float(size) == pytest.approx(1e-3 if algorithm else logged, rel=1e-3)


@pytest.mark.parametrize("fused", [False, True])
def test_non_finite_gradient_changes_nothing(tmp_path, fused):
    module = _module(optimizer=functools.partial(torch.optim.AdamW, weight_decay=0.1, fused=fused))
    before = copy.deepcopy(module.net.state_dict())
    [batch] = _one_batch()
    batch["depth"] = batch["depth"].clone()
    bad = {**batch, "bf": torch.full_like(batch["bf"], torch.inf)}
    _trainer(tmp_path, max_epochs=1).fit(module, DataLoader([bad], batch_size=None))
    assert all(torch.equal(before[name], value) for name, value in module.net.state_dict().items())
    _trainer(tmp_path, max_epochs=1).fit(module, DataLoader([bad, batch], batch_size=None))
    assert not all(torch.equal(before[name], value) for name, value in module.net.state_dict().items())


def _loader(scenes):
    return DataLoader(scenes, batch_size=None)


def test_validation_is_in_the_unit_of_its_benchmark(tmp_path):
    levels = Unit("levels", inverse=True, factor=8.0, limits=(0, 255))
    module = SuperResolution(
        MSGNet(2, "dsr"),
        DepthObjective(),
        metrics=lambda: visual_metrics(protocols=("field",)),
        validation_sets=("a", "b"),
    )
    sets = [_loader(WholeScenes([replace(_scene(3), unit=unit)], X2)) for unit in (levels, CENTIMETRES)]
    in_levels, in_cm = (dict(each) for each in _trainer(tmp_path).validate(module, sets, verbose=False))
    assert {name for name in in_levels if name.startswith("val_a/")} == {
        *("val_a/RMSE_levels", "val_a/MAE_levels", "val_a/RMSE_levels_border6")
    }
    assert {name for name in in_cm if name.startswith("val_b/")} == {
        *("val_b/RMSE_cm", "val_b/MAE_cm", "val_b/Beyond_5cm", "val_b/Beyond_delta1", "val_b/RMSE_cm_border6")
    }
    assert in_levels["val/RMSE_levels"] == in_levels["val_a/RMSE_levels"] > 0


def test_validation_logs_the_mean_over_the_scenes_in_the_units_of_tables(tmp_path):
    module, scenes = _module(), WholeScenes([_scene(3), _scene(4, holes=0.05), _scene(5)], X2)
    trainer = _trainer(tmp_path, precision="bf16-mixed")  # of the training alone
    [logged] = trainer.validate(module, _loader(scenes), verbose=False)
    metrics = {
        "RMSE_d": (scores.rmse_d, 1000),
        "RMSE_v": (scores.rmse_v, 1000),
        "RMSE_v1": (scores.rmse_v1, 1000),
        "DSSIM_v": (scores.dssim_v, 1000),
        "BadPix_v_5": (lambda pair: scores.bad_pix_v(pair, 5), 100),
        "Bumpiness_d": (scores.bumpiness_d, 1),
    }
    pairs = []
    for batch in (scenes[i] for i in range(3)):
        with torch.no_grad():
            disparity = module.average.upsample(batch["rgb"], batch["disparity_lr"])
        assert bool((disparity > 0).all())
        pairs.append(SurfacePair(40 * 0.2 / disparity, batch["depth"], CAMERA.rays()[None]))
    for name, (metric, factor) in metrics.items():
        mean = np.mean([float(metric(pair).amax()) for pair in pairs])
        assert logged[f"val/{name}"] == pytest.approx(factor * mean, rel=1e-4), name
        assert module.validation_scores["val"][name] == pytest.approx(mean, rel=1e-4), name


def test_a_network_that_takes_hints_is_validated_as_it_is_evaluated(tmp_path):
    """That is, the kernel, sharp steps, and that there is no noise."""
    net = with_any_weights(lambda: FacetsUNet(2, 8, 8, 4))
    module = SuperResolution(copy.deepcopy(net), SurfaceObjective(), validation_sets=("a",))
    [logged] = _trainer(tmp_path).validate(module, _loader(WholeScenes([_scene(3)], X2, hinted=True)), verbose=False)
    sample = X2.sample(_scene(3))

    def rmse(**hinted):
        depth = AnyMap(net.eval(), **hinted)(sample)
        return float(scores.rmse_v(SurfacePair(depth[None], sample.depth[None], CAMERA.rays()[None])))

    assert logged["val/RMSE_v"] == pytest.approx(1000 * rmse(kernel="box", edges="sharp", clean=True), rel=1e-4)
    assert logged["val/RMSE_v"] != pytest.approx(1000 * rmse(), rel=1e-3)


def test_validation_scores_bicubic_interpolation_of_the_same_maps_as_the_method_does(tmp_path):
    scenes = [_scene(3), _scene(4, holes=0.05)]
    module = _module()
    [logged] = _trainer(tmp_path).validate(module, _loader(WholeScenes(scenes, X2)), verbose=False)
    method, expected = read_recipe("bicubic").build(2), []
    for scene in scenes:
        sample = X2.sample(scene)
        pair = SurfacePair(method(sample)[None].double(), sample.depth[None].double(), CAMERA.rays()[None])
        expected.append((float(scores.rmse_v(pair)), float(scores.rmse_d(pair))))
    found = logged["bicubic/RMSE_v"], logged["bicubic/RMSE_d"]
    assert found == pytest.approx(1000 * np.mean(expected, axis=0), rel=1e-4)
    assert module.validation_scores.keys() == {"val", "bicubic"}


def test_validation_starts_anew_each_time(tmp_path):
    module, trainer = _module(), _trainer(tmp_path)
    first, other = (_loader(WholeScenes([_scene(seed)], X2)) for seed in (3, 4))
    [before] = trainer.validate(module, first, verbose=False)
    [between] = trainer.validate(module, other, verbose=False)
    [after] = trainer.validate(module, first, verbose=False)
    assert before == after != between


def test_checkpoint_holds_the_networks_tensors_alone_and_loads_as_plain_data(tmp_path):
    module, trainer = _module(random_lpips()), _trainer(tmp_path, max_steps=1)
    loader = _loader(WholeScenes([_scene(3)], X2))
    trainer.fit(module, _one_batch(), loader)
    assert math.isfinite(trainer.callback_metrics["val/LPIPS_v"])
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    content = torch.load(tmp_path / "a.ckpt", weights_only=True)
    names = {f"{part}.{name}" for part in ("net", "average") for name in module.net.state_dict()}
    assert content["state_dict"].keys() == names
    assert content["global_step"] == 1
    size = sum(value.numel() for value in module.net.parameters())
    assert (tmp_path / "a.ckpt").stat().st_size < 4 * 4 * size + 200_000  # weights, their average, AdamW's two moments


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda: balance_weight([]), "^patches: expected one or more"),
        (lambda: _rates(10, -1, 1), "^warmup: expected 0 or more, got -1"),
        (lambda: _module(average=1.0), "^average: expected "),
        (lambda: _module(average=math.nan), "^average: expected "),
        (lambda: SuperResolution(MSGNet(4, "hui"), DepthObjective()), "model: expected a network that covers"),
    ],
)
def test_training_that_cannot_be_is_refused(act, message):
    with pytest.raises(ValueError, match=message):
        act()


def test_layout_of_tensorboard_begins_with_looks(tmp_path):
    logger = TensorBoardLogger(tmp_path, name=None, version="tensorboard")
    names = ("BadPix_v_5", "RMSE_d", "LPIPS_v", "RMSE_v1", "DSSIM_v", "RMSE_v")
    log_layout(logger, {name: f"{name}, title" for name in names})
    logger.finalize("success")
    events = EventAccumulator(str(tmp_path / "tensorboard"), size_guidance={"tensors": 0}).Reload()
    layout = layout_pb2.Layout.FromString(events.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0])
    charts = {category.title: [chart.title for chart in category.chart] for category in layout.category}
    assert list(charts) == ["Looks", "Depth and normals", "Training"]
    assert charts["Looks"] == [f"{name}, title" for name in ("RMSE_v", "RMSE_v1", "DSSIM_v", "LPIPS_v", "BadPix_v_5")]
    assert charts["Depth and normals"] == ["RMSE_d, title"]
    [tag] = layout.category[0].chart[0].multiline.tag
    shown = ("val/RMSE_v", "bicubic/RMSE_v", "val_a/RMSE_v", "bicubic_a/RMSE_v")
    assert all(re.match(tag, name) for name in shown)
    assert not any(re.match(tag, name) for name in ("val/RMSE_v1", "bicubic/RMSE_d"))


NAN = math.nan


class Scripted(lightning.LightningModule):
    """A network of one weight whose losses, gradients, scores and weights are as written down."""

    def __init__(self, losses, norms=None, scores=None, weights=None):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))
        self.losses, self.norms, self.scores, self.weights = losses, norms or {}, scores or {}, weights or {}
        self.validation_scores = {}

    def training_step(self, _, index):
        step = index + 1
        loss = self.weight.sum() * 0 + self.losses.get(step, 0.5)
        self.log_dict({"train/loss": loss.detach(), "train/gradient_norm": self.norms.get(step, 1.0)}, batch_size=1)
        return loss

    def on_train_batch_end(self, *_):
        self.weight.data.fill_(self.weights.get(self.global_step, 1.0))

    def validation_step(self, *_):
        self.log("val/RMSE_d", self.scores.get(self.global_step, 0.1), batch_size=1)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.25)


def train(folder, module, steps=8, accumulate=1):
    """Train with a validation and a checkpoint after every second step; return the trainer."""
    last = ModelCheckpoint(folder, "last", enable_version_counter=False, save_on_train_epoch_end=False)
    trainer = make_trainer(CPU, steps, 2, callbacks=[Divergence(3), last], logger=False, accumulate=accumulate)
    loader = DataLoader(range(steps * accumulate), batch_size=None)
    fit(trainer, module, loader, val_dataloaders=DataLoader(range(1), batch_size=None))
    return trainer


def last_step(folder):
    return torch.load(folder / "last.ckpt", weights_only=True)["global_step"]


ROW = "the loss or its gradient is not finite from there on"
DIVERGED = {
    "losses": ({"losses": {4: NAN, 5: math.inf, 6: NAN}}, f"4: {ROW}", 4),
    "gradients": ({"losses": {}, "norms": dict.fromkeys((4, 5, 6), math.inf)}, f"4: {ROW}", 4),
    "score": ({"losses": {}, "scores": {4: NAN}}, "4: the validation's RMSE_d is nan", 2),
    "weights": ({"losses": {}, "weights": {6: math.inf}}, "6: the weights weight are not finite", 4),
}


@pytest.mark.parametrize("case", DIVERGED)
def test_diverged_training_stops_at_its_step_and_keeps_the_last_good_checkpoint(tmp_path, case):
    script, what, kept = DIVERGED[case]
    with pytest.raises(DivergenceError) as caught:
        train(tmp_path, Scripted(**script))
    assert str(caught.value) == f"diverged at step {what}, at a learning rate of 0.25"
    assert last_step(tmp_path) == kept


def test_few_steps_without_a_finite_loss_are_tolerated(tmp_path):
    trainer = train(tmp_path, Scripted({2: NAN, 3: NAN, 5: NAN, 6: NAN}))
    assert trainer.global_step == last_step(tmp_path) == 8


def test_steps_count_rather_than_the_batches_of_a_step(tmp_path):
    trainer = train(tmp_path, Scripted(dict.fromkeys(range(3, 8), NAN)), steps=6, accumulate=2)
    assert trainer.global_step == 6


@pytest.fixture(autouse=True)
def _alone(monkeypatch):
    for name in os.environ:
        if name.startswith("SLURM_") or name in ("LOCAL_RANK", "RANK", "WORLD_SIZE", "TORCHELASTIC_RUN_ID"):
            monkeypatch.delenv(name)


def test_processes_are_lightnings_on_a_machine_and_those_of_a_slurm_step_elsewhere(monkeypatch):
    for devices, count in (("auto", 1), (1, 1), (2, 2)):
        found = find_processes(CPU, devices)
        assert (found.count, found.rank) == (count, 0)
        assert isinstance(found.environment, LightningEnvironment)
    monkeypatch.setenv("SLURM_NTASKS", "4")  # as in a job's script, which no srun has started
    assert isinstance(find_processes(CPU, 1).environment, LightningEnvironment)
    for name in ("STEP_NUM_TASKS", "NTASKS", "PROCID", "LOCALID", "JOB_ID"):
        monkeypatch.setenv(f"SLURM_{name}", "2" if "TASKS" in name else "1")
    found = find_processes(CPU, 2)
    assert (found.count, found.rank, type(found.environment)) == (2, 1, SLURMEnvironment)
    assert not found.environment.auto_requeue
    with pytest.raises(ConfigError, match=r"^trainer\.devices: expected 2, "):
        find_processes(CPU, 1)


def test_more_devices_than_there_are_are_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert find_processes(torch.device("cuda"), "auto").count == 2
    for device, most in (("cuda", 2), ("cuda:1", 1)):
        with pytest.raises(ConfigError, match=rf"^trainer\.devices: expected at most {most} "):
            find_processes(torch.device(device), 3)


def test_environment_is_as_before_when_the_processes_have_ended(monkeypatch):
    monkeypatch.setenv("MASTER_PORT", "5")
    monkeypatch.setattr(rank_zero_only, "rank", 0)
    before = dict(os.environ)
    with find_processes(CPU, 1).running():
        os.environ.update(LOCAL_RANK="0", MASTER_PORT="6")
    assert dict(os.environ) == before

"""Situations that people reported of programs like this one, each with the values that must come out."""

from __future__ import annotations

import dataclasses
import json
import pickle
from pathlib import Path

import cv2
import lightning
import numpy as np
import pytest
import torch
import torchmetrics
from pretend_cuda import pretend_cuda
from small_lpips import random_lpips
from torch.utils.data import DataLoader

import dsr
from dsr.cli import main
from dsr.inference import upsampler
from dsr.methods.networks.network import Answer
from dsr.metrics import losses
from dsr.metrics.classes import DSSIMv, LPIPSv, RMSEd, visual_metrics
from dsr.metrics.functional import SurfacePair, dssim_v
from dsr.metrics.temporal import Flicker
from dsr.metrics.visual_loss import VisualLoss
from dsr.training.objective import DepthObjective, SurfaceObjective
from dsr.utils.compute_device import pick_device

WIDTH, HEIGHT, FOCAL = 320, 240, 288.0
CAMERA = ["--intrinsics", "288", "288", "159.5", "119.5"]


def scene(width=WIDTH, height=HEIGHT, focal=FOCAL, shift=0.0):
    """Return the exact depth (height, width) in metres and the photo (height, width, 3), uint8 RGB.

    A chequered slanted wall with a box and a ball in front of it, seen by a camera ``shift`` metres to the right.
    """
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    x, y = (u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal
    depth = (3.2 - 0.15 * shift) / (1 + 0.15 * x)
    squares = np.floor(4 * (shift + x * depth)) + np.floor(4 * y * depth)
    photo = np.stack([150 + 50 * (squares % 2)] * 3, -1) * (1.0, 0.9, 0.75)
    box = (np.abs(shift + 1.7 * x + 0.6) < 0.3) & (np.abs(1.7 * y - 0.2) < 0.4)
    depth, photo = np.where(box, 1.7, depth), np.where(box[..., None], (60, 90, 200), photo)
    centre, radius = np.array([0.45 - shift, 0.3, 2.0]), 0.45
    along = x * centre[0] + y * centre[1] + centre[2]
    norm = x * x + y * y + 1
    root = along**2 - norm * (centre @ centre - radius**2)
    near = (along - np.sqrt(np.maximum(root, 0))) / norm
    depth, photo = np.where(root > 0, near, depth), np.where((root > 0)[..., None], (220, 60, 50), photo)
    return depth, photo.astype(np.uint8)


def coarse(depth, by=4):
    """Return the means of squares of ``by`` pixels."""
    height, width = depth.shape
    return depth.reshape(height // by, by, width // by, by).mean((1, 3))


def millimetres(depth):
    return np.round(1000 * depth).astype(np.uint16)


def write(path: Path, picture):
    """Write a depth map, or a photo in RGB, in the format that the name has."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture[..., ::-1] if picture.ndim == 3 else picture)
    return path


def upsample(out: Path, *options, method="bicubic"):
    """Run ``dsr upsample`` and return its exit code."""
    return main(["upsample", *map(str, options), "-o", str(out), "--method", method, "--only", "depth"])


def mean_error(out: Path, truth):
    """Return the mean absolute error in millimetres of the pixels that both know, and the known fraction."""
    depth = cv2.imread(str(next(out.rglob("depth_metres.tiff"))), cv2.IMREAD_UNCHANGED)
    assert depth.shape == truth.shape
    known = np.isfinite(depth) & np.isfinite(truth)
    return 1000 * np.abs(depth - truth)[known].mean(), np.isfinite(depth).mean()


LPIPS = random_lpips()
SMALL = dsr.Camera(64, 48, 58, 58, 31.5, 23.5)
HALVES = (torch.float16, torch.bfloat16)


def maps(count=2):
    """Return noisy and exact depth, (count, 1, 48, 64) float32."""
    target = torch.from_numpy(scene(64, 48, 58)[0]).float().expand(count, 1, -1, -1).clone()
    return target * (1 + 0.01 * torch.randn(target.shape, generator=torch.Generator().manual_seed(2))), target


def pair_of(prediction, target):
    return SurfacePair.of(prediction, target, SMALL)


def scores(prediction, target, *protocols):
    metrics = visual_metrics(LPIPS, protocols=protocols)
    metrics.update(prediction, target, SMALL)
    return {name: float(value) for name, value in metrics.compute().items()}


@pytest.mark.parametrize("protocols", [("paper",), ("field", "normals", "plane")])
def test_metrics_are_the_same_within_autocast_and_of_maps_of_16_bits(protocols):
    prediction, target = maps()
    expected = scores(prediction, target, *protocols)
    for kind in HALVES:
        with torch.autocast("cpu", kind):
            assert repr(scores(prediction, target, *protocols)) == repr(expected)
        half = prediction.to(kind), target.to(kind)
        assert repr(scores(*half, *protocols)) == repr(scores(*(each.float() for each in half), *protocols))


@pytest.mark.parametrize(
    "function",
    [
        losses.l1,
        losses.mse,
        losses.lap1,
        lambda *both: VisualLoss("mse_v")(pair_of(*both)),
        lambda *both: VisualLoss("dssim")(pair_of(*both)),
        lambda *both: VisualLoss("lpips", LPIPS)(pair_of(*both)),
        lambda *both: dssim_v(pair_of(*both)),
    ],
    ids=["l1", "mse", "lap1", "mse_v", "dssim", "lpips", "dssim_v"],
)
def test_losses_and_their_gradients_are_the_same_within_autocast(function):
    prediction, target = maps()
    prediction.requires_grad_()

    def value_and_gradient(kind=None):
        with torch.autocast("cpu", kind or torch.bfloat16, enabled=kind is not None):
            value = function(prediction, target)
        return value, *torch.autograd.grad(value.sum(), prediction)

    expected = value_and_gradient()
    for kind in HALVES:
        assert all(map(torch.equal, value_and_gradient(kind), expected))
        half = function(prediction.to(kind), target.to(kind))
        assert half.dtype == torch.float32
        assert torch.autograd.grad(half.sum(), prediction)[0].isfinite().all()


@pytest.mark.parametrize("objective", [DepthObjective("lap1", 0.5, shading=0.1), SurfaceObjective()])
def test_objective_is_the_same_within_autocast_and_of_answers_of_16_bits(objective):
    prediction, target = (1 / each for each in maps())
    batch = {"depth": 1 / target, "bf": torch.ones(2, 1, 1, 1), "doffs": torch.zeros(2, 1, 1, 1), "soft": torch.ones(2)}
    batch |= {"rays": SMALL.rays(dtype=torch.float32)[None], "rgb": torch.rand(2, 3, 48, 64)}
    batch["disparity_lr"] = torch.nn.functional.avg_pool2d(target, 4)
    made = [each.bfloat16() for each in (prediction, 0.1 * prediction, 0.2 * prediction)]
    expected = objective(Answer(*(each.float() for each in made), stages=(made[0].float(),)), batch)
    with torch.autocast("cpu", torch.bfloat16):
        found = objective(Answer(*made, stages=(made[0],)), batch)
    assert {name: float(each) for name, each in found.items()} == {name: float(each) for name, each in expected.items()}


class Trained(lightning.LightningModule):
    """A module of a user's, which scores batches of (prediction, target, cameras)."""

    def __init__(self):
        super().__init__()
        self.weight, self.metric = torch.nn.Parameter(torch.ones(())), RMSEd()

    def training_step(self, batch, _):
        self.value = float(self.metric(batch[0], batch[1], batch[2]))
        return self.weight * batch[0].mean()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


@pytest.mark.filterwarnings("ignore:.*LeafSpec", "ignore:.*does not have many workers", "ignore:.*logging interval")
def test_cameras_pass_through_batches():
    prediction, target = maps()
    data = DataLoader([(prediction[index], target[index], SMALL) for index in range(2)], batch_size=2)
    module = Trained()
    silent = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    lightning.Trainer(max_epochs=1, accelerator="cpu", enable_model_summary=False, **silent).fit(module, data)
    expected = float(RMSEd()(prediction, target, SMALL))
    assert module.value == expected
    several = torchmetrics.wrappers.BootStrapper(RMSEd(), num_bootstraps=3, sampling_strategy="multinomial")
    several.update(prediction, target, SMALL)
    assert float(several.compute()["mean"]) == pytest.approx(expected, rel=0.1)
    for camera in ([SMALL, SMALL], (SMALL,), SMALL.rays().numpy()):
        assert float(RMSEd()(prediction.numpy(), target.numpy(), camera)) == expected
    other = SMALL.crop(0, 0, 48, 32).rescale(64, 48)
    both = [float(RMSEd()(prediction[:1], target[:1], each)) for each in (SMALL, other)]
    assert float(RMSEd()(prediction[[0, 0]], target[[0, 0]], [SMALL, other])) == pytest.approx(np.mean(both))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"camera": [SMALL] * 3}, "rays: expected shape"),
        ({"camera": [np.eye(3)] * 2}, "camera: expected dsr.Camera"),
        ({"target": np.ones((48, 64))}, "prediction, target: expected two depth maps"),
        ({"target": np.full((2, 1, 48, 64), 1500, np.uint16)}, "prediction, target: expected metres as floats"),
    ],
)
def test_arguments_of_metrics_that_do_not_fit_are_named(change, named):
    prediction, target = maps()
    with pytest.raises(ValueError, match=f"^{named}"):
        DSSIMv().update(**{"preds": prediction, "target": target, "camera": SMALL, **change})


def test_camera_stays_as_it_is():
    with pytest.raises(dataclasses.FrozenInstanceError):
        SMALL.fx = 60.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        SMALL.focal = 60.0
    assert pickle.loads(pickle.dumps(SMALL)) == SMALL
    assert hash(SMALL) == hash(dataclasses.replace(SMALL))


def test_metrics_are_plotted():
    pytest.importorskip("matplotlib").use("agg")
    flicker = Flicker()
    flicker.update(maps(3)[0])
    for metric in (RMSEd(), LPIPSv(LPIPS)):
        metric.update(*maps(), SMALL)
        assert metric.plot()[1].get_ylabel() == type(metric).__name__
    assert flicker.plot()[1].get_ylabel() == "Flicker"


@pytest.mark.parametrize("pose", [(), (np.eye(4),)])
@pytest.mark.parametrize(("wrong", "place"), [(None, 2), (None, 0), ((None, None, None), 1), (5, 3)])
def test_stream_names_a_frame_that_is_none(pose, wrong, place):
    depth, photo = scene(64, 48, 58)
    frames = [(photo, coarse(depth), SMALL, *pose)] * 4
    found = []
    with pytest.raises(ValueError, match=f"^frame {place}: "):
        found.extend(dsr.Upsampler("bicubic").stream([*frames[:place], wrong, *frames[place:]], neighbours=2))
    assert len(list(dsr.Upsampler("bicubic").stream(frames, neighbours=2))) == 4


@pytest.fixture
def tf32(monkeypatch):
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", True)
    monkeypatch.delenv("DSR_DEVICE", raising=False)


@pytest.mark.usefixtures("tf32")
def test_float32_on_a_gpu_is_float32_and_methods_run_where_they_are_fast():
    def chosen(method, device="auto"):
        return torch.device(upsampler(method, device=device)._run.device).type

    assert pick_device("cpu").type == "cpu"
    assert torch.backends.cudnn.allow_tf32
    with pretend_cuda():
        assert [chosen(name) for name in ("srfs", "joint_bilateral")] == ["cpu", "cpu"]
        assert torch.backends.cudnn.allow_tf32
        assert [chosen(name, "cuda") for name in ("srfs", "joint_bilateral")] == ["cuda", "cuda"]
        assert [chosen(name) for name in ("guided_filter", "facets")] == ["cuda", "cuda"]
    assert not torch.backends.cudnn.allow_tf32


@pytest.fixture
def command(tmp_path, monkeypatch, capfd):
    """Return a runner of train and eval with three small scenes: the exit code, the output and the error lines."""
    for number in range(3):
        depth, photo = scene(64, 48, 58, 0.1 * number)
        folder = tmp_path / "data" / f"scene{number}"
        write(folder / "rgb.png", photo)
        np.save(folder / "depth.npy", depth)
        (folder / "camera.json").write_text(json.dumps(vars(SMALL)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DSR_LPIPS_TRUNK", raising=False)
    for name, value in (("HYDRA_FULL_ERROR", "1"), ("PL_GLOBAL_SEED", "0"), ("PL_SEED_WORKERS", "1")):
        monkeypatch.setenv(name, value)  # and so put back afterwards

    def run(name, *arguments):
        smoke = ["trainer=smoke", "model.scheduler.warmup=1"] if name == "train" else []
        given = ["dataset=folder", "dataset.root=data", "metrics.lpips=false", "device=cpu", "output_dir=out"]
        try:
            code = main([name, *smoke, *given, *arguments])
        except SystemExit as ended:
            code = ended.code
        captured = capfd.readouterr()
        return code, captured.out, captured.err.splitlines()

    return run


OF_LIGHTNING = "lightning.pytorch.callbacks"


def test_schedule_of_accumulation_ends_after_its_steps(command):
    weights = []
    for given in (
        [f"+callbacks.acc._target_={OF_LIGHTNING}.GradientAccumulationScheduler", "+callbacks.acc.scheduling={0:2}"],
        ["trainer.accumulate_grad_batches=2"],
    ):
        code, output, errors = command("train", *given, "overwrite=true")
        assert (code, errors) == (0, [])
        assert "2 of 2 patches of 32 x 32 x 2 batches" in " ".join(output.split())
        weights.append(Path("out/weights.safetensors").read_bytes())
    assert weights[0] == weights[1]


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        (["callbacks=[default,learning_rate]", "logger=[]"], "learning_rate"),
        (["callbacks=[default,early_stopping]", "callbacks.early_stopping.monitor=val/loss"], "early_stopping.monitor"),
        (["callbacks=[default,early_stopping]", "callbacks.early_stopping.monitor=val_loss"], "early_stopping"),
        (["StochasticWeightAveraging", "+callbacks.mine.swa_lrs=0.001"], "mine"),
        (["GradientAccumulationScheduler", "+callbacks.mine.scheduling={}"], "mine"),
        (["RichProgressBar"], "mine"),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_callback_that_cannot_work_is_named_in_a_line(command, arguments, key):
    if "=" not in arguments[0]:
        arguments = [f"+callbacks.mine._target_={OF_LIGHTNING}.{arguments[0]}", *arguments[1:]]
    code, _, errors = command("train", *arguments)
    assert (code, len(errors)) == (2, 1)
    assert errors[0].startswith(f"error: callbacks.{key}: ")


def test_checkpoints_of_a_user_are_written_beside_those_of_dsr(command):
    given = ["trainer.max_steps=1"]
    for name, monitor in (("first", []), ("second", ["+callbacks.second.monitor=val/RMSE_v"])):
        target = f"+callbacks.{name}._target_={OF_LIGHTNING}.ModelCheckpoint"
        given += [target, f"+callbacks.{name}.dirpath={name}", *monitor]
    code, _, errors = command("train", *given)
    assert (code, errors) == (0, [])
    assert {path.name for path in Path("out/checkpoints").iterdir()} == {"best.ckpt", "last.ckpt"}
    assert [path.suffix for name in ("first", "second") for path in Path(name).iterdir()] == [".ckpt"] * 2


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["train", "model.optimizer.betas=[0.9,0.99]"], "expected +model.optimizer.betas=[0.9,0.99]"),
        (["train", "trainer.limit_val_batches=1"], "expected +trainer.limit_val_batches=1"),
        (["train", "trainer.limit_val_batche=1"], "did you mean +trainer.limit_val_batches?"),
        (["train", "trainer.max_epochs=1"], "did you mean trainer.max_steps?"),
        (["train", "trainer.precision=16"], "expected precision=16"),
        (["train", "ckpt_path=x"], "expected resume=x"),
        (["train", "trainer.ckpt_path=x"], "expected resume=x"),
        (["eval", "ckpt_path=x"], "expected run=x"),
        (["train", "hydra/sweeper=optuna"], "pip install hydra-optuna-sweeper"),
        (["train", "hydra/sweeper=optna"], "did you mean optuna?"),
        (["train", "hydra/launcher=ray"], "pip install hydra-ray-launcher"),
        (["eval", "metrics=[paper,depth]"], "metrics.protocols=[paper,depth]"),
        (["eval", "metrics=paper,depth"], "metrics.protocols=[paper,depth]"),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_argument_leads_to_the_one_that_is_meant(command, arguments, meant):
    code, _, errors = command(*arguments)
    assert (code, len(errors)) == (2, 1)
    assert meant in errors[0]


@pytest.mark.parametrize(
    ("alignment", "make", "given"),
    [
        ("affine_disparity", lambda depth: 17 * (1 / depth - 0.2), ["method.range_type=inverse"]),
        ("affine", lambda depth: 40 * depth + 3, []),
        ("scale", lambda depth: 9 * depth, []),
        ("robust", lambda depth: np.round(1000 * depth).astype(np.uint16), []),
    ],
)
def test_relative_maps_need_no_scale_of_their_own_if_they_are_aligned(command, alignment, make, given):
    for number in range(3):
        depth = scene(64, 48, 58, 0.1 * number)[0]
        Path("theirs").mkdir(exist_ok=True)
        np.save(f"theirs/scene{number}.npy", make(depth))
    given = ["method=external", "method.path=theirs", *given]
    code, _, errors = command("eval", *given, f"metrics.alignment={alignment}", "metrics=depth")
    assert (code, errors) == (0, [])
    values = [line.split(",") for line in Path("out/scores.csv").read_text().splitlines()]
    place = {name: values[0].index(name) for name in ("metric", "value")}
    errors = [float(row[place["value"]]) for row in values[1:] if row[place["metric"]] == "Depth_RMSE"]
    assert len(errors) == 3
    assert max(errors) < 1e-3
    code, _, errors = command("eval", *given, "output_dir=alone")
    assert code == 2
    assert all("theirs/scene" in error for error in errors[:-1])

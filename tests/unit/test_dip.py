"""Deep image priors as a method: one network for one image."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.degradation.holes import Blobs
from dsr.geometry.camera import Camera
from dsr.methods.dip.optimisation import cost_of_step
from dsr.methods.dip.upsampler import DeepImagePrior, WarmStarted
from dsr.methods.networks.weight_choice import packaged_weights
from dsr.metrics.classes import visual_metrics
from dsr.metrics.functional import SurfacePair, rmse_v
from dsr.sample import DepthSample, Scene
from dsr.utils.progress import Progress, Task, Unit

BOX = Downsampling("box")
ENOUGH = {"steps": 120, "widths": (16, 32), "skips": (4, 4), "average": 0.9, "learning_rate": 0.02}
CAMERA = Camera(width=48, height=32, fx=60.0, fy=60.0, cx=23.5, cy=15.5)


def _sample(name: str = "step", holes: Blobs | None = None, scale: int = 2) -> DepthSample:
    """Two planes with an edge that the photo shows."""
    v, u = torch.meshgrid(torch.linspace(0, 1, 32), torch.linspace(0, 1, 48), indexing="ij")
    near = u + 0.3 * v > 0.6
    depth = torch.where(near, 1.5 + 0.4 * v, 3 - 0.5 * u).double()[None]
    rgb = torch.stack((near.float(), 0.5 * v, 1 - near.float())).clamp(0, 1)
    return make_sample(Scene("set", name, rgb, CAMERA, depth), scale, BOX, "orthogonal", holes=holes)


def _prior(**settings: object) -> DeepImagePrior:
    quick = {"steps": 12, "widths": (4, 6), "skips": (2, 2), "validate_every": 0, "average": 0.5}
    return DeepImagePrior(scale=2, downsampling=BOX, **{**quick, **settings})  # type: ignore[arg-type]


class Stopper(Progress):
    """Keeps the lines, and has the process terminated at a step."""

    def __init__(self, at: int) -> None:
        self.lines: list[str] = []
        self._at = at

    def say(self, line: str) -> None:
        self.lines.append(line)

    @contextlib.contextmanager
    def task(self, name: str, total: int | None = None, *, done: int = 0, unit: Unit = "items") -> Iterator[Task]:
        def update(done: int, total: int | None = None, remark: str | None = None) -> None:
            if name == "steps" and done == self._at:
                os.kill(os.getpid(), signal.SIGTERM)

        yield update


def _error(depth: Tensor, sample: DepthSample, where: Tensor | None = None) -> float:
    assert sample.depth is not None
    difference = (depth - sample.depth).square()
    return float((difference if where is None else difference[where]).mean().sqrt())


def test_same_seed_gives_the_same_bits_and_another_seed_others() -> None:
    sample = _sample()
    first, again, other = (_prior(seed=seed)(sample) for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert first.shape == (1, 32, 48)
    assert first.dtype == sample.depth_lr.dtype


def test_result_does_not_depend_on_earlier_optimisations_or_global_random_state() -> None:
    a, b = _sample("a"), _sample("b")
    prior = _prior()
    alone = _prior()(b)
    torch.manual_seed(99)
    both = {name: prior(sample) for name, sample in (("a", a), ("b", b))}
    assert torch.equal(both["b"], alone)
    assert not torch.equal(both["a"], both["b"])  # the same maps, but another scene


def test_global_random_state_is_unchanged() -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    _prior(steps=2)(_sample())
    assert torch.equal(torch.rand(3), expected)


def test_result_does_not_depend_on_the_truth() -> None:
    sample = _sample()
    blind = DepthSample(**{**vars(sample), "depth": None})
    settings = {"validate_every": 4, "metrics": visual_metrics}
    assert torch.equal(_prior(**settings)(sample), _prior(**settings)(blind))


@functools.cache
def _fitted(*, visual: bool) -> tuple[Tensor, DepthSample]:
    """Return a result after enough steps, and its sample."""
    sample = _sample()
    loss = {} if visual else {"data_loss": "mse", "data_weight": 10.0, "w": 0.0}
    return _prior(**ENOUGH, **loss)(sample), sample


@pytest.mark.slow
@pytest.mark.parametrize("visual", [False, True])
def test_dip_approximates_two_planes(visual: bool) -> None:
    depth, sample = _fitted(visual=visual)
    flat = torch.full_like(depth, float(sample.depth_lr.mean()))
    assert _error(depth, sample) < 0.25 * _error(flat, sample)


@pytest.mark.slow
def test_visual_loss_gives_better_normals() -> None:
    errors = {}
    for visual in (True, False):
        depth, sample = _fitted(visual=visual)
        assert sample.depth is not None
        errors[visual] = float(rmse_v(SurfacePair(depth[None], sample.depth[None], CAMERA.rays()[None])))
    assert errors[True] < 0.8 * errors[False]


@pytest.mark.slow
def test_holes_are_filled_better_than_with_the_nearest_values() -> None:
    sample = _sample(holes=Blobs(0.15, 8))
    depth = _prior(**ENOUGH)(sample)
    assert bool(depth.isfinite().all())
    holes = sample.depth_lr.isnan().repeat_interleave(2, 1).repeat_interleave(2, 2)
    flat = torch.full_like(depth, float(sample.depth_lr.nanmean()))
    assert _error(depth, sample, holes) < 0.3 * _error(flat, sample, holes)


def test_diverging_optimisation_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "dsr.methods.dip.optimisation.PriorOptimisation.result", lambda _: torch.full((1, 1, 32, 48), torch.nan)
    )
    with pytest.raises(ValueError, match=r"step: the optimisation diverged; a lower method.learning_rate"):
        _prior(steps=1)(_sample())


def test_optimisation_stops_at_the_first_loss_that_is_not_finite_and_keeps_no_checkpoint(tmp_path: Path) -> None:
    what = r"step: the optimisation diverged at step \d+: the loss is nan, at a learning rate of 1e\+30; a lower method"
    with pytest.raises(ValueError, match=what):
        _prior(steps=50, learning_rate=1e30, workspace=tmp_path)(_sample())
    assert not list(tmp_path.rglob("*.ckpt"))


@pytest.mark.slow
@pytest.mark.parametrize("stopping", ["fixed", "variance", "oracle"])
def test_interrupted_optimisation_gives_bit_identical_results(tmp_path: Path, stopping: str) -> None:
    sample = _sample()
    settings = {"steps": 50, "stopping": stopping, "patience": 15, "validate_every": 20, "metrics": visual_metrics}
    whole = _prior(workspace=tmp_path / "whole", **settings)(sample)
    stopper = Stopper(33)
    with pytest.raises(
        KeyboardInterrupt, match="interrupted at step 33 of step; the same command continues from there"
    ):
        _prior(workspace=tmp_path / "parts", display=stopper, **settings)(sample)
    last = tmp_path / "parts" / "optimisation" / "step" / "last.ckpt"
    assert last.is_file()
    resumed = Stopper(-1)
    assert torch.equal(_prior(workspace=tmp_path / "parts", display=resumed, **settings)(sample), whole)
    assert "resumed" in resumed.lines[0]
    assert not last.exists()
    tables = [(tmp_path / name / "optimisation" / "step" / "validation.csv").read_text() for name in ("whole", "parts")]
    assert tables[0] == tables[1]
    assert "40,val,RMSE_v," in tables[0]


def test_signals_act_as_before_after_an_optimisation_that_ended_early(tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt):
        _prior(workspace=tmp_path, display=Stopper(2))(_sample())
    assert signal.getsignal(signal.SIGTERM) is before
    with pytest.raises(ValueError, match="diverged"):
        _prior(workspace=tmp_path, learning_rate=1e30, steps=50)(_sample())
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.slow
def test_killed_optimisation_resumes_from_the_last_minute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sample, settings = _sample(), {"steps": 30}
    whole = _prior(**settings)(sample)
    monkeypatch.setattr("dsr.methods.dip.upsampler._SECONDS_BETWEEN_CHECKPOINTS", -1.0)  # each step is a minute

    def kill(*_: object) -> None:
        raise RuntimeError("killed")

    with monkeypatch.context() as patch:
        patch.setattr("dsr.methods.dip.optimisation.PriorOptimisation.validation_step", kill)
        with pytest.raises(RuntimeError, match="killed"):
            _prior(workspace=tmp_path, **{**settings, "validate_every": 17})(sample)
    display = Stopper(-1)
    assert torch.equal(_prior(workspace=tmp_path, display=display, **settings)(sample), whole)
    assert "resumed" in display.lines[0]


@pytest.mark.slow
@pytest.mark.parametrize("spoil", ["settings", "input", "bytes"])
def test_checkpoint_of_another_optimisation_is_not_resumed(tmp_path: Path, spoil: str) -> None:
    sample = _sample()
    with pytest.raises(KeyboardInterrupt):
        _prior(workspace=tmp_path, display=Stopper(5))(sample)
    settings = {"learning_rate": 0.02} if spoil == "settings" else {}
    if spoil == "input":
        sample = DepthSample(**{**vars(sample), "depth_lr": sample.depth_lr * 1.01})
    if spoil == "bytes":
        last = tmp_path / "optimisation" / "step" / "last.ckpt"
        last.write_bytes(last.read_bytes()[:2000])
    display = Stopper(-1)
    assert torch.equal(_prior(workspace=tmp_path, display=display, **settings)(sample), _prior(**settings)(sample))
    assert "resumed" not in display.lines[0]


def test_expected_duration_is_announced_at_the_start() -> None:
    display = Stopper(-1)
    _prior(display=display)(_sample())
    pattern = (
        r"step: 12 steps at 32 x 48 in float32; about \d+ s \([\d.e-]+ s a step as measured now\), "
        r"about 0\.\d GiB of memory of its own"
    )
    assert re.fullmatch(pattern, display.lines[0])


@pytest.mark.slow
def test_stopping_rule_reports_its_step() -> None:
    display = Stopper(-1)
    noisy = _sample()
    _prior(display=display, steps=400, stopping="variance", patience=20, learning_rate=0.05)(noisy)
    assert re.fullmatch(r"step: stopped at step \d+ \(variance\)", display.lines[-1])
    assert "up to 400 steps" in display.lines[0]


def test_memory_of_a_step_grows_with_the_network() -> None:
    bytes_kept = [
        cost_of_step(_prior(widths=widths, border=0).module(_sample())[0])[1] for widths in ((4, 6), (32, 48))
    ]
    pixels = 32 * 48
    assert 4 * 4 * pixels < bytes_kept[0]
    assert 4 * 32 * pixels * 4 < bytes_kept[1] < 4 * 32 * pixels * 40


def test_measuring_a_step_changes_nothing() -> None:
    first, second = (_prior().module(_sample())[0] for _ in range(2))
    cost_of_step(first)
    for one, other in zip(first.answer(), second.answer(), strict=True):
        assert torch.equal(one, other)


def test_network_sees_a_mirrored_border_that_the_result_lacks() -> None:
    sample = _sample()
    module, _ = _prior(border=5).module(sample)
    assert module.start.shape == (1, 35, 42, 58)
    photo = module.start[0, 32:]
    torch.testing.assert_close(photo[:, 5:-5, 5:-5], sample.rgb)
    torch.testing.assert_close(photo[:, 4], photo[:, 6])
    depth, intensity = module.answer()
    assert depth.shape == intensity.shape == (1, 1, 32, 48)
    plain, _ = _prior(border=0).module(sample)
    assert plain.start.shape == (1, 35, 32, 48)
    wide, _ = _prior(border=100).module(sample)  # as far as there is something to mirror
    assert wide.start.shape == (1, 35, 32 + 62, 48 + 62)


def test_normals_of_noise_are_ignored() -> None:
    clean = _sample()
    draws = torch.randn(clean.depth_lr.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    noisy = DepthSample(**{**vars(clean), "depth_lr": clean.depth_lr * (1 + 0.02 * draws)})
    weights = [_prior(w=0.7).module(sample)[0].objective.w for sample in (clean, noisy)]
    assert weights == [0.7, 0.0]
    assert _prior(w=0.7, largest_tilt=None).module(noisy)[0].objective.w == 0.7
    display = Stopper(-1)
    _prior(steps=1, display=display)(noisy)
    noise = r"noise of \d\.\d+% tilts the input's normals by \d+ degrees"
    assert re.fullmatch(rf"step: without MSE_v; {noise}, more than largest_tilt", display.lines[1])


def test_oracle_is_flagged() -> None:
    assert _prior(stopping="oracle", validate_every=5).flag == "oracle"
    assert _prior(stopping="variance").flag == ""


@pytest.mark.slow
def test_warm_start_begins_at_the_result_of_the_trained_network() -> None:
    weights = packaged_weights("msg_v_x4")
    assert weights is not None
    settings = {"scale": 4, "downsampling": BOX, "weights": weights, "model": "msg_v", "widths": (16,), "skips": (4,)}
    sample = _sample(scale=4)
    warm = WarmStarted(**settings, steps=1, validate_every=0)  # type: ignore[arg-type]
    base = warm.base(sample)
    torch.testing.assert_close(warm(sample), base, rtol=0, atol=1e-6)
    module, _ = WarmStarted(**settings, steps=60, validate_every=0).module(sample)  # type: ignore[arg-type]
    before = float(module.problem.residual(base[None].float()))
    after = WarmStarted(**settings, steps=60, average=0.9, learning_rate=0.02, validate_every=0)(sample)  # type: ignore[arg-type]
    assert float(module.problem.residual(after[None].float())) < 0.8 * before


@pytest.mark.parametrize(
    "settings",
    [
        {"steps": 0}, {"learning_rate": 0.0}, {"average": 1.0}, {"widths": (4, 0)}, {"skips": (2,)}, {"patience": 0},
        {"validate_every": -1}, {"validate_every": 0, "stopping": "oracle"}, {"input_noise": 0.0, "guide": False},
        {"margin": -0.1}, {"border": -1}, {"stopping": "never"}, {"largest_tilt": -1.0},
    ],
)  # fmt: skip
def test_settings_out_of_range_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=f"^{next(iter(settings))}: expected"):
        _prior(**settings)

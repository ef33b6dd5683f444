"""Image priors: the loss, and the rules for when to stop."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera
from dsr.geometry.surface import depth_to_normals
from dsr.methods.dip.problem import ImageProblem, PriorObjective
from dsr.methods.dip.stopping import Fixed, Oracle, Residual, Variance
from dsr.methods.noise_level import estimate_noise, normal_noise_deg
from dsr.metrics.functional import SurfacePair, rmse_v
from dsr.metrics.losses import lap1
from dsr.sample import DepthSample, Scene

CAMERA = Camera(width=48, height=32, fx=60.0, fy=60.0, cx=23.5, cy=15.5)
CPU = torch.device("cpu")


def _depth(seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 2 + torch.rand(1, 32, 48, generator=generator, dtype=torch.float64)


def _sample(**changes: object) -> DepthSample:
    rgb = torch.rand(3, 32, 48, generator=torch.Generator().manual_seed(5))
    sample = make_sample(Scene("set", "hall", rgb, CAMERA, _depth()), 2, Downsampling("box"), "orthogonal")
    values = {**vars(sample), **changes}
    return DepthSample(**values)  # type: ignore[arg-type]


def _problem(**changes: object) -> ImageProblem:
    return ImageProblem.of(_sample(**changes), Downsampling("box"), "orthogonal", CPU)


def test_image_problem_does_not_depend_on_the_truth() -> None:
    given, blind = _problem(), _problem(depth=None)
    for name, value in vars(given).items():
        other = getattr(blind, name)
        assert torch.equal(value, other) if isinstance(value, Tensor) else value == other


def test_loss_is_the_sum_of_its_terms_on_low_resolution_maps() -> None:
    problem = _problem()
    depth, intensity = _depth(3).float()[None], torch.rand(1, 1, 32, 48)
    blocks = depth.view(1, 1, 16, 2, 24, 2).mean(dim=(3, 5))
    depth_lr = problem.depth_lr
    depth_range = float(depth_lr.max() - depth_lr.min())
    terms = PriorObjective("lap1", 2.0, 0.7, 0.3)(depth, intensity, problem)
    data = lap1(blocks / depth_range, depth_lr / depth_range)
    visual = rmse_v(SurfacePair(blocks, depth_lr, CAMERA.downscale(2).rays(dtype=torch.float32)[None])).square()
    photo = lap1(intensity, problem.grey)
    torch.testing.assert_close(terms["data_lap1"], data[0])
    torch.testing.assert_close(terms["mse_v"], visual[0])
    torch.testing.assert_close(terms["loss"], 2 * data[0] + 0.7 * visual[0] + 0.3 * photo[0])
    plain = PriorObjective("mse", 10.0, 0.0, 0.0)(depth, intensity, problem)
    torch.testing.assert_close(plain["loss"], 10 * ((blocks - depth_lr) / depth_range).square().mean())
    assert plain.keys() == {"loss", "data_mse"}


def test_photo_term_uses_luminance() -> None:
    rgb = torch.zeros(3, 32, 48)
    rgb[1] = 0.5
    torch.testing.assert_close(_problem(rgb=rgb).grey, torch.full((1, 1, 32, 48), 0.587 * 0.5))


@pytest.mark.parametrize("objective", [PriorObjective("mse", 10.0, 0.0, 0.0), PriorObjective("lap1", 1.0, 1.0, 0.0)])
def test_depth_under_a_hole_does_not_matter(objective: PriorObjective) -> None:
    depth_lr = _sample().depth_lr.clone()
    depth_lr[:, 4:9, 6:14] = torch.nan
    depth = _depth(3).float()[None].requires_grad_()
    objective(depth, torch.rand(1, 1, 32, 48), _problem(depth_lr=depth_lr))["loss"].backward()
    gradient = depth.grad
    assert gradient is not None
    assert bool(gradient.isfinite().all())
    assert float(gradient[..., 8:18, 12:28].abs().max()) == 0
    assert float(gradient[..., 20:, :].abs().min()) > 0


def test_loss_is_finite_where_no_two_neighbours_are_valid() -> None:
    depth_lr = torch.full((1, 16, 24), torch.nan, dtype=torch.float64)
    depth_lr[:, ::3, ::3] = 2.5
    depth = _depth().float()[None].requires_grad_()
    terms = PriorObjective()(depth, torch.rand(1, 1, 32, 48), _problem(depth_lr=depth_lr))
    terms["loss"].backward()
    assert bool(terms["loss"].isfinite())
    assert bool(depth.grad.isfinite().all())  # type: ignore[union-attr]


def test_forward_model_averages_the_configured_range_type() -> None:
    sample = _sample()
    kinds = {}
    for kind in (None, "perspective", "disparity"):
        model = Downsampling("box", range_type=kind)  # type: ignore[arg-type]
        problem = ImageProblem.of(sample, model, "orthogonal", CPU)
        kinds[kind] = problem.downsample(sample.depth[None].float())  # type: ignore[index]
    torch.testing.assert_close(kinds[None][0], sample.depth_lr.float())
    lengths = CAMERA.ray_lengths(dtype=torch.float32)
    blocks = (sample.depth.float() * lengths).view(1, 16, 2, 24, 2).mean(dim=(2, 4))  # type: ignore[union-attr]
    torch.testing.assert_close(kinds["perspective"][0], blocks / CAMERA.downscale(2).ray_lengths(dtype=torch.float32))
    assert bool((kinds["disparity"] <= kinds[None] + 1e-6).all())  # a harmonic mean is no larger


@pytest.mark.parametrize("values", [{"data_loss": "l2"}, {"w": -1.0}, {"data_weight": math.inf}, {"w_intensity": -0.1}])
def test_objectives_out_of_range_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=f"^{next(iter(values))}: expected"):
        PriorObjective(**values)  # type: ignore[arg-type]


def _iterates(steps: int, lowest: int) -> list[Tensor]:
    """Maps that scatter least at a step."""
    generator = torch.Generator().manual_seed(1)
    target = torch.rand(1, 1, 16, 16, generator=generator)
    spread = [0.02 + 0.5 * abs(step - lowest) / steps for step in range(1, steps + 1)]
    return [target + each * torch.randn(1, 1, 16, 16, generator=generator) for each in spread]


def _observe(rule: Variance, iterates: list[Tensor], start: int = 0) -> int | None:
    for step, depth in enumerate(iterates[start:], start + 1):
        if rule.observe(step, depth, torch.full_like(depth, float(step))):
            return step
    return None


def test_variance_rule_keeps_the_average_of_the_quietest_moment_and_stops_after_its_patience() -> None:
    iterates = _iterates(600, 300)
    rule = Variance(iterates[0], patience=100)
    stopped = _observe(rule, iterates)
    best = float(rule.result(torch.zeros(1, 1, 16, 16)).mean())
    assert 290 <= best <= 340  # the running variance lags a little
    assert stopped is not None
    assert 100 <= stopped - best <= 120


def test_variance_is_the_exponential_moving_variance() -> None:
    """Against the closed form: weights 0.1 * 0.9^k on past values, as a variance about their weighted mean."""
    values = torch.randn(80, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    rule = Variance(torch.zeros(1, 1, 1, 1, dtype=torch.float64), patience=1000)
    for step, value in enumerate(values, 1):
        rule.observe(step, value.view(1, 1, 1, 1), value.view(1, 1, 1, 1))
    weights = 0.1 * 0.9 ** torch.arange(79, -1, -1, dtype=torch.float64)
    weights[0] = 0.9**79  # the first value stands for all before it
    mean = (weights * values).sum()
    torch.testing.assert_close(rule.state()["variance"], (weights * (values - mean).square()).sum())


def test_variance_rule_never_stops_while_the_variance_falls() -> None:
    iterates = _iterates(300, 300)
    rule = Variance(iterates[0], patience=20)
    assert _observe(rule, iterates) is None
    assert float(rule.result(iterates[0]).mean()) > 285


def test_variance_rule_resumes_after_an_interruption() -> None:
    iterates = _iterates(600, 300)
    whole, first, second = (Variance(iterates[0], patience=100) for _ in range(3))
    end = _observe(whole, iterates)
    _observe(first, iterates[:217])
    second.restore(first.state())
    assert _observe(second, iterates, 217) == end
    assert all(torch.equal(value, second.state()[name]) for name, value in whole.state().items())


@pytest.mark.parametrize("std", [0.001, 0.01])
def test_noise_level_is_estimated_from_the_depth_map_alone(std: float) -> None:
    v, u = torch.meshgrid(torch.linspace(0, 1, 90), torch.linspace(0, 1, 120), indexing="ij")
    depth = (2 + u + 0.5 * v + 1.5 * (u > 0.4))[None, None].double()
    noisy = depth * (
        1 + std * torch.randn(depth.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    )
    noisy[..., 20:40, 30:60] = torch.nan
    assert estimate_noise(noisy) == pytest.approx(std, rel=0.1)
    assert estimate_noise(depth) < 1e-5
    assert estimate_noise(depth[..., :2, :2]) == 0


def test_normal_noise_deg_is_the_tilt_of_a_frontal_surface() -> None:
    camera = Camera(width=200, height=150, fx=80.0, fy=80.0, cx=99.5, cy=74.5)
    draws = torch.randn(1, 1, 150, 200, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    normals = depth_to_normals(3 * (1 + 0.001 * draws), camera.rays()[None])
    slopes = (normals[:, 0] / normals[:, 2])[..., 60:90, 80:120]
    assert math.degrees(math.atan(float(slopes.std()))) == pytest.approx(normal_noise_deg(0.001, camera), rel=0.1)
    assert normal_noise_deg(0.0, camera) == 0


def test_residual_rule_stops_when_the_map_is_explained_up_to_its_noise() -> None:
    problem = _problem()
    truth = _depth().float()[None]
    rule = Residual(problem.depth_lr, problem.residual)
    rule.noise = 0.01
    near, far = truth * 1.009, truth * 1.011
    assert float(problem.residual(near)) == pytest.approx(0.009, rel=1e-3)
    assert not rule.observe(100, far, far)
    assert rule.observe(100, far, near)
    assert not rule.observe(101, near, near)  # between two looks
    assert rule.result(near) is near


def test_oracle_keeps_the_best_result_and_resumes_after_an_interruption() -> None:
    rule, maps = Oracle(), [torch.full((1, 1, 2, 2), float(i)) for i in range(4)]
    assert rule.result(maps[0]) is maps[0]
    for score, each in zip((0.3, 0.1, 0.2), maps[1:], strict=True):
        rule.judge(score, each)
    assert torch.equal(rule.result(maps[0]), maps[2])
    again = Oracle()
    again.restore(rule.state())
    again.judge(0.15, maps[3])
    assert torch.equal(again.result(maps[0]), maps[2])


def test_fixed_rule_returns_the_last_average() -> None:
    rule, last = Fixed(), torch.rand(1, 1, 2, 2)
    rule.judge(0.0, torch.zeros(1, 1, 2, 2))
    assert not rule.observe(10_000, last, last)
    assert rule.result(last) is last

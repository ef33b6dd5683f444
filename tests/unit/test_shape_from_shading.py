"""Shape from shading and its regions of one colour: closed forms, dense references, exhaustive search."""

import itertools
import math

import cv2
import numpy as np
import pytest
import torch
from small_scenes import grid, sphere_depth
from torch.nn import functional

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera, from_range
from dsr.geometry.surface import depth_to_normals
from dsr.methods.classical.interpolation import Interpolation
from dsr.methods.classical.shape_from_shading import (
    Regions,
    ShadingSolver,
    ShapeFromShading,
    compute_shading,
    compute_surface,
    fit_albedo,
    fit_lighting,
    fuse,
)
from dsr.sample import Scene


def _everywhere(rgb):
    return torch.ones_like(rgb[:, :1], dtype=torch.bool)


def test_albedo_of_a_region_is_the_least_squares_one():
    """Of a photo of a disc before a wall under uneven light."""
    v, u = grid(24, 24)
    disc = (u - 11) ** 2 + (v - 13) ** 2 < 50
    near, far = (torch.tensor(colour)[:, None, None] for colour in ([0.8, 0.3, 0.5], [0.4, 0.6, 0.5]))
    shading = (0.5 + 0.4 * u / 24 + 0.1 * v.sin()).expand(1, 3, 24, 24)
    noise = torch.from_numpy(np.random.default_rng(0).normal(size=(1, 3, 24, 24)))
    rgb = torch.where(disc, near, far)[None] * shading + 0.03 * noise
    albedo = fit_albedo(rgb, shading, fuse(rgb, shading, 0.05, _everywhere(rgb)))
    for channel in range(3):
        for where in (disc, ~disc):
            expected = np.linalg.lstsq(
                shading[0, channel][where].numpy()[:, None], rgb[0, channel][where].numpy(), rcond=None
            )[0]
            torch.testing.assert_close(albedo[0, channel][where], torch.full((int(where.sum()),), expected[0]).double())


def test_row_of_pixels_is_cut_as_by_an_exhaustive_search():
    values = torch.tensor([0.2, 0.22, 0.21, 0.6, 0.62, 0.9, 0.88, 0.91]).double()
    rgb = values.reshape(1, 1, 1, 8)
    shading = torch.ones_like(rgb)

    def energy(labels):
        regions = Regions(labels.reshape(1, 1, 8), 8)
        missed = fit_albedo(rgb, shading, regions) * shading - rgb
        return 0.5 * float(missed.square().sum()) + 0.02 * int((labels.diff() != 0).sum())

    every = (torch.tensor([0, *np.cumsum(cuts)]) for cuts in itertools.product((0, 1), repeat=7))
    best = min(every, key=energy)
    assert torch.equal(fuse(rgb, shading, 0.02, _everywhere(rgb)).labels.reshape(-1), best)


def test_pixels_outside_stay_alone_and_separate_the_inside():
    rgb = torch.full((1, 1, 3, 5), 0.5).double()
    inside = torch.ones(1, 1, 3, 5, dtype=torch.bool)
    inside[..., 2] = False
    regions = fuse(rgb, torch.ones_like(rgb), 0.1, inside)
    assert regions.number == 2 + 3
    assert [len(side.unique()) for side in (regions.labels[..., :2], regions.labels[..., 3:])] == [1, 1]


LIGHT = torch.tensor([[[0.35, -0.3, -0.55, 0.15], [0.3, -0.25, -0.5, 0.2], [0.25, -0.3, -0.5, 0.2]]]).double()


def _camera(height, width, focal=None):
    focal = 1.2 * width if focal is None else focal
    return Camera(width, height, focal, 1.1 * focal, 0.45 * width, 0.55 * height)


def _sample(depth, rgb=None, scale=4, name="hall", focal=None):
    """Return the problem of a scene with this depth, (H, W)."""
    camera = _camera(*depth.shape, focal)
    rgb = torch.full((3, *depth.shape), 0.5) if rgb is None else rgb
    return make_sample(Scene("set", name, rgb, camera, depth[None]), scale, Downsampling("box"), "orthogonal")


def _lit(depth):
    """Return the photo of a surface of one colour under LIGHT, (3, H, W)."""
    normals = depth_to_normals(depth[None, None], _camera(*depth.shape).rays()[None])
    colour = torch.tensor([0.8, 0.7, 0.6]).double()[:, None, None]
    return (colour * compute_shading(normals, LIGHT)[0]).clamp(0, 1)


def _sphere(size):
    """Return a sphere of radius 0.6 m, 2 m away, before a wall that it is half sunk into, (H, W)."""
    return sphere_depth(_camera(size, size).rays(), (0.0, -0.05, 2.0), 0.6).clamp(max=1.8)


def _bumps(size):
    v, u = grid(size, size)
    hill = torch.exp(-((u - size / 2) ** 2 + (v - size / 2) ** 2) / (2 * (size / 5) ** 2))
    return 2 - 0.25 * hill + 0.02 * torch.sin(2 * math.pi * u / 9) * torch.sin(2 * math.pi * v / 11)


def _angle(depth, truth):
    """Return the mean angle between normals in degrees."""
    rays = _camera(*truth.shape).rays()[None]
    a, b = (depth_to_normals(each[None, None].double(), rays) for each in (depth, truth))
    return float(torch.rad2deg(torch.acos((a * b).sum(dim=1).clamp(-1, 1))).mean())


def _random(height, width, seed=0):
    rng = np.random.default_rng(seed)
    rgb = torch.from_numpy(rng.uniform(0, 1, (3, height, width))).float()
    return torch.from_numpy(rng.uniform(1.8, 2.2, (height, width))), rgb


def _solver(*, holes=False, mask=False):
    """Return a solver in the midst of a random problem of 16 x 16 pixels."""
    depth, rgb = _random(16, 16)
    sample = _sample(depth, rgb)
    if holes:
        sample.depth_lr[:, 1:3, 2] = torch.nan
    solver, _ = ShapeFromShading().prepare(sample)
    if mask:
        v, u = grid(16, 16)
        inside = ((u - 7) ** 2 + (v - 8) ** 2 < 40)[None, None]
        solver = ShadingSolver(solver.problem._replace(inside=inside), solver.z, solver.penalty)
    rng = np.random.default_rng(1)
    solver.theta = solver.theta + 0.2 * torch.from_numpy(rng.normal(size=(1, 3, 16, 16))) * solver.problem.inside
    solver.missed = 0.1 * torch.from_numpy(rng.normal(size=(1, 3, 16, 16))) * solver.problem.inside
    solver.update_albedo()
    solver.update_lighting()
    return solver


def _dense(operator, shape):
    """Return an operator's matrix, a column an input."""
    eye = torch.eye(math.prod(shape)).double().unflatten(1, shape)
    return torch.stack([operator(each[None]).flatten() for each in eye], dim=1).numpy()


@pytest.mark.parametrize(
    ("build", "area_weight", "share"), [(_sphere, 0.2, 0.85), (_bumps, 0.02, 0.5)], ids=["sphere", "bumps"]
)
def test_normals_of_a_shaded_surface_are_better_than_those_of_bicubic(build, area_weight, share):
    truth = build(40)
    sample = _sample(truth, _lit(truth))
    bicubic = _angle(Interpolation("bicubic")(sample)[0], truth)
    assert _angle(ShapeFromShading(iterations=15, area_weight=area_weight)(sample)[0], truth) < share * bicubic


@pytest.mark.parametrize(("holes", "mask"), [(False, False), (True, False), (False, True)])
def test_depth_step_is_the_least_squares_solution(holes, mask):
    """Of sqrt(data) (K z - coarse) and sqrt(penalty) (G z - theta + u), as dense matrices by numpy."""
    solver = _solver(holes=holes, mask=mask)
    problem, before = solver.problem, solver.z.flatten().numpy().copy()
    means = np.kron(np.kron(np.eye(4), np.full((1, 4), 0.25)), np.kron(np.eye(4), np.full((1, 4), 0.25)))
    lr = problem.lr.flatten().numpy()
    known = np.isfinite(lr)
    weights = np.array([1.0, 1.0, (problem.unit / 4) ** 2]).repeat(256) * np.tile(problem.inside.flatten().numpy(), 3)
    root = np.sqrt(solver.penalty * weights)[:, None]
    data = np.sqrt(problem.data_weight)
    matrix = np.concatenate((data * means[known], root * _dense(solver.slopes, (1, 16, 16))))
    right = np.concatenate((data * lr[known], root[:, 0] * (solver.theta - solver.missed).flatten().numpy()))
    free = problem.inside.flatten().numpy()
    expected = before.copy()
    expected[free] = np.linalg.lstsq(matrix[:, free], right - matrix[:, ~free] @ before[~free], rcond=None)[0]
    solver.update_depth(1.3)
    np.testing.assert_allclose(solver.z.flatten().numpy(), expected, rtol=0, atol=1e-4 * expected.std())


@pytest.mark.parametrize("mask", [False, True])
def test_gradient_in_theta_is_that_of_the_energy_and_vanishes_after_some_steps(mask):
    solver = _solver(mask=mask)
    target = solver.slopes(solver.z) + solver.missed
    first, hessian = solver.expand_energy(solver.theta, target)
    theta = solver.theta.clone().requires_grad_()
    torch.testing.assert_close(torch.autograd.grad(solver.pixel_energy(theta, target).sum(), theta)[0], first)
    assert bool((hessian[:, [0, 3, 5]] >= 0).all())
    for _ in range(20):
        solver.update_theta()
    last, _ = solver.expand_energy(solver.theta, target)
    assert float(last.square().mean()) < 1e-3 * float(first.square().mean())


@pytest.mark.parametrize(("scale", "holes"), [(2, False), (4, True), (8, False)])
def test_slanted_plane_of_one_colour_is_reproduced_to_a_hundredth_of_its_depth(scale, holes):
    v, u = grid(32, 48)
    truth = from_range((40 + 0.05 * u - 0.03 * v)[None], _camera(32, 48, 400.0), "disparity")[0]
    sample = _sample(truth, None, scale, focal=400.0)
    if holes:
        sample.depth_lr[:, 3:5, 4:6] = torch.nan
    fine = ShapeFromShading(iterations=10)(sample)[0]
    assert float((fine / truth - 1).abs().max()) < 1e-2
    assert float((fine / truth - 1).square().mean().sqrt()) < 1e-3


def test_iteration_stops_at_convergence_and_reports_progress():
    reported, truth = [], _sphere(32)
    method = ShapeFromShading(iterations=60, tolerance=3e-3)
    method(_sample(truth, _lit(truth)), lambda *now: reported.append(now))
    steps, last, before = len(method.history), method.history[-1], method.history[-2]
    assert 2 < steps < 60
    assert reported == [*((done, 60) for done in range(1, steps + 1)), (60, 60)]
    assert last["residual"] < 3e-3
    assert abs(last["objective"] - before["objective"]) < 3e-3 * before["objective"]
    assert last["objective"] == pytest.approx(sum(last[name] for name in ("shading", "data", "area", "boundaries")))
    assert last["objective"] < method.history[0]["objective"]


def test_background_keeps_the_initial_map(tmp_path):
    truth = _bumps(32)
    sample = _sample(truth, _lit(truth), name="bumps")
    v, u = grid(32, 32)
    inside = (u - 15) ** 2 + (v - 17) ** 2 < 90
    cv2.imwrite(str(tmp_path / "bumps.png"), 255 * inside.numpy().astype(np.uint8))
    method = ShapeFromShading(iterations=5, foreground=str(tmp_path))
    solver, metres = method.prepare(sample)
    first = solver.z[0, 0] * metres
    fine = method(sample)[0]
    torch.testing.assert_close(fine[~inside], first[~inside])
    assert float((fine - first)[inside].abs().mean()) > 1e-4
    assert float((fine - truth)[inside].square().mean()) < float((first - truth)[inside].square().mean())


def test_missing_damaged_empty_or_misfitting_mask_is_refused_by_name(tmp_path):
    path, method = tmp_path / "hall.png", ShapeFromShading(iterations=1, foreground=str(tmp_path))
    wide, black = (cv2.imencode(".png", np.full((16, n), 255 * (n > 16), np.uint8))[1].tobytes() for n in (20, 16))
    for content, message in ((None, "no such file"), (b"no picture", "damaged"), (wide, "16 x 20"), (black, "black")):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(ValueError, match=rf"hall\.png: .*{message}"):
            method(_sample(_bumps(16)))


def test_rendering_converges_to_that_of_the_geometrys_normals():
    errors = []
    for size in (64, 128):
        theta, depth, rays = _smooth_theta(size)
        expected = compute_shading(depth_to_normals(depth, rays), LIGHT)
        errors.append(float((compute_shading(compute_surface(theta, rays)[0], LIGHT) - expected).abs().max()))
    assert errors[0] < 0.01
    assert errors[1] == pytest.approx(errors[0] / 2, rel=0.1)  # of differences taken to one side


def test_area_is_that_of_the_back_projected_pixels():
    theta, depth, rays = _smooth_theta(256)
    points, camera = (depth * rays)[0], _camera(256, 256)
    along_u, along_v = points.diff(dim=2)[:, :-1], points.diff(dim=1)[:, :, :-1]
    expected = torch.linalg.cross(along_u, along_v, dim=0).norm(dim=0)
    ours = (depth * compute_surface(theta, rays)[1])[0, 0, :-1, :-1] / (camera.fx * camera.fy)
    torch.testing.assert_close(ours, expected, rtol=0.02, atol=0)
    assert float(ours.sum()) == pytest.approx(float(expected.sum()), rel=2e-3)


def _smooth_theta(size):
    """Return a smooth surface's slopes and depth, (1, 3, H, W), from forward differences, its depth, and the rays."""
    camera = _camera(size, size)
    rays = camera.rays()
    depth = 2 + 0.3 * torch.sin(3 * rays[0]) * torch.cos(2 * rays[1]) + 0.2 * rays[0]
    slopes = [
        focal * torch.cat((depth.diff(dim=dim), depth.diff(dim=dim).narrow(dim, -1, 1)), dim)
        for dim, focal in ((1, camera.fx), (0, camera.fy))
    ]
    return torch.stack((*slopes, depth))[None], depth[None, None], rays[None]


def test_light_is_recovered_exactly_from_a_photo_without_noise():
    rng = np.random.default_rng(0)
    normals = functional.normalize(torch.from_numpy(rng.normal(size=(1, 3, 3, 4))), dim=1)
    albedo = torch.from_numpy(rng.uniform(0.1, 1, (1, 3, 3, 4)))
    rgb = albedo * compute_shading(normals, LIGHT)
    inside = torch.ones(1, 1, 3, 4).double()
    torch.testing.assert_close(fit_lighting(rgb, albedo, normals, inside), LIGHT)
    rgb[..., 1:3, 2] = 0.7
    inside[..., 1:3, 2] = 0
    torch.testing.assert_close(fit_lighting(rgb, albedo, normals, inside), LIGHT)


def test_light_on_a_flat_wall_is_the_smallest_that_explains_it():
    normals = torch.tensor([0.0, 0.0, -1.0]).double()[:, None, None].expand(1, 3, 4, 5)
    albedo = torch.ones(1, 1, 4, 5).double()
    light = fit_lighting(0.6 * albedo, albedo, normals, torch.ones_like(albedo))
    torch.testing.assert_close(light, torch.tensor([[[0.0, 0.0, -0.3, 0.3]]]).double())

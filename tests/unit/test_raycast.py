"""The ray caster against closed forms that are worked out here on paper."""

import math

import numpy as np
import pytest

from dsr.geometry.camera import Camera
from dsr.synthetic.raycast import Body, Box, Cylinder, Implicit, Plane, Sphere, World, area_light, cast, render

BACK = Plane(np.array([0.0, 0.0, 4.0]), np.array([0.0, 0.0, -1.0]))
AHEAD = np.array([[0.0], [0.0], [1.0]])
EYE = np.zeros((3, 1))


def white(points):
    return np.ones_like(points)


def grey(points):
    return np.full_like(points, 0.2)


def small_camera(size=33):
    return Camera(size, size, 1.2 * size, 1.2 * size, (size - 1) / 2, (size - 1) / 2)


def scene_of(*surfaces, spread=0.02, light=(-1.0, -1.5, 1.0)):
    lights = area_light(np.array(light), np.array([0.2, 0.0, 0.0]), np.array([0.0, 0.2, 0.0]), 3)
    return World(tuple(Body(surface, grey) for surface in (*surfaces, BACK)), lights, spread)


def test_frontal_plane_has_constant_depth_not_constant_distance():
    _, depth = render(scene_of(), small_camera())
    np.testing.assert_array_equal(depth, 4.0)


def test_slanted_plane_has_affine_inverse_depth():
    facing = np.array([0.6, 0.0, -0.8])
    slanted = Body(Plane(np.array([0.0, 0.0, 2.0]), facing), white)
    _, depth = render(World((slanted,), np.zeros((3, 9)), 0.0), small_camera())
    x = (np.arange(33) - 16) / (1.2 * 33)
    np.testing.assert_allclose(1 / depth, np.broadcast_to((0.8 - 0.6 * x) / 1.6, (33, 33)), rtol=1e-14)


def test_ray_through_a_sphere_centre_hits_at_its_distance_minus_the_radius():
    hit = Sphere(np.array([0.0, 0.0, 3.0]), np.eye(3), 0.5).intersect(EYE, AHEAD)
    assert hit[0] == pytest.approx(2.5, abs=1e-15)


def test_off_axis_sphere_is_hit_as_by_the_quadratic_formula():
    c, r = np.array([0.2, -0.1, 3.0]), 0.5
    d = np.array([0.1, -0.05, 1.0])
    a, b = d @ d, d @ c
    expected = (b - math.sqrt(b * b - a * (c @ c - r * r))) / a
    assert Sphere(c, np.eye(3), r).intersect(EYE, d[:, None])[0] == pytest.approx(expected, abs=1e-14)


def test_rays_miss_a_sphere_beyond_its_silhouette():
    sphere = Sphere(np.array([0.0, 0.0, 3.0]), np.eye(3), 0.5)
    edge = 0.5 / math.sqrt(9 - 0.25)  # tangent of the half angle of the silhouette
    inside, outside = sphere.intersect(np.zeros((3, 2)), np.array([[edge * 0.9999, edge * 1.0001], [0, 0], [1, 1]]))
    assert np.isfinite(inside)
    assert outside == np.inf


def test_cylinder_shows_its_side_and_its_cap_at_the_right_depths():
    upright = Cylinder(np.array([0.0, 0.0, 3.0]), np.eye(3), 0.4, 0.7)
    assert upright.intersect(EYE, AHEAD)[0] == pytest.approx(2.6, abs=1e-15)
    end_on = Cylinder(np.array([0.0, 0.0, 3.0]), np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), 0.4, 0.7)
    hit = end_on.intersect(EYE, AHEAD)
    assert hit[0] == pytest.approx(2.3, abs=1e-15)
    np.testing.assert_allclose(end_on.normal(hit * AHEAD)[:, 0], [0, 0, -1], atol=1e-15)


def test_box_on_edge_shows_its_edge_at_the_half_diagonal():
    s = math.sqrt(0.5)
    box = Box(np.array([0.0, 0.0, 3.0]), np.array([[s, 0, s], [0, 1, 0], [-s, 0, s]]), np.full(3, 0.4))
    assert box.intersect(EYE, AHEAD)[0] == pytest.approx(3 - 0.4 * math.sqrt(2), abs=1e-14)


def test_objects_behind_the_camera_are_not_hit():
    for surface in (
        Sphere(np.array([0.0, 0.0, -3.0]), np.eye(3), 0.5),
        Box(np.array([0.0, 0.0, -3.0]), np.eye(3), np.full(3, 0.5)),
        Plane(np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, -1.0])),
    ):
        assert surface.intersect(EYE, AHEAD)[0] == np.inf


def test_implicit_sphere_agrees_with_the_exact_one():
    exact = Sphere(np.array([0.1, 0.0, 3.0]), np.eye(3), 0.5)
    bounds = Box(exact.centre, np.eye(3), np.full(3, 0.55))
    implicit = Implicit(lambda p: np.sqrt(((p - exact.centre[:, None]) ** 2).sum(0)) - 0.5, bounds)
    rays = small_camera().rays().numpy().reshape(3, -1)
    found, expected = (s.intersect(np.zeros_like(rays), rays) for s in (implicit, exact))
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(expected))
    hit = np.isfinite(expected)
    np.testing.assert_allclose(found[hit], expected[hit], atol=1e-9)
    points = expected[hit] * rays[:, hit]
    np.testing.assert_allclose(implicit.normal(points), exact.normal(points), atol=1e-3)


def test_nearest_body_is_seen():
    near, far = (Sphere(np.array([0.0, 0.0, z]), np.eye(3), 0.3) for z in (2.0, 3.0))
    depth, index = cast(scene_of(far, near), AHEAD)
    assert depth[0] == pytest.approx(1.7)
    assert index[0] == 1


def test_plain_wall_is_brightest_as_by_the_cosine_law():
    rgb, _ = render(scene_of(light=(0.5, -0.4, 2.0)), small_camera())
    v, u = np.unravel_index(rgb.sum(-1).astype(int).argmax(), (33, 33))
    assert (u - 16, v - 16) == pytest.approx((0.5 / 4 * 1.2 * 33, -0.4 / 4 * 1.2 * 33), abs=2.5)


def test_shadows_fall_away_from_the_light_and_have_soft_edges():
    ball = Sphere(np.array([0.0, 0.0, 3.0]), np.eye(3), 0.3)
    camera = small_camera(65)
    with_ball, _ = render(scene_of(ball, light=(-2.0, 0.0, 1.0)), camera)
    without, _ = render(scene_of(light=(-2.0, 0.0, 1.0)), camera)
    # the light, the ball's centre and the shadow's centre at x = 1 on the wall lie on one line
    column = round(32 + 1.0 / 4 * camera.fx)
    ratio = with_ball[32, :, 1] / without[32, :, 1]
    assert ratio[column] < 0.8
    assert ratio[2] == pytest.approx(1.0, abs=0.02)
    penumbra = ratio[column - 12 : column + 13]
    assert np.any((penumbra > ratio[column] + 0.05) & (penumbra < 0.95))


def test_edges_of_the_photo_are_antialiased():
    camera = small_camera(65)
    lights = np.tile([[0.0], [0.0], [-1.0]], 9)
    black = Body(Sphere(np.array([0.0, 0.0, 3.0]), np.eye(3), 0.5), np.zeros_like)
    rgb, _ = render(World((black, Body(BACK, white)), lights, 0.0), camera)
    assert len(np.unique(rgb[20, :, 0])) > 3
    assert rgb[32, 32, 0] == 0

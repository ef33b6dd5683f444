"""Scenes that are made: the ray caster in closed forms, SimGeo's exact depth, and random scenes as they are traced."""

import functools
import math

import numpy as np
import pytest

from dsr.geometry.camera import Camera
from dsr.synthetic.procedural.photo import Tracer, Viewpoint
from dsr.synthetic.procedural.random_scene import make_camera
from dsr.synthetic.procedural.shape import box, ellipsoid, extrusion, merge, quad, surface
from dsr.synthetic.raycast import (
    Body,
    Box,
    Cylinder,
    Implicit,
    Plane,
    Sphere,
    World,
    area_light,
    render,
    rotation_about,
)
from dsr.synthetic.simgeo import SCENES, build_scene, render_scene

SIZE = 64


@functools.cache
def rendering(name, size=SIZE):
    return render_scene(name, size)


def object_points(name, number):
    """Back-project the pixels of the body ``number``, nearest to the camera of all."""
    picture = rendering(name)
    rays = picture.camera.rays().numpy()
    origin = np.zeros((3, SIZE * SIZE))
    hits = np.stack([body.surface.intersect(origin, rays.reshape(3, -1)) for body in build_scene(name).bodies])
    mine = (hits.argmin(0) == number).reshape(SIZE, SIZE)
    return (picture.depth * rays)[:, mine]


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_same_ray_has_the_same_depth_at_any_size(name):
    # pixel u at 32 and pixel 3 u + 1 at 96 look along one ray
    np.testing.assert_allclose(rendering(name, 32).depth, rendering(name, 96).depth[1::3, 1::3], atol=1e-8)
    camera = rendering(name, 32).camera
    assert camera.fx == camera.fy == pytest.approx(618.0386 * 32 / 512, rel=1e-15)
    assert (camera.cx, camera.cy, camera.baseline) == (15.5, 15.5, 0.2)


def test_cube_and_wall_have_exactly_four_normals_three_of_them_orthogonal():
    picture = rendering("cube_no_texture")
    points = picture.camera.rays().numpy() * picture.depth
    down, right = np.diff(points, axis=1)[:, :, :-1], np.diff(points, axis=2)[:, :-1]
    normal = np.cross(down, right, axis=0)
    normal /= np.linalg.norm(normal, axis=0)
    flat = np.abs((normal * (points[:, 1:, 1:] - points[:, :-1, :-1])).sum(0)) < 1e-9  # 2 x 2 pixels on one plane
    found, count = np.unique(np.round(normal[:, flat].T, 6) + 0.0, axis=0, return_counts=True)
    assert len(found) == 4
    assert count.min() > 50
    faces = found[np.abs(found[:, 2]) < 0.999]
    np.testing.assert_allclose(faces @ faces.T, np.eye(3), atol=1e-5)


def test_points_lie_on_the_sphere_and_on_the_cylinders_side_or_its_cap():
    sphere, cylinder, _ = (body.surface for body in build_scene("sphere_cylinder_no_texture").bodies)
    points = object_points("sphere_cylinder_no_texture", 0)
    assert points.shape[1] > 300
    np.testing.assert_allclose(np.linalg.norm(points - sphere.centre[:, None], axis=0), sphere.radius, rtol=1e-13)
    away = object_points("sphere_cylinder_no_texture", 1) - cylinder.centre[:, None]
    axis = cylinder.axes[:, 1]
    height = axis @ away
    across = np.linalg.norm(away - axis[:, None] * height, axis=0)
    side = np.isclose(across, cylinder.radius, rtol=1e-13) & (np.abs(height) <= cylinder.half)
    cap = np.isclose(np.abs(height), cylinder.half, rtol=1e-13) & (across <= cylinder.radius)
    assert np.all(side | cap)
    assert side.sum() > 300
    assert cap.sum() > 30


@pytest.mark.slow
def test_statue_fills_the_picture_with_many_normals_at_roots_of_its_distance_function():
    statue, points = build_scene("statue").bodies[0].surface, object_points("statue", 0)
    assert points.shape[1] > 700
    assert np.abs(statue.distance(points)).max() < 1e-9
    assert np.ptp(points[1] / points[2] * rendering("statue").camera.fy) > 0.85 * SIZE
    assert len(np.unique(np.round(3 * statue.normal(points)), axis=1).T) > 60


BACK = Plane(np.array([0.0, 0.0, 4.0]), np.array([0.0, 0.0, -1.0]))
AHEAD = np.array([[0.0], [0.0], [1.0]])
EYE = np.zeros((3, 1))


def grey(points):
    return np.full_like(points, 0.2)


def small_camera(size=33):
    return Camera(size, size, 1.2 * size, 1.2 * size, (size - 1) / 2, (size - 1) / 2)


def scene_of(*surfaces, light=(-1.0, -1.5, 1.0)):
    lights = area_light(np.array(light), np.array([0.2, 0.0, 0.0]), np.array([0.0, 0.2, 0.0]), 3)
    return World(tuple(Body(surface, grey) for surface in (*surfaces, BACK)), lights, 0.02)


def test_planes_have_affine_inverse_depth():
    _, depth = render(scene_of(), small_camera())
    np.testing.assert_array_equal(depth, 4.0)
    facing = np.array([0.6, 0.0, -0.8])
    slanted = Body(Plane(np.array([0.0, 0.0, 2.0]), facing), np.ones_like)
    _, depth = render(World((slanted,), np.zeros((3, 9)), 0.0), small_camera())
    x = (np.arange(33) - 16) / (1.2 * 33)
    np.testing.assert_allclose(1 / depth, np.broadcast_to((0.8 - 0.6 * x) / 1.6, (33, 33)), rtol=1e-14)


def test_sphere_is_hit_as_by_the_quadratic_formula_up_to_its_silhouette():
    c, r = np.array([0.2, -0.1, 3.0]), 0.5
    d = np.array([0.1, -0.05, 1.0])
    a, b = d @ d, d @ c
    expected = (b - math.sqrt(b * b - a * (c @ c - r * r))) / a
    assert Sphere(c, np.eye(3), r).intersect(EYE, d[:, None])[0] == pytest.approx(expected, abs=1e-14)
    sphere = Sphere(np.array([0.0, 0.0, 3.0]), np.eye(3), 0.5)
    edge = 0.5 / math.sqrt(9 - 0.25)  # tangent of the half angle of the silhouette
    inside, outside = sphere.intersect(np.zeros((3, 2)), np.array([[edge * 0.9999, edge * 1.0001], [0, 0], [1, 1]]))
    assert np.isfinite(inside)
    assert outside == np.inf


AT_3, HALF = np.array([0.0, 0.0, 3.0]), math.sqrt(0.5)
UPRIGHT, END_ON = np.eye(3), np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
ON_EDGE = np.array([[HALF, 0, HALF], [0, 1, 0], [-HALF, 0, HALF]])


@pytest.mark.parametrize(
    ("surface", "depth"),
    [
        (Cylinder(AT_3, UPRIGHT, 0.4, 0.7), 2.6), (Cylinder(AT_3, END_ON, 0.4, 0.7), 2.3),
        (Box(AT_3, ON_EDGE, np.full(3, 0.4)), 3 - 0.4 * math.sqrt(2)), (Sphere(-AT_3, np.eye(3), 0.5), np.inf),
        (Box(-AT_3, np.eye(3), np.full(3, 0.4)), np.inf),
        (Plane(np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, -1.0])), np.inf),
    ],
)  # fmt: skip
def test_ray_ahead_hits_what_is_in_front_of_the_camera_at_its_depth(surface, depth):
    hit = surface.intersect(EYE, AHEAD)
    assert hit[0] == pytest.approx(depth, abs=1e-14)
    if isinstance(surface, Cylinder):
        np.testing.assert_allclose(surface.normal(hit * AHEAD)[:, 0], [0, 0, -1], atol=1e-15)


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


VIEW = 96
ORIGIN = np.zeros(3)
FORWARD = Viewpoint(ORIGIN, np.array([0.0, 1.0, 0.0]), 1.0, 0.0, np.array([0.5, 0.5]))


@functools.cache
def rays(size=VIEW):
    """Rays (3, size * size) of a camera at the origin that looks along z."""
    return make_camera(FORWARD, size).rays().numpy().reshape(3, -1)


def test_plane_has_the_depth_of_its_closed_form_without_steps():
    normal, distance = np.array([0.3, -0.5, -0.81]), 2.7
    normal /= np.linalg.norm(normal)
    side = np.cross(normal, [0.0, 1.0, 0.0])
    up = np.cross(normal, side)
    tracer = Tracer([quad(-distance * normal - 20 * side - 20 * up, 40 * side, 40 * up)])
    depth = tracer.trace(ORIGIN, rays()).depth
    np.testing.assert_allclose(depth, -distance / (normal @ rays()), rtol=1e-12)
    points = (depth * rays()).reshape(3, VIEW, VIEW)
    du, dv = np.diff(points, axis=2)[:, :-1], np.diff(points, axis=1)[:, :, :-1]
    seen = np.cross(dv, du, axis=0)
    seen /= np.linalg.norm(seen, axis=0)
    np.testing.assert_allclose(seen, np.broadcast_to(normal[:, None, None], seen.shape), atol=1e-6)


def test_ball_is_rounder_than_its_triangles():
    radius, centre = 0.8, np.array([0.1, -0.2, 3.0])
    shape = ellipsoid(np.full(3, radius), np.ones(2)).rotate(rotation_about(0, 71.0)).translate(*centre)
    hits = Tracer([shape]).trace(ORIGIN, rays())
    slope, square = centre @ rays(), (rays() ** 2).sum(0)
    root = slope**2 - square * (centre @ centre - radius**2)
    inner = root > 0.1 * slope**2 * radius**2 / (centre @ centre)  # away from the outline
    exact = (slope - np.sqrt(np.maximum(root, 0))) / square
    assert inner.sum() > 1000
    away = np.abs(hits.depth - exact)[inner]
    np.testing.assert_allclose(np.linalg.norm(shape.vertices - centre, axis=1), radius, atol=1e-12)
    sag = radius - np.linalg.norm(shape.vertices[shape.faces].mean(1) - centre, axis=1)
    assert sag.max() > 2e-4  # the triangles cut the ball
    assert away.max() < 2e-5
    n = (hits.points[:, inner] - centre[:, None]) / radius
    assert (n * hits.normals[:, inner]).sum(0).min() > 1 - 4e-6  # 0.16 degrees


def test_hits_of_flat_objects_lie_on_their_triangles():
    rng = np.random.default_rng(4)
    things = [box([0.5, 0.7, 0.4]), extrusion([np.array([[0, 0], [0.5, 0.1], [0.3, 0.6]])], 0.4)]
    shapes = [
        s.rotate(rotation_about(0, rng.uniform(0, 90))).translate(k - 0.5, 0.0, 3.0) for k, s in enumerate(things)
    ]
    hits, mesh = Tracer(shapes).trace(ORIGIN, rays()), merge(shapes)
    on = hits.face >= 0
    assert on.sum() > 500
    assert set(np.unique(hits.body[on])) == {0, 1}
    a, b, c = mesh.vertices[mesh.faces[hits.face[on]]].transpose(1, 2, 0)
    normal = np.cross(b - a, c - a, axis=0)
    normal /= np.linalg.norm(normal, axis=0)
    assert np.abs((normal * (hits.points[:, on] - a)).sum(0)).max() < 1e-9
    assert np.isinf(hits.depth[~on]).all()


def test_depth_of_a_relief_is_continuous_from_triangle_to_triangle():
    u, v = np.meshgrid(np.linspace(-2, 2, 60), np.linspace(-2, 2, 60))
    tracer = Tracer([surface(np.stack((u, v, 3 + 0.1 * np.sin(3 * u) * np.cos(2 * v)), axis=-1))])
    depth = tracer.trace(ORIGIN, rays(192)).depth.reshape(192, 192)
    points = depth * rays(192).reshape(3, 192, 192)
    exact = 3 + 0.1 * np.sin(3 * points[0]) * np.cos(2 * points[1])
    assert np.abs(points[2] - exact)[8:-8, 8:-8].max() < 4e-4  # triangles alone: 0.1 * 9 * 0.068**2 / 4 = 1e-3
    kink = np.abs(np.diff(depth, 2, axis=1))
    assert kink.max() < 6 * np.median(kink) + 1e-4

"""Random scenes: exact depth of what the ray tracer says it traces, and shapes of the stated sizes."""

import functools

import numpy as np
import pytest

from dsr.synthetic.procedural.materials import PAINTS, picture_paint
from dsr.synthetic.procedural.photo import Tracer, Viewpoint
from dsr.synthetic.procedural.random_scene import LAYOUTS, make_camera, random_scene, render, render_random_scene
from dsr.synthetic.procedural.reliefs import RELIEFS, relief
from dsr.synthetic.procedural.shape import SOLIDS, box, ellipsoid, extrusion, merge, quad, surface
from dsr.synthetic.raycast import rotation_about

SIZE = 96
ORIGIN = np.zeros(3)
FORWARD = Viewpoint(ORIGIN, np.array([0.0, 1.0, 0.0]), 1.0, 0.0, np.array([0.5, 0.5]))


@functools.cache
def scenes(count=7):
    """The first scenes of a series, small."""
    return [render_random_scene(3, index, 48) for index in range(count)]


@functools.cache
def rays(size=SIZE):
    """Rays (3, size * size) of a camera at the origin that looks along z."""
    return make_camera(FORWARD, size).rays().numpy().reshape(3, -1)


@pytest.mark.slow
@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_close_the_view_and_keep_their_ranges(layout):
    scene = random_scene(np.random.default_rng(8), layout)
    picture = render(scene, 64)
    assert np.isfinite(picture.depth).all()
    assert picture.depth.min() > 0.2
    assert np.median(picture.depth) < 25
    assert 10 < picture.rgb.mean() < 245
    assert picture.rgb.std() > 4


def test_plane_has_the_depth_of_its_closed_form_without_steps():
    normal, distance = np.array([0.3, -0.5, -0.81]), 2.7
    normal /= np.linalg.norm(normal)
    side = np.cross(normal, [0.0, 1.0, 0.0])
    up = np.cross(normal, side)
    tracer = Tracer([quad(-distance * normal - 20 * side - 20 * up, 40 * side, 40 * up)])
    depth = tracer.trace(ORIGIN, rays()).depth
    np.testing.assert_allclose(depth, -distance / (normal @ rays()), rtol=1e-12)
    points = (depth * rays()).reshape(3, SIZE, SIZE)
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


@pytest.mark.parametrize("maker", SOLIDS, ids=lambda maker: maker.__name__)
def test_solids_are_about_1_in_size_and_stand_on_the_ground(maker):
    for seed in range(4):
        shape = maker(np.random.default_rng(seed))
        size = np.ptp(shape.vertices, axis=0)
        assert 0.1 < size.max() < 1.7
        assert abs(shape.vertices[:, 2].min()) < 0.16
        np.testing.assert_allclose(np.linalg.norm(shape.normals, axis=1), 1, atol=1e-9)
        assert shape.faces.max() < len(shape.vertices)


@pytest.mark.parametrize("maker", RELIEFS, ids=lambda maker: maker.__name__)
def test_reliefs_are_finite_and_shallow(maker):
    shape = relief(np.random.default_rng(1), maker, 2.0, 64)
    assert np.isfinite(shape.vertices).all()
    assert 0.005 < np.ptp(shape.vertices[:, 2]) < 1.2
    assert np.ptp(shape.chart[:, 2]) > 0.1


@pytest.mark.parametrize("make", [*PAINTS, picture_paint], ids=lambda make: make.__name__)
def test_paints_are_colours_independent_of_how_they_are_evaluated(make):
    points, chart = np.random.default_rng(0).uniform(-1, 1, (2, 3, 500))
    for seed in range(3):
        paint = make(np.random.default_rng(seed), "any", 0.5)
        colour = paint(points, chart)
        assert colour.shape == (3, 500)
        assert colour.min() >= 0
        assert colour.max() < 1.4
        np.testing.assert_allclose(paint(points[:, 100:200], chart[:, 100:200]), colour[:, 100:200], atol=1e-12)

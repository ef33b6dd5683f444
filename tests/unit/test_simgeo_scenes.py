"""The six SimGeo scenes: exact depth, shared geometry, paint that follows the name."""

import functools

import numpy as np
import pytest

from dsr.synthetic.raycast import Implicit
from dsr.synthetic.simgeo import SCENES, WALL_Z, build_scene, render_scene

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


def depth_to_normals(picture):
    """Return forward-difference normals and where the 2 x 2 neighbourhood is on one plane."""
    points = picture.camera.rays().numpy() * picture.depth
    down, right = np.diff(points, axis=1)[:, :, :-1], np.diff(points, axis=2)[:, :-1]
    normal = np.cross(down, right, axis=0)
    normal /= np.linalg.norm(normal, axis=0)
    corner = points[:, 1:, 1:] - points[:, :-1, :-1]
    return normal, np.abs((normal * corner).sum(0)) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_images_have_the_documented_ranges(name):
    picture = rendering(name)
    assert picture.depth.min() > 2.3
    assert picture.depth.max() == WALL_Z <= 4.0
    assert picture.rgb.max() > 150
    assert picture.rgb.min() < 110


def test_camera_keeps_its_field_of_view_at_any_size():
    camera = rendering("cube_no_texture").camera
    assert camera.fx == camera.fy == pytest.approx(618.0386 * SIZE / 512, rel=1e-15)
    assert camera.cx == camera.cy == (SIZE - 1) / 2
    assert camera.baseline == 0.2


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_same_ray_has_the_same_depth_at_any_size(name):
    # pixel u at 32 and pixel 3 u + 1 at 96 look along one ray
    np.testing.assert_allclose(rendering(name, 32).depth, rendering(name, 96).depth[1::3, 1::3], atol=1e-8)


def test_variants_of_a_scene_share_their_depth_but_not_their_photo():
    for group in (SCENES[:2], SCENES[2:5]):
        first, *others = (rendering(name) for name in group)
        for other in others:
            np.testing.assert_array_equal(other.depth, first.depth)
            assert np.abs(other.rgb.astype(int) - first.rgb).mean() > 5


def test_cube_and_wall_have_exactly_four_normals_three_of_them_orthogonal():
    normal, flat = depth_to_normals(rendering("cube_no_texture"))
    found, count = np.unique(np.round(normal[:, flat].T, 6) + 0.0, axis=0, return_counts=True)
    assert len(found) == 4
    assert count.min() > 50
    faces = found[np.abs(found[:, 2]) < 0.999]
    np.testing.assert_allclose(faces @ faces.T, np.eye(3), atol=1e-5)


def test_sphere_points_lie_on_the_sphere():
    sphere = build_scene("sphere_cylinder_no_texture").bodies[0].surface
    points = object_points("sphere_cylinder_no_texture", 0)
    assert points.shape[1] > 300
    np.testing.assert_allclose(np.linalg.norm(points - sphere.centre[:, None], axis=0), sphere.radius, rtol=1e-13)


def test_cylinder_points_lie_on_its_side_or_its_cap():
    cylinder = build_scene("sphere_cylinder_no_texture").bodies[1].surface
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
def test_statue_points_are_roots_of_its_distance_function():
    statue = build_scene("statue").bodies[0].surface
    assert isinstance(statue, Implicit)
    points = object_points("statue", 0)
    assert points.shape[1] > 700
    assert np.abs(statue.distance(points)).max() < 1e-9


@pytest.mark.slow
def test_statue_fills_the_height_of_the_picture_and_has_many_normals():
    points = object_points("statue", 0)
    rows = points[1] / points[2] * rendering("statue").camera.fy
    assert rows.max() - rows.min() > 0.85 * SIZE
    normals = build_scene("statue").bodies[0].surface.normal(points)
    assert len(np.unique(np.round(3 * normals), axis=1).T) > 60


@pytest.mark.parametrize("name", ["cube_no_texture", "sphere_cylinder_no_texture"])
def test_untextured_bodies_have_one_albedo(name):
    points = np.random.default_rng(0).uniform(-1, 4, (3, 200))
    for body in build_scene(name).bodies:
        assert np.ptp(body.albedo(points), axis=1).max() == 0


@pytest.mark.parametrize("kind", ["cube_high_freq", "sphere_cylinder_high_freq", "sphere_cylinder_low_freq"])
def test_textures_vary_on_every_body_within_the_albedo_of_real_materials(kind):
    points = np.random.default_rng(0).uniform([[-1], [-1], [2.4]], [[1], [1], [4]], (3, 500))
    for body in build_scene(kind).bodies:
        paint = body.albedo(points)
        assert paint.std() > 0.05
        assert paint.min() > 0
        assert paint.max() < 1.1


def test_high_frequency_paint_changes_within_centimetres_and_low_frequency_paint_does_not():
    points = np.random.default_rng(0).uniform([[-1], [-1], [2.4]], [[1], [1], [4]], (3, 500))
    change = {
        style: np.abs(body.albedo(points + 0.01) - body.albedo(points)).mean()
        for style in ("high", "low")
        for body in build_scene(f"sphere_cylinder_{style}_freq").bodies[:1]
    }
    assert change["high"] > 5 * change["low"]


def test_unknown_scene_is_refused_with_the_choices():
    with pytest.raises(ValueError, match=r"sphere_cylinder_low_freq.*got 'teapot'"):
        render_scene("teapot")

"""Frames that vote: less noise, occlusions and movement left out; and poses that the depth maps contradict."""

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from small_frames import room as small_room
from small_frames import walk
from small_scenes import sphere_depth

from dsr.geometry.camera import Camera
from dsr.geometry.poses import PosedMap, as_rigid, check_poses, invert
from dsr.inference.sequences import View, fuse_views
from dsr.synthetic.raycast import rotation

CAMERA = Camera.centred(96, 72, 90.0)


def pose(right=0.0, turn=0.0):
    return as_rigid(np.column_stack((rotation(0, turn, 0), (right, 0, 0))), "pose")


def room(own, ball=0.0):
    """Return depth of a wall at z = 2.5 with a ball before it, moved to the right, from a pose, (1, h, w)."""
    rays = torch.einsum("ij,jhw->ihw", torch.from_numpy(own[:3, :3]), CAMERA.rays())
    eye = torch.from_numpy(own[:3, 3])
    wall = (2.5 - eye[2]) / rays[2]
    return torch.minimum(wall, sphere_depth(rays, torch.tensor([ball, 0.0, 1.5]) - eye, 0.3))[None]


def noisy(depth, seed, deviation=0.01):
    """Return depth with noise that is alike everywhere in inverse depth."""
    generator = torch.Generator().manual_seed(seed)
    draws = torch.randn(depth.shape, generator=generator, dtype=torch.float64)
    return (depth.reciprocal() + deviation * draws).reciprocal()


def views(count=5, deviation=0.01):
    """Return noisy views from a row of places, the middle one first."""
    places = sorted((0.05 * (number - count // 2) for number in range(count)), key=abs)
    poses = [pose(place, -20 * place) for place in places]
    return [View(noisy(room(own), seed, deviation), CAMERA, own) for seed, own in enumerate(poses)]


def test_five_frames_have_less_than_half_the_noise():
    first, *others = views()
    fused = fuse_views(first, others)
    truth = room(first.pose)
    inner = (fused.votes == 5) & ((truth - 2.5).abs() < 0.01)
    assert float(inner.double().mean()) > 0.4
    assert bool((fused.others == 4)[inner].all())
    assert bool((fused.others <= fused.seeing).all())
    before, after = ((each - truth)[inner].std() for each in (first.depth, fused.depth))
    assert float(after) < 0.45 * float(before)
    assert float((fused.depth - truth)[inner].mean().abs()) < 0.005


def test_noise_that_neighbouring_pixels_share_is_averaged_over_frames():
    camera, random = Camera.centred(320, 240, 300.0), np.random.default_rng(0)
    wall = 0.4 + 0.0003 * np.mgrid[:240, :320][1]
    frames = []
    for _ in range(5):
        waves = cv2.GaussianBlur(random.standard_normal(wall.shape), (0, 0), 5)
        depth = 1 / (wall + 0.008 * waves / waves.std())  # a standard deviation of about 2 %
        frames.append(View(torch.from_numpy(np.round(1e3 * depth) / 1e3)[None], camera, np.eye(4)))
    fused = fuse_views(frames[0], frames[1:])
    before, after = (float((each.depth[0].reciprocal() - torch.from_numpy(wall)).std()) for each in (frames[0], fused))
    assert after < 0.55 * before
    assert float((fused.votes == 5).double().mean()) > 0.9


def test_surfaces_that_hide_each_other_do_not_mix():
    first, *others = views(deviation=0.002)
    fused = fuse_views(first, others)
    truth = room(first.pose)
    off = ((fused.depth - truth).abs() / truth).flatten()
    assert float((off < 0.05).double().mean()) > 0.985  # but for the rim of the ball, a pixel wide
    assert bool(fused.depth.isfinite().all())


def test_what_moves_keeps_the_reference_frames_depth():
    first = View(noisy(room(pose()), 0, 0.002), CAMERA, pose())
    others = [View(noisy(room(pose(), ball=0.25 * n), n, 0.002), CAMERA, pose()) for n in (1, 2)]
    fused = fuse_views(first, others)
    on_ball = room(pose()) < 1.4
    assert float((fused.depth - first.depth)[on_ball].abs().median()) < 0.01
    assert float((fused.depth[on_ball] < 1.5).double().mean()) > 0.97


def test_holes_are_filled_by_what_others_see_and_stay_without():
    first, *others = views()
    depth = first.depth.clone()
    depth[:, 30:40, 40:60] = torch.nan
    blind = [View(each.depth.masked_fill(torch.ones_like(each.depth, dtype=torch.bool), torch.nan), CAMERA, each.pose)
             for each in others]  # fmt: skip
    filled = fuse_views(View(depth, CAMERA, first.pose), others)
    assert bool(filled.depth[:, 30:40, 40:60].isfinite().all())
    assert float((filled.depth - room(first.pose))[:, 32:38, 44:56].abs().max()) < 0.05
    empty = fuse_views(View(depth, CAMERA, first.pose), blind)
    assert torch.equal(empty.depth.isnan(), depth.isnan())


@pytest.mark.parametrize(
    ("depth", "own", "message"),
    [
        (torch.ones(1, 72, 95), np.eye(4), "depth: expected shape"),
        (torch.ones(1, 72, 96), np.diag([2.0, 2.0, 2.0, 1.0]), "pose: expected a rigid transform"),
        (torch.ones(1, 72, 96), np.full((4, 4), np.nan), "pose: expected finite numbers"),
    ],
)
def test_invalid_views_are_refused(depth, own, message):
    with pytest.raises(ValueError, match=message):
        View(depth, CAMERA, own)


SMALL = Camera.centred(64, 48, 52.0)
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
NED = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""The axes forward, right, down of a camera in its frame right, down, forward."""


def scaled(pose, factor):
    changed = pose.copy()
    changed[:3, 3] *= factor
    return changed


def turned(pose, change):
    changed = pose.copy()
    changed[:3, :3] = change(pose[:3, :3])
    return changed


def scalar_first(turn):
    """Return what x y z w is read as where w x y z is written."""
    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    return Rotation.from_quat((w, x, y, z)).as_matrix()


WRONG = [
    ("from world to camera", invert),
    ("in millimetres", lambda pose: scaled(pose, 1000)),
    ("in centimetres", lambda pose: scaled(pose, 100)),
    ("10 times too small", lambda pose: scaled(pose, 0.1)),
    ("of cameras with y up and z backward", lambda pose: pose @ OPENGL),
    ("of cameras with x forward and z down", lambda pose: pose @ NED),
    ("with rotations by columns", lambda pose: turned(pose, np.transpose)),
    ("with quaternions w x y z", lambda pose: turned(pose, scalar_first)),
    ("from world to camera, in millimetres", lambda pose: scaled(invert(pose), 1000)),
    ("from world to camera, of cameras with y up and z backward", lambda pose: invert(pose @ OPENGL)),
]


def checked(poses, change=lambda pose: pose, depth=small_room):
    """Return what is said of poses that were changed, of maps with the noise of a sensor."""

    def load(number):
        draws = np.random.default_rng(number).standard_normal((SMALL.height, SMALL.width))
        return PosedMap(depth(SMALL, poses[number]) * (1 + 0.005 * draws), SMALL, change(poses[number]))

    return check_poses(len(poses), load)


def wall(camera, pose):
    return 2 / np.einsum("j,jhw->hw", pose[2, :3], camera.rays().numpy())


@pytest.mark.parametrize(("name", "change"), WRONG, ids=[name for name, _ in WRONG])
def test_wrong_reading_is_reported_by_its_name_with_figures(name, change):
    found = checked(walk(8), change)
    assert found.code == "poses"
    assert name in found.text.removeprefix("the poses are probably ").split(" or ")
    assert found.value > 0.25


@pytest.mark.parametrize(
    "poses",
    [walk(8), walk(2), walk(60, 0.004, 0.3), walk(8, 0.0), walk(8, 0.08, 0.0), walk(20, 0.0, 0.0), walk(1), []],
    ids=["photos", "two", "video", "rotation", "translation", "tripod", "one", "none"],
)
def test_right_poses_are_silent(poses):
    assert checked(poses) is None


@pytest.mark.parametrize(("name", "change"), WRONG, ids=[name for name, _ in WRONG])
def test_wall_along_which_the_camera_moves_shows_nothing(name, change):
    del name
    poses = [np.eye(4) for _ in range(12)]
    for number, pose in enumerate(poses):
        pose[:2, 3] = 0.03 * number, 0.01 * number
    found = checked(poses, change, wall)
    assert found is None or found.code != "poses"


def test_camera_that_hardly_moves_is_not_far_away_in_the_next_frame():
    poses = [np.eye(4) + 0.03 * number * np.eye(4, k=3) for number in range(12)]
    assert checked(poses, depth=wall) is None
    found = checked(poses, lambda pose: scaled(pose, 1000), wall)
    assert (found.code, found.value) == ("poses-far", pytest.approx(1000 * 0.03 / 2, rel=0.05))
    assert checked(poses, lambda pose: scaled(pose, 1 / 1000), wall) is None


def test_poses_that_no_reading_explains_disagree():
    poses = walk(8, 0.02, 0.5)
    rng = np.random.default_rng(3)
    strange = {id(pose): Rotation.from_rotvec(rng.normal(0, 12, 3), degrees=True).as_matrix() for pose in poses}
    found = checked(poses, lambda pose: turned(pose, lambda turn: turn @ strange[id(pose)]))
    assert found.code == "poses-disagree"


def test_frames_that_cannot_be_read_are_left_out():
    poses = walk(8)
    assert check_poses(8, lambda number: None) is None
    some = check_poses(8, lambda n: None if n == 1 else PosedMap(small_room(SMALL, poses[n]), SMALL, invert(poses[n])))
    assert some is not None

"""Frames that vote: less noise, occlusions and movement left out, holes filled by agreement."""

import cv2
import numpy as np
import pytest
import torch

from dsr.geometry.camera import Camera
from dsr.geometry.poses import as_rigid
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
    to_ball = torch.tensor([ball, 0.0, 1.5]) - eye
    square, half = (rays**2).sum(0), (rays * to_ball[:, None, None]).sum(0)
    root = half**2 - square * ((to_ball**2).sum() - 0.3**2)
    hit = torch.where(root > 0, (half - root.clamp(min=0).sqrt()) / square, torch.inf)
    return torch.minimum(wall, hit)[None]


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

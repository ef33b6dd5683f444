"""Metrics of depth over time: flicker of what stands still, and whether frames of a moving camera agree.

- :func:`flicker`, :func:`temporal_noise` and :func:`normal_flicker` need a camera that stands still. Temporal noise is
  that of IntelRealSense/librealsense (cacc8e7, ``rs-depth-quality.cpp``).
- :func:`opw` needs poses: Wang et al., *Less Is More*, ACM MM 2022, and *Neural Video Depth Stabilizer*, ICCV 2023,
  with the rigid flow of depth and pose; RaymondWang987/NVDS (d7b66e4).
- :func:`rsd` needs poses: the spread of one distance between two points over views, of Pumpire (2026).
- :func:`tgm` needs a truth: temporal gradient matching of Chen et al., *Video Depth Anything*, CVPR 2025, with one
  stride; DepthAnything/Video-Depth-Anything (4f5ae23).

All are of one sequence, (), and lower is better. None knows whether the depth is right: a constant has the best of each
but the last. Holes are left out, and :func:`covered` stands beside them.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dsr.geometry.camera import Camera
from dsr.geometry.poses import as_rigid, relative
from dsr.geometry.resampling import source_pixels, warp_depth
from dsr.geometry.surface import angle_between, depth_to_normals, length
from dsr.metrics.functional import masked_mean, masked_median
from dsr.metrics.harm import draw_pairs
from dsr.utils.compute_device import in_own_precision

Poses = Tensor | np.ndarray | Sequence[np.ndarray]
_VISIBLE = 50.0  # how fast the weight of a pixel falls with the squared difference of its colours
_SAME = 0.05  # relative difference of depths up to which a view sees the same point
_MOVING = 0.05  # change of the true depth, as a fraction of the frame's range, from which on it is motion


@in_own_precision
def flicker(depths: Tensor, static: Tensor | None = None) -> Tensor:
    """Return the mean over the pixels of the standard deviation over time of depth, relative to its median over time.

    Depths are (T, 1, H, W) orthogonal depth in metres, T at least 2; NaN, and what is not positive, is a hole. A pixel
    counts if it has a depth in two frames or more. ``static``, (1, 1, H, W) bool, are the pixels where nothing moves.
    """
    return masked_mean(*_spread(depths, static)).squeeze()


@in_own_precision
def temporal_noise(depths: Tensor, static: Tensor | None = None) -> Tensor:
    """Return the median over the pixels that ever have a depth of the deviation whose mean is :func:`flicker`."""
    return masked_median(*_spread(depths, static)).squeeze()


@in_own_precision
def normal_flicker(depths: Tensor, camera: Camera, static: Tensor | None = None) -> Tensor:
    """Return the mean over pixels of the RMS angle over time between a normal and its mean direction, in degrees."""
    known = _known(depths)
    normals = depth_to_normals(depths.masked_fill(~known, torch.nan), camera.rays(device=depths.device)[None])
    known = normals.isfinite().all(dim=1, keepdim=True)
    mean = torch.where(known, normals, 0).sum(dim=0, keepdim=True)
    angles = angle_between(normals, mean / length(mean))
    count = known.sum(dim=0, keepdim=True)
    squares = torch.where(known, angles.square(), 0).sum(dim=0, keepdim=True)
    return masked_mean((squares / count.clamp(min=1)).sqrt(), _counted(count, static)).squeeze()


def covered(depths: Tensor, static: Tensor | None = None) -> Tensor:
    """Return the fraction of the pixels of all frames that have a depth, (); higher is better."""
    share = _known(depths).to(depths).mean(dim=0, keepdim=True)
    return masked_mean(share, torch.ones_like(share, dtype=torch.bool) if static is None else static).squeeze()


@in_own_precision
def opw(
    depths: Tensor, camera: Camera, poses: Poses, photos: Tensor | None = None, static: Tensor | None = None
) -> Tensor:
    """Return the mean difference between the depth of a frame and that of the frame before, warped into its view.

    The frame before is warped with a z-buffer: what a surface hides does not count, and what appears is a hole. Here it
    is a weighted mean in metres; the authors' code normalises disparity.

    Depths are (T, 1, H, W) orthogonal depth in metres, T at least 2, ``poses`` (T, 4, 4) transforms from the camera's
    frame (x right, y down, z forward) to the world's, ``static`` (T, 1, H, W) bool the pixels to compare. With
    ``photos`` (T, 3, H, W) in 0 to 1, pixels weigh exp(-50 d^2), where d^2 is the sum of the squared differences of
    their colours, so that what moves counts less. NaN if a pair of frames has nothing to compare.
    """
    known = _known(depths) if static is None else _known(depths) & static
    frames = [as_rigid(np.asarray(each), f"poses: {number}") for number, each in enumerate(poses)]
    if len(frames) != len(depths) or (photos is not None and len(photos) != len(depths)):
        raise ValueError(f"poses, photos: expected as many as the {len(depths)} depth maps, got {len(frames)} poses")
    found = []
    for now in range(1, len(depths)):
        move = torch.from_numpy(relative(frames[now - 1], frames[now]))[None].to(depths.device)
        warped = warp_depth(depths[now - 1 : now], camera, move, camera)
        mask = known[now][None] & warped.isfinite()
        weight = mask.to(depths)
        if photos is not None:
            places = zip(source_pixels(warped, camera, move, camera), photos.shape[:1:-1], strict=True)
            grid = torch.stack([2 * place / (size - 1) - 1 for place, size in places], -1).nan_to_num(0).to(photos)
            seen = torch.nn.functional.grid_sample(
                photos[now - 1 : now], grid, padding_mode="border", align_corners=True
            )
            apart = (seen - photos[now]).square().sum(dim=1, keepdim=True)
            weight = torch.where(mask, torch.exp(-_VISIBLE * apart), 0)
        error = torch.where(mask, (depths[now] - warped).abs(), 0)
        found.append((weight * error).sum() / weight.sum())
    return torch.stack(found).mean()


@in_own_precision
def rsd(depths: Tensor, camera: Camera, poses: Poses) -> Tensor:
    """Return the mean over pairs of points of the standard deviation of their distance over views over its mean, ().

    Pairs are drawn from the middle frame, see :func:`dsr.metrics.harm.draw_pairs`. In each view, the point is where its
    place in the middle frame is projected to, at the depth of the nearest pixel; a view in which that differs by more
    than 5 % does not see the point. Pairs count if two views or more see both points, NaN if none is. Larger errors are
    thus left out, and :func:`covered` belongs beside the score.

    Depths are (T, 1, H, W) orthogonal depth in metres, T at least 2, and poses as those of :func:`opw`.
    """
    frames = [as_rigid(np.asarray(each), f"poses: {number}") for number, each in enumerate(poses)]
    known, middle = _known(depths), len(depths) // 2
    if len(frames) != len(depths):
        raise ValueError(f"poses: expected as many as the {len(depths)} depth maps, got {len(frames)}")
    ends = torch.cat(draw_pairs(known[middle : middle + 1]), dim=1)[0]
    points = (depths[middle].double() * camera.rays(device=depths.device)).flatten(1)[:, ends]
    found = []
    for depth, pose in zip(depths, frames, strict=True):
        move = torch.from_numpy(relative(frames[middle], pose)).to(points)
        x, y, z = move[:3, :3] @ points + move[:3, 3:]
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (z > 0) & (u > -0.5) & (v > -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
        columns, rows = (torch.where(inside, each, 0).round().long() for each in (u, v))
        seen = depth[0, rows, columns].double()
        seen = seen.masked_fill(~inside | ~((seen - z).abs() <= _SAME * z), torch.nan)
        first, second = torch.stack((x / z * seen, y / z * seen, seen)).chunk(2, dim=1)
        found.append((first - second).square().sum(dim=0).sqrt())
    distances = torch.stack(found)[:, None, None]  # (T, 1, 1, PAIRS)
    there = distances.isfinite()
    count = there.sum(dim=0, keepdim=True)
    mean = torch.where(there, distances, 0).sum(dim=0, keepdim=True) / count
    variance = torch.where(there, (distances - mean).square(), 0).sum(dim=0, keepdim=True) / count
    return masked_mean(variance.sqrt() / mean, (count > 1) & (mean > 0)).squeeze()


@in_own_precision
def tgm(prediction: Tensor, target: Tensor, static: Tensor | None = None) -> Tensor:
    """Return the mean difference between the changes of predicted and true depth from frame to frame, () in metres.

    Depths are (T, 1, H, W) in metres, NaN in holes. Pixels count whose true depth changes by less than 5 % of the range
    of the later frame's: it is of one surface.
    """
    if prediction.shape != target.shape:
        raise ValueError(f"target: expected shape {tuple(prediction.shape)}, got {tuple(target.shape)}")
    true = _known(target) if static is None else _known(target) & static
    known = true & _known(prediction)
    highest = torch.where(true, target, -torch.inf).amax(dim=(1, 2, 3), keepdim=True)
    lowest = torch.where(true, target, torch.inf).amin(dim=(1, 2, 3), keepdim=True)
    limit = _MOVING * (highest - lowest)[1:]
    change = target.diff(dim=0)
    counted = known[1:] & known[:-1] & (change.abs() < limit)
    return torch.where(counted, (prediction.diff(dim=0) - change).abs(), 0).sum() / counted.sum()


def _known(depths: Tensor) -> Tensor:
    """Return the pixels with a depth, after checking the shape."""
    if depths.dim() != 4 or depths.shape[1] != 1 or len(depths) < 2:
        raise ValueError(f"depths: expected shape (T, 1, H, W) of two frames or more, got {tuple(depths.shape)}")
    return depths.isfinite() & (depths > 0)


def _counted(count: Tensor, static: Tensor | None) -> Tensor:
    """Return the pixels that count, from the number of frames that see each, (1, 1, H, W)."""
    if static is not None and static.shape != count.shape:
        raise ValueError(f"static: expected shape {tuple(count.shape)}, got {tuple(static.shape)}")
    return count > 1 if static is None else (count > 1) & static


def _spread(depths: Tensor, static: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the standard deviation over time over the median, and the pixels where it counts, (1, 1, H, W) each."""
    known = _known(depths)
    count = known.sum(dim=0, keepdim=True)
    values = torch.where(known, depths, 0)
    mean = values.sum(dim=0, keepdim=True) / count.clamp(min=1)
    variance = torch.where(known, (depths - mean).square(), 0).sum(dim=0, keepdim=True) / count.clamp(min=1)
    pixels, there = values.flatten(1).T[:, None, None], known.flatten(1).T[:, None, None]  # (H W, 1, 1, T)
    counted = _counted(count, static)
    return torch.where(counted, variance.sqrt() / masked_median(pixels, there).view_as(mean), 0), counted

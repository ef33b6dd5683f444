"""Maps of another program as a method: read in every format and quantity, fitted without the truth, and refused."""

import cv2
import numpy as np
import pytest
import torch
from small_scenes import grid, plane, sample_of

from dsr.methods.external import External, fit_line


@pytest.fixture
def sample():
    return sample_of(plane() + 3 * (plane() > 6.5), scale=4)


def truth(sample):
    return sample.depth[0].numpy()


def write(folder, name, values):
    path = folder / name
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".npz":
        np.savez(path, depth=values)
    else:
        assert cv2.imwrite(str(path), values)


@pytest.mark.parametrize(
    ("name", "kind", "unit", "tolerance"),
    [
        ("hall.npy", np.float64, None, 1e-12),
        ("hall.npz", np.float32, None, 1e-6),
        ("hall.png", np.uint16, "mm", 6e-4),
        ("hall.png", np.uint16, 1 / 5000, 2e-4),
        ("hall.npy", np.float32, "cm", 1e-6),
    ],
)
def test_map_is_read_in_metres(sample, tmp_path, name, kind, unit, tolerance):
    metres = {"mm": 1e-3, "cm": 1e-2, None: 1.0}.get(unit, unit)
    values = truth(sample) / metres
    write(tmp_path, name, (values.round() if np.issubdtype(kind, np.integer) else values).astype(kind))
    depth = External(str(tmp_path), unit=unit)(sample)
    assert depth.shape == (1, 32, 48)
    assert float((depth - sample.depth).abs().max()) <= tolerance


def quantity(sample, name):
    """Return the true map in a quantity, by its definition."""
    camera, depth = sample.camera, sample.depth.double()
    v, u = grid(32, 48)
    ray = (((u - camera.cx) / camera.fx) ** 2 + ((v - camera.cy) / camera.fy) ** 2 + 1).sqrt()
    return {"perspective": depth * ray, "disparity": 0.2 * camera.fx / depth, "inverse": 1 / depth}[name]


@pytest.mark.parametrize("name", ["perspective", "disparity", "inverse"])
def test_quantity_is_converted(sample, tmp_path, name):
    write(tmp_path, "hall.npy", quantity(sample, name)[0].numpy())
    torch.testing.assert_close(External(str(tmp_path), range_type=name)(sample), sample.depth)
    write(tmp_path, "hall.npy", 10 * truth(sample))  # unlikely, but wanted
    torch.testing.assert_close(External(str(tmp_path), check=False)(sample), 10 * sample.depth)


@pytest.mark.parametrize(("name", "gain", "shift"), [("inverse", 7.0, -0.5), ("disparity", 0.01, 2.0)])
def test_relative_map_is_fitted_to_the_coarse_one_without_the_truth(sample, tmp_path, name, gain, shift):
    write(tmp_path, "hall.npy", (gain * quantity(sample, name)[0] + shift).numpy())
    blind = sample_of(plane() + 3 * (plane() > 6.5), scale=4)
    object.__setattr__(blind, "depth", None)
    depth = External(str(tmp_path), range_type=name, fit="affine")(blind)
    torch.testing.assert_close(depth, sample.depth, rtol=1e-3, atol=0)


def test_holes_stay_holes_and_a_scale_is_fitted_around_them(sample, tmp_path):
    values = 40 * truth(sample)
    values[4:9, 3:20] = np.nan
    write(tmp_path, "hall.npy", values)
    depth = External(str(tmp_path), fit="scale")(sample)
    assert torch.equal(depth.isnan()[0], torch.from_numpy(np.isnan(values)))
    assert float((depth / sample.depth - 1).nan_to_num().abs().max()) < 0.02


def test_zeros_of_a_fitted_depth_map_are_holes(sample, tmp_path):
    values = (100 * truth(sample) + 20).round().astype(np.uint16)
    values[4:20, 3:30] = 0
    write(tmp_path, "hall.png", values)
    method = External(str(tmp_path), fit="affine")
    depth = method(sample)
    assert torch.equal(depth.isnan()[0], torch.from_numpy(values == 0))
    assert float((depth / sample.depth - 1).nan_to_num().abs().max()) < 0.03
    assert "whole numbers" in method.describe(sample)


def test_line_passes_through_most_points():
    x = torch.linspace(0, 1, 101, dtype=torch.float64)
    y = 3 * x + 2
    y[::4] += 50 * x[::4]
    assert fit_line(x, y) == pytest.approx((3, 2), abs=1e-3)
    assert fit_line(x, 5 * x, shift=False) == pytest.approx((5, 0))


def test_map_of_another_size_is_resized_only_when_asked(sample, tmp_path):
    write(tmp_path, "hall.npy", truth(sample)[::2, ::2])
    with pytest.raises(ValueError, match=r"hall.npy: expected"):
        External(str(tmp_path))(sample)
    near = External(str(tmp_path), resize="nearest")(sample)
    assert torch.equal(near[:, ::2, ::2], torch.from_numpy(truth(sample)[None, ::2, ::2]))
    assert torch.equal(near[:, 1::2, 1::2], near[:, ::2, ::2])
    assert External(str(tmp_path), resize="bilinear")(sample).shape == (1, 32, 48)


def test_names_follow_a_template_and_other_files_are_reported(sample, tmp_path):
    (tmp_path / "set" / "x4").mkdir(parents=True)
    write(tmp_path, "set/x4/hall_pred.npy", truth(sample))
    write(tmp_path, "set/x4/cellar_pred.npy", truth(sample))
    method = External(str(tmp_path), file="{dataset}/x{scale}/{scene}_pred")
    torch.testing.assert_close(method(sample), sample.depth)
    (remark,) = method.remarks("set", ["hall"], 4)
    assert "cellar_pred.npy" in remark
    assert method.remarks("set", ["hall", "cellar"], 4) == []
    assert method.content("set", "hall", 4) != method.content("set", "attic", 4)


@pytest.mark.parametrize(
    ("change", "settings", "message"),
    [
        (lambda z: z * 1000, {}, r"hall.npy: .* the median is .* another unit"),
        (lambda z: 4 - z, {}, r"correlation is -.*disparity read as depth"),
        (lambda z: -z, {}, r"hall.npy: expected at least one known pixel, .*negative"),
        (lambda z: z * np.nan, {}, r"hall.npy: expected at least one known pixel, all are holes"),
        (lambda z: z * np.inf, {}, r"hall.npy: expected at least one known pixel, all are holes"),
        (lambda z: np.random.default_rng(0).permuted(z).reshape(z.shape), {}, r"another scene"),
        (lambda z: z, {"range_type": "inverse", "fit": "affine"}, r"hall.npy: expected values that rise"),
        (lambda z: (1000 * z).astype(np.uint16), {}, r"hall.npy: expected method.unit=mm"),
    ],
)
def test_map_that_cannot_be_right_is_refused_by_name(sample, tmp_path, change, settings, message):
    write(tmp_path, "hall.npy", change(truth(sample)))
    with pytest.raises(ValueError, match=message):
        External(**{"path": str(tmp_path), **settings})(sample)


def test_two_files_of_a_scene_and_a_missing_one_are_refused(sample, tmp_path):
    with pytest.raises(ValueError, match=r"hall: expected a map as .*there is none"):
        External(str(tmp_path))(sample)
    for name in ("hall.npy", "hall.npz"):
        write(tmp_path, name, truth(sample))
    assert External(str(tmp_path)).remarks("set", ["hall"], 4) == []
    assert External(str(tmp_path)).content("set", "hall", 4) is not None
    with pytest.raises(ValueError, match=r"expected one map of hall, got hall.npy, hall.npz"):
        External(str(tmp_path))(sample)

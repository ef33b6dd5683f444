"""The copy of the input beside a result."""

import numpy as np
import pytest
import torch

from dsr.io.exports import LONGEST, read_input, write_input


@pytest.fixture
def stored(tmp_path):
    v, u = np.mgrid[:48, :64]
    rgb = torch.from_numpy(np.stack([u / 64, v / 48, 0 * u + 0.5])).float()
    depth = torch.linspace(1, 4, 12 * 16).reshape(1, 12, 16)
    depth[0, 3, 4] = torch.nan
    write_input(tmp_path / "input.npz", rgb, depth)
    return tmp_path / "input.npz", rgb, depth


def test_input_is_read_back(stored):
    path, rgb, depth = stored
    photo, read = read_input(path)
    np.testing.assert_array_equal(read, depth[0].numpy())
    assert photo.shape == (48, 64, 3)
    assert np.abs(photo - 255 * rgb.permute(1, 2, 0).numpy()).mean() < 2  # a JPEG, red first


def test_large_photos_are_stored_smaller(tmp_path):
    write_input(tmp_path / "input.npz", torch.rand(3, 30, 2 * LONGEST), torch.ones(1, 2, 2))
    assert read_input(tmp_path / "input.npz")[0].shape == (15, LONGEST, 3)

"""The copy of the input beside a result."""

import zipfile

import numpy as np
import pytest
import torch

from dsr.io.exports import LONGEST, read_input, write_input
from dsr.utils.arrays import array_headers


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


def test_headers_are_read_without_values(stored):
    headers = array_headers(stored[0])
    assert headers["depth_lr"] == ((12, 16), np.float32)
    assert headers["photo"][1] == np.uint8


def test_array_of_objects_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", depth=np.array([{}, None]))
    with pytest.raises(ValueError, match="expected an archive of arrays"):
        array_headers(tmp_path / "a.npz")


def damage(path, how):
    """Replace the input by something else."""
    depth, photo = np.ones((4, 4), np.float32), np.frombuffer(b"\xff\xd8 no picture", np.uint8)
    if how == "truncated":
        path.write_bytes(path.read_bytes()[:200])
    elif how == "foreign":
        np.savez(path, other=depth)
    elif how == "double":
        np.savez(path, depth_lr=depth.astype(float), photo=photo)
    elif how == "photo":
        np.savez(path, depth_lr=depth, photo=photo)
    elif how == "huge":  # a header that promises more than there is
        with zipfile.ZipFile(path, "w") as archive:
            for name, shape, dtype in (("depth_lr", (10**6, 10**6), "<f4"), ("photo", (9,), "|u1")):
                header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
                start = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little")
                archive.writestr(f"{name}.npy", start + header.encode())


@pytest.mark.parametrize("how", ["truncated", "foreign", "double", "photo", "huge"])
def test_something_else_is_refused_by_name(stored, how):
    damage(stored[0], how)
    with pytest.raises(ValueError, match=r"input\.npz: expected"):
        read_input(stored[0])

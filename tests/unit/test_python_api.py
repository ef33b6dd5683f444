"""``dsr.upsample``, ``dsr.Upsampler`` and ``dsr.Surface``: what is taken, what is given back, and what is refused."""

import json
import pickle
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from pretend_cuda import pretend_cuda
from small_frames import room, walk
from torch import Tensor

import dsr
from dsr.app.upsample.parts import PARTS
from dsr.app.upsample.stored import find_results, read_result
from dsr.geometry.lights import LIGHT_NAMES, direction_of
from dsr.geometry.surface import depth_to_normals, render

CAMERA = dsr.Camera.from_fov(60, width=64, height=48)
QUICK = "bicubic"


def photo():
    return np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)


def millimetres(number=0):
    """Return the room in half the photo's size as whole numbers, with a hole."""
    stored = np.round(1000 * room(CAMERA.rescale(32, 24), walk(number + 1)[-1])).astype(np.uint16)
    stored[5:7, 8:10] = 0
    return stored


def metres(number=0):
    stored = millimetres(number)
    return np.where(stored > 0, (stored.astype(np.float64) * 1e-3).astype(np.float32), np.float32(np.nan))


def tensor_photo():
    return torch.from_numpy(photo()).permute(2, 0, 1)


@pytest.fixture(scope="module")
def expected():
    return dsr.upsample(photo(), metres(), CAMERA, method=QUICK)


PHOTOS = {
    "uint8": photo,
    "uint16": lambda: photo().astype(np.uint16) * 257,
    "flipped": lambda: photo()[::-1, ::-1].copy()[::-1, ::-1],
    "of another order in memory": lambda: np.asfortranarray(photo()),
    "PIL": lambda: Image.fromarray(photo()),
    "PIL with alpha": lambda: Image.fromarray(photo()).convert("RGBA"),
    "float": lambda: (photo() / np.float32(255)).astype(np.float32),
    "tensor": tensor_photo,
    "float tensor": lambda: tensor_photo().float() / 255,
}
DEPTHS = {
    "uint16": (millimetres, "mm"),
    "int32": (lambda: millimetres().astype(np.int32), 1e-3),
    "big-endian": (lambda: millimetres().astype(">u2"), "1/1000"),
    "depth of PIL": (lambda: Image.fromarray(millimetres()), "mm"),
    "floats of millimetres": (lambda: millimetres().astype(np.float64), "mm"),
    "flipped depth": (lambda: metres()[::-1].copy()[::-1], None),
    "with an axis in front": (lambda: metres()[None], None),
    "float64": (lambda: metres().astype(np.float64), "m"),
}


@pytest.mark.parametrize("kind", [*PHOTOS, *DEPTHS])
def test_photo_and_depth_are_taken_in_any_form(kind, expected):
    make, unit = DEPTHS.get(kind, (metres, None))
    found = dsr.upsample(PHOTOS.get(kind, photo)(), make(), CAMERA, unit=unit, method=QUICK)
    assert (type(found), found.dtype) == (np.ndarray, np.float32)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("shape", [(24, 32), (1, 24, 32)])
def test_tensor_gives_a_tensor_whatever_the_photo_is(shape, expected):
    depth = torch.from_numpy(metres()).reshape(shape).requires_grad_()
    for rgb in (photo(), tensor_photo()):
        found = dsr.upsample(rgb, depth, CAMERA, method=QUICK)
        assert (type(found), found.shape, found.requires_grad) == (Tensor, (1, 48, 64), False)
        np.testing.assert_array_equal(found[0].numpy(), expected)
    surface = dsr.Upsampler(QUICK)(photo(), depth, CAMERA)
    assert surface.normals().shape == surface.photo.shape == (3, 48, 64)
    assert surface.render().shape == surface.filled.shape == surface.angle_error.shape == (1, 48, 64)


def test_tensor_of_another_device_gives_one_there(expected):
    with pretend_cuda() as device:
        found = dsr.upsample(tensor_photo(), torch.from_numpy(metres()).to(device), CAMERA, method=QUICK, device="cpu")
        assert found.device == device
        np.testing.assert_array_equal(found[0].cpu().numpy(), expected)


def test_batch_gives_what_its_pictures_give():
    single = [dsr.upsample(photo(), metres(number), CAMERA, method=QUICK) for number in range(3)]
    photos, depths = np.stack([photo()] * 3), np.stack([metres(number) for number in range(3)])
    mask = np.ones((3, 24, 32), bool)
    for masks in (None, mask):
        found = dsr.upsample(photos, depths, CAMERA, method=QUICK, mask=masks)
        np.testing.assert_array_equal(found, np.stack(single))
    tensors = dsr.upsample(torch.from_numpy(photos).permute(0, 3, 1, 2), torch.from_numpy(depths), CAMERA, method=QUICK)
    column = torch.from_numpy(depths)[:, None]
    again = dsr.upsample(torch.from_numpy(photos).permute(0, 3, 1, 2), column, [CAMERA] * 3, method=QUICK)
    assert tensors.shape == (3, 1, 48, 64)
    np.testing.assert_array_equal(tensors[:, 0].numpy(), np.stack(single))
    assert torch.equal(tensors, again)
    small = CAMERA.rescale(32, 24)
    mixed = dsr.upsample(
        [photo(), Image.fromarray(photo()[::2, ::2])], [metres(), metres()], [CAMERA, small], method=QUICK
    )
    assert [each.shape for each in mixed] == [(48, 64), (24, 32)]
    np.testing.assert_array_equal(mixed[0], single[0])


_PICTURE = "rgb: expected a picture of shape (H, W, 3),"
REFUSED = {
    "whole numbers without a unit": (
        {"depth": millimetres()},
        "depth: expected floats in metres, or whole numbers with unit=.*, got uint16 of shape (24, 32)",
    ),
    "8 bits of depth": (
        {"depth": np.ones((24, 32), np.uint8), "unit": "mm"},
        "depth: expected floats, or whole numbers of 16 bits or more, got uint8 of shape (24, 32)",
    ),
    "no unit": ({"unit": "inch"}, "unit: expected m, cm, mm"),
    "a number": ({"depth": 1.5}, "depth: expected a NumPy array, a tensor or a picture of PIL, got float"),
    "channels": ({"depth": np.ones((9, 9, 3))}, "depth: expected a map of shape (h, w), got float64 of shape (9, 9, 3"),
    "nothing": ({"depth": np.ones((0, 4))}, "depth: expected a map of shape (h, w), got float64 of shape (0, 4)"),
    "zeros": ({"depth": np.zeros((24, 32))}, "depth: expected metres above 0, and NaN"),
    "a photo of another size": (
        {"rgb": photo()[:40]}, f"{_PICTURE} with H = 48 and W = 64, the camera's; got uint8 of shape (40, 64, 3)",
    ),
    "a grey photo": ({"rgb": photo()[..., 0]}, f"{_PICTURE} RGB; got uint8 of shape (48, 64)"),
    "channels first": ({"rgb": photo().transpose(2, 0, 1)}, f"{_PICTURE} RGB; got uint8 of shape (3, 48, 64)"),
    "channels last of a tensor": (
        {"rgb": torch.from_numpy(photo())},
        "rgb: expected a picture of shape (3, H, W), RGB; got a tensor of torch.uint8 of shape (48, 64, 3)",
    ),
    "a photo of large floats": ({"rgb": photo().astype(float)}, "rgb: expected floating point values in [0, 1]"),
    "a photo of whole numbers": (
        {"rgb": photo().astype(int)}, "rgb: expected values of 8 or 16 bits, or floats from 0 to 1, got int64",
    ),
    "a matrix": ({"camera": np.eye(3)}, "camera: expected a dsr.Camera, got float64 of shape (3, 3); see dsr.Camera"),
    "a mask of another size": (
        {"mask": np.ones((48, 64))}, "mask: expected the depth's shape (24, 32), got float64 of shape (48, 64)",
    ),
    "fewer maps than photos": (
        {"rgb": [photo()] * 2, "depth": [metres()]},
        "rgb, depth: expected as many of each in a batch, got 2 of rgb, 1 of depth",
    ),
    "a wrong one in a batch": (
        {"rgb": [photo()] * 2, "depth": [metres(), millimetres()]},
        "picture 1 of the batch: depth: expected floats in metres",
    ),
    "an unknown sensor": ({"sensor": "nosuch"}, "sensor: expected"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_argument_is_named_with_its_shape_and_type(case):
    change, message = REFUSED[case]
    given = {"rgb": photo(), "depth": metres(), "camera": CAMERA, "method": QUICK, **change}
    pattern = re.escape(message).replace(r"\.\*", ".*")
    with pytest.raises(ValueError, match=f"^{pattern}") as error:
        dsr.upsample(**given)
    assert "\n" not in str(error.value)


def test_what_can_hardly_be_right_is_a_warning_at_the_line_that_called():
    with pytest.warns(UserWarning, match="farther than any depth camera measures; unit sets it") as caught:
        dsr.upsample(photo(), 1000 * metres(), CAMERA, method=QUICK)
    assert {Path(each.filename).name for each in caught} == {Path(__file__).name}


@pytest.fixture(scope="module")
def surface():
    return dsr.Upsampler(QUICK)(photo(), millimetres(), CAMERA, unit="mm")


def test_surface_has_its_maps(surface, expected):
    np.testing.assert_array_equal(surface.depth, expected)
    assert surface.filled.dtype == np.bool_
    assert [int(surface.filled.sum()), int(surface.filled[10:14, 16:20].sum())] == [16, 16]
    assert (surface.depth_error > 0).all()
    assert (surface.angle_error > 0).all()
    np.testing.assert_array_equal(surface.photo, photo())
    assert (surface.camera, surface.noise) == (CAMERA, None)
    assert surface.outliers is not None


def test_renderings_are_those_of_the_normals(surface):
    depth = torch.from_numpy(surface.depth)[None, None].double()
    normals = depth_to_normals(depth, CAMERA.rays()[None])
    np.testing.assert_allclose(surface.normals(), normals[0].permute(1, 2, 0).numpy(), atol=1e-6)
    for light, wanted in zip(LIGHT_NAMES, render(normals)[0].numpy(), strict=True):
        np.testing.assert_allclose(surface.render(light), wanted, atol=1e-6)
        np.testing.assert_allclose(surface.render(3 * np.array(direction_of(light))), wanted, atol=1e-6)
    for wrong in ("e5", (0, 0, 0), (1, 2), ("a", 1, 2), 3.0):
        with pytest.raises(ValueError, match=r"^light: expected"):
            surface.render(wrong)


def test_points_and_mesh_have_the_photos_colours_at_their_places(surface):
    every = surface.points(None)
    assert len(every.points) == 48 * 64
    np.testing.assert_allclose(every.points[:, 2], surface.depth.ravel(), rtol=1e-6)
    np.testing.assert_array_equal(every.colours, photo().reshape(-1, 3))
    certain = (surface.depth_error <= 0.02 * surface.depth).sum()
    assert len(surface.points().points) == certain < 48 * 64
    mesh = surface.mesh()
    assert len(mesh.faces) > 4000
    assert set(mesh.vertices[:, 2]) <= set(surface.points().points[:, 2].astype(mesh.vertices.dtype))
    assert {tuple(each) for each in mesh.visual.vertex_colors[:, :3]} <= {
        tuple(each) for each in photo().reshape(-1, 3)
    }
    assert (mesh.vertex_normals[:, 2] < 0).mean() > 0.9  # towards the camera
    with pytest.raises(ValueError, match=r"^max_error: expected"):
        surface.points(1e-9)


def test_saved_surface_is_a_result_of_the_command(surface, tmp_path):
    files = surface.save(tmp_path / "out", ["depth", "renderings", "normals", "cloud", "mesh", "confidence", "input"])
    names = {path.relative_to(tmp_path / "out").as_posix() for path in files}
    assert {"depth.png", "depth_metres.tiff", "renderings/e1.png", "mesh.glb", "cloud.ply", "input.npz"} <= names
    assert all(path.is_file() for path in files)
    stored = np.asarray(Image.open(tmp_path / "out" / "depth.png"))  # as it was given, in whole millimetres
    np.testing.assert_allclose(stored, 1000 * surface.depth, atol=0.5)
    [folder] = find_results(tmp_path / "out")
    result = read_result(folder, "out")
    np.testing.assert_array_equal(result.depth, surface.depth)
    assert (result.camera, json.loads((folder / "info.json").read_text())["method"]) == (CAMERA, QUICK)
    surface.save(tmp_path / "out", ["filled"])  # the same surface: a part is added
    assert (tmp_path / "out" / "mesh.glb").exists()
    other = dsr.Upsampler(QUICK)(photo(), metres(2), CAMERA)
    with pytest.raises(ValueError, match=r"other inputs: surface; take another folder, or overwrite=True"):
        other.save(tmp_path / "out", ["depth"])
    assert surface.save(tmp_path / "npy", ["depth"], format="npy")[0].name == "depth.npy"
    for wrong, message in (
        ({"parts": ["statue"]}, "expected some of depth"),
        ({"format": "jpg"}, "^format: expected one of"),
        ({"colour": 1}, "^save: expected some of format"),
        ({"dry_run": True}, "^save: expected some of format"),
        ({"max_error": "3"}, "max_error"),
    ):
        with pytest.raises(ValueError, match=message):
            surface.save(tmp_path / "other", **wrong)
    together = surface.save(tmp_path / "all", ["gaussian"])
    assert (tmp_path / "all" / PARTS["gaussian"].files[0]).is_dir()
    assert together


def test_threads_that_share_an_upsampler_get_what_they_would_get_alone():
    upsampler = dsr.Upsampler()
    maps = [metres(number) for number in range(3)]
    alone = [upsampler(photo(), each, CAMERA).depth for each in maps]
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(lambda each: upsampler(photo(), each, CAMERA).depth, maps * 2))
    for first, second in zip(alone * 2, together, strict=True):
        np.testing.assert_array_equal(first, second)


def test_upsampler_and_surface_go_to_other_processes(surface):
    there = pickle.loads(pickle.dumps(dsr.Upsampler(QUICK)))
    np.testing.assert_array_equal(there(photo(), metres(), CAMERA).depth, surface.depth)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(surface)).depth, surface.depth)


def watched(frames, taken):
    """Yield frames, and their numbers into a list as they are asked for."""
    for number, frame in enumerate(frames):
        taken.append(number)
        yield frame


def test_stream_without_poses_gives_each_frame_as_it_comes():
    taken, upsampler = [], dsr.Upsampler(QUICK)
    frames = [(photo(), metres(number), CAMERA, None)[: 3 + number % 2] for number in range(4)]
    for number, surface in enumerate(upsampler.stream(watched(frames, taken))):
        assert taken[-1] == number
        np.testing.assert_array_equal(surface.depth, upsampler(photo(), metres(number), CAMERA).depth)
    assert taken == [0, 1, 2, 3]


def test_stream_reads_no_further_than_frames_that_vote_and_names_a_wrong_one():
    frames, taken = [(photo(), metres(number), CAMERA, pose) for number, pose in enumerate(walk(6))], []
    frames += [(photo(), millimetres(), CAMERA)] * 2
    upsampler, ahead = dsr.Upsampler(QUICK), []
    surfaces = upsampler.stream(watched(frames, taken), neighbours=2)
    for _ in range(5):
        next(surfaces)
        ahead.append(taken[-1])
    next(surfaces)  # though the frame after it, which votes on it, was read already
    with pytest.raises(ValueError, match=r"^frame 6: depth: expected floats in metres"):
        next(surfaces)
    assert ahead == [2, 2, 3, 4, 5]
    for wrong, message in (((photo(), metres()), r"frame 0: expected \(rgb, depth, camera\).*, got 2 of them"),
                           ((photo(), metres(), CAMERA, np.ones((4, 4))), "frame 0: pose: expected")):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            next(upsampler.stream([wrong]))
    with pytest.raises(ValueError, match=r"^neighbours: expected"):
        upsampler.stream([], neighbours=-1)
    assert list(upsampler.stream([])) == []


def test_frames_without_depth_do_not_take_others_with_them():
    frames = [(photo(), millimetres(number), CAMERA, walk(8)[number]) for number in range(5)]
    frames[2] = (photo(), np.zeros_like(millimetres()), CAMERA, walk(8)[2])
    found = list(dsr.Upsampler(QUICK).stream(frames, unit="mm"))
    assert [bool(np.isfinite(each.depth).any()) for each in found] == [True, True, False, True, True]
    assert not found[2].filled.any()


def test_buffers_of_the_caller_may_be_used_again():
    buffer = torch.zeros(3, 48, 64)

    def frames():
        for number in range(3):
            yield buffer.fill_(number / 4), torch.from_numpy(metres(number)), CAMERA, walk(8)[number]

    assert [float(each.photo.mean()) for each in dsr.Upsampler(QUICK).stream(frames())] == [0.0, 0.25, 0.5]
    surface = dsr.Upsampler(QUICK)(photo(), metres(), CAMERA)
    surface.depth[:] = 7
    assert not (surface.depth == 7).any()


def test_masked_arrays_keep_their_mask_and_pictures_their_bits(expected):
    masked = np.ma.masked_array(np.nan_to_num(metres(), nan=9.0), np.isnan(metres()))
    np.testing.assert_array_equal(dsr.upsample(photo(), masked, CAMERA, method=QUICK), expected)
    deep = Image.fromarray(np.full((48, 64), 30000, np.uint16))
    assert deep.mode == "I;16"
    assert dsr.Upsampler(QUICK)(deep, metres(), CAMERA).photo.mean() == pytest.approx(30000 / 257, abs=0.5)
    with pytest.raises(ValueError, match=r"^rgb: expected a picture of PIL of 8 bits"):
        dsr.upsample(Image.fromarray(np.ones((48, 64), np.float32)), metres(), CAMERA, method=QUICK)


def test_cameras_of_numpy_and_of_tensors_with_gradients_are_written(tmp_path):
    matrix = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]], requires_grad=True)
    numbers = matrix.detach().numpy()
    camera = dsr.Camera(np.int64(64), np.int64(48), numbers[0, 0], numbers[1, 1], numbers[0, 2], numbers[1, 2])
    assert camera == dsr.Camera.from_matrix(matrix, 64, 48) == dsr.Camera.from_matrix(matrix.bfloat16(), 64, 48)
    dsr.Upsampler(QUICK)(photo(), metres(), camera).save(tmp_path / "out", ["depth"])
    assert read_result(tmp_path / "out", "out").camera == camera
    with pytest.raises(ValueError, match="expected a matrix"):
        dsr.Camera.from_matrix([[60, 5, 31.5], [0, 60, 23.5], [0, 0, 1]], 64, 48)

"""``dsr.read``, ``dsr.read_depth`` and the cameras of matrices, angles and files, against what the command reads."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import dsr
from dsr.io.inputs import read_picture
from dsr.io.pairs import Pair
from dsr.io.reading import CameraChoice, Reading

SIZE = (48, 64)
K = [[60.0, 0.0, 31.5], [0.0, 61.0, 23.5], [0.0, 0.0, 1.0]]


def millimetres() -> np.ndarray:
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    values = (1500 + 3 * u + 2 * v).astype(np.uint16)
    values[3:6, 4:9] = 0
    return values


def write_pair(folder: Path, values: np.ndarray, name: str = "depth.png", orientation: int = 1) -> Pair:
    """Write a photo, and a depth map as PNG or NPY."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    pixels = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(folder / "photo.png", exif=exif)
    path = folder / name
    np.save(path, values) if path.suffix == ".npy" else Image.fromarray(values).save(path)
    return Pair("photo", folder / "photo.png", path)


@pytest.mark.parametrize("unit", ["mm", 1e-3, "1/1000", "cm"])
def test_depth_is_that_of_the_command_whose_unit_is_given(tmp_path: Path, unit: str | float) -> None:
    pair = write_pair(tmp_path, millimetres())
    metres = {"cm": 1e-2}.get(str(unit), 1e-3)
    expected = read_picture(pair, Reading(unit=metres, camera=CameraChoice(fov=60.0))).depth_lr
    found = dsr.read_depth(pair.depth, unit)
    assert (found.dtype, found.shape) == (np.float32, SIZE)
    np.testing.assert_array_equal(found, expected[0].numpy())
    assert int(np.isnan(found).sum()) == 15


def test_unit_that_the_values_show_is_a_warning_and_one_that_they_do_not_an_error(tmp_path: Path) -> None:
    pair = write_pair(tmp_path, millimetres())
    with pytest.warns(UserWarning, match="millimetres") as caught:
        reported = dsr.read_depth(pair.depth)
    assert [Path(each.filename).name for each in caught] == [Path(__file__).name]
    np.testing.assert_array_equal(reported, dsr.read_depth(pair.depth, "mm"))
    far = write_pair(tmp_path, 20 * millimetres().astype(np.float32) / 1000, "far.npy")
    with pytest.raises(ValueError, match=rf"^{far.depth}: expected unit .* or ") as error:
        dsr.read_depth(far.depth)
    assert "--" not in str(error.value)
    np.testing.assert_allclose(np.nanmedian(dsr.read_depth(far.depth, "cm")), 0.32, rtol=0.1)


def test_values_along_the_ray_and_disparities_need_the_camera(tmp_path: Path) -> None:
    camera = dsr.Camera.from_matrix(K, 64, 48)
    depth = torch.full((1, *SIZE), 2.0, dtype=torch.float64)
    rays = camera.ray_lengths()[None] * depth
    pair = write_pair(tmp_path, rays[0].numpy(), "rays.npy")
    found = dsr.read_depth(pair.depth, "m", camera=camera.rescale(128, 96), range_type="perspective")
    np.testing.assert_allclose(found, 2.0, rtol=1e-6)
    pair = write_pair(tmp_path, np.full(SIZE, 3.0), "disparity.npy")
    with pytest.raises(ValueError, match=r"disparities need the distance between the two cameras: baseline"):
        dsr.read_depth(pair.depth, 1.0, camera=camera)
    with pytest.warns(UserWarning, match="disparities"):
        found = dsr.read_depth(pair.depth, 1.0, camera=camera, baseline=0.1)
    np.testing.assert_allclose(found, 0.1 * 60 / 3, rtol=1e-6)


@pytest.mark.parametrize("above", [False, True])
def test_what_a_camera_file_beside_the_map_says_of_its_values_counts(tmp_path: Path, above: bool) -> None:
    folder = tmp_path / "depth" if above else tmp_path
    folder.mkdir(exist_ok=True)
    pair = write_pair(folder, millimetres())
    camera = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "depth_unit": 2e-3}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    np.testing.assert_array_equal(dsr.read_depth(pair.depth), dsr.read_depth(pair.depth, 2e-3))


def test_map_of_icl_nuim_is_read_along_the_rays_of_its_camera(tmp_path: Path) -> None:
    (tmp_path / "map.depth").write_text(" ".join(["200"] * (640 * 480)))
    with pytest.warns(UserWarning, match="ICL-NUIM"):
        along = dsr.read_depth(tmp_path / "map.depth")
    assert (along.shape, float(along.max())) == ((480, 640), pytest.approx(2, abs=1e-3))


@pytest.mark.parametrize(
    ("change", "message"),
    [({"unit": "inch"}, "^unit: expected m, cm, mm"), ({"unit": -1}, "^unit: expected"),
     ({"range_type": "far"}, "^range_type: expected one of"), ({"baseline": 0.0}, "^baseline: expected a positive"),
     ({"camera": dsr.Camera.from_fov(60, 100, 20)}, "^camera: expected a camera of .* got 100 x 20")],
)  # fmt: skip
def test_wrong_argument_is_named(tmp_path: Path, change: dict, message: str) -> None:
    pair = write_pair(tmp_path, millimetres())
    with pytest.raises(ValueError, match=message):
        dsr.read_depth(pair.depth, **{"unit": "mm", **change})
    with pytest.raises(ValueError, match=r"nowhere\.png: expected a depth map, there is no such file"):
        dsr.read_depth(tmp_path / "nowhere.png")


def test_photo_is_turned_only_where_the_depth_map_has_its_aspect_then(tmp_path: Path) -> None:
    pair = write_pair(tmp_path, millimetres(), orientation=6)
    with pytest.warns(UserWarning, match="orientation is ignored"):
        as_stored = dsr.read(pair.rgb)
    assert (as_stored.dtype, as_stored.shape) == (np.uint8, (*SIZE, 3))
    np.testing.assert_array_equal(as_stored, Image.open(pair.rgb))
    np.testing.assert_array_equal(dsr.read(pair.rgb, millimetres()), as_stored)
    np.testing.assert_array_equal(dsr.read(str(pair.rgb), millimetres().T), np.rot90(as_stored, -1))
    with pytest.raises(ValueError, match=r"nowhere\.jpg"):
        dsr.read(tmp_path / "nowhere.jpg")


def test_camera_of_a_matrix_however_it_is_given() -> None:
    expected = dsr.Camera(64, 48, 60.0, 61.0, 31.5, 23.5)
    larger = np.eye(4)
    larger[:3, :3] = K
    for matrix in (K, np.array(K), torch.tensor(K, dtype=torch.float64), larger, larger[:3]):
        assert dsr.Camera.from_matrix(matrix, 64, 48) == expected
    with pytest.raises(ValueError, match=r"^matrix: expected a matrix .* of shape \(3, 3\), got \(2, 2\)"):
        dsr.Camera.from_matrix(np.eye(2), 64, 48)
    with pytest.raises(ValueError, match=r"^matrix: expected a matrix \(fx 0 cx; 0 fy cy; 0 0 1\), got"):
        dsr.Camera.from_matrix(np.array(K).T, 64, 48)
    with pytest.raises(ValueError, match=r"^matrix: expected a matrix .*, got str"):
        dsr.Camera.from_matrix("K", 64, 48)
    with pytest.raises(ValueError, match=r"^degrees: expected"):
        dsr.Camera.from_fov(640, 480, 60)


def test_camera_of_a_file_of_any_format_that_has_its_size(tmp_path: Path) -> None:
    expected = dsr.Camera(64, 48, 60.0, 61.0, 31.5, 23.5)
    numbers = {"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "cx": 31.5, "cy": 23.5}
    flat = np.array(K).T.flatten().tolist()
    contents = numbers, {"width": 64, "height": 48, "intrinsic_matrix": flat}
    for number, content in enumerate(contents):
        path = tmp_path / f"{number}.json"
        path.write_text(json.dumps(content))
        assert dsr.Camera.from_json(path) == dsr.Camera.from_json(str(path)) == expected
    (tmp_path / "K.txt").write_text("\n".join(" ".join(map(str, row)) for row in K))
    with pytest.raises(ValueError, match=r"K\.txt: expected a camera with the size of its image, got a matrix"):
        dsr.Camera.from_json(tmp_path / "K.txt")

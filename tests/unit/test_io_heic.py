"""HEIC photos with depth maps of their own: the values, the camera of a turned photo, what is relative, refusals."""

import math
import pickle

import captures
import numpy as np
import pytest
from PIL import Image

from dsr.cli import main
from dsr.io.depth_files import read_depth_file
from dsr.io.inputs import read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.pairs import Pair, find_pairs_of_lists
from dsr.io.reading import CameraChoice, Reading

pytest.importorskip("pillow_heif")

LEVELS = np.add.outer(3 * np.arange(48), np.arange(64)).astype(np.uint8) + np.uint8(20)


TEXT = captures.apple_text()


def write(path, text=TEXT, **options):
    return captures.heic(path, LEVELS, text=text, **options)


def only(path):
    (pair,) = find_pairs_of_folder(path).pairs
    return read_picture(pair, Reading())


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (captures.depth_message(1, d_min=0.5, d_max=2.0), 1 / (0.5 + 1.5 * LEVELS / 255)),
        (captures.depth_message(0, z_near=0.25, z_far=4.0), 1 / (0.25 + 3.75 * LEVELS / 255)),
        (captures.depth_message(2, z_near=0.5, z_far=8.0), 0.5 + 7.5 * LEVELS / 255),
    ],
    ids=["disparity", "inverse depth", "depth"],
)
def test_depth_is_in_metres(tmp_path, message, expected):
    picture = only(write(tmp_path / "photo.heic", message=message))
    np.testing.assert_allclose(picture.depth_lr[0], expected, rtol=1e-5)
    assert np.abs(255 * picture.rgb.permute(1, 2, 0).numpy() - captures.large_photo()).mean() < 3
    assert picture.assumptions == ()


def test_values_that_are_no_distance_are_holes(tmp_path):
    levels = np.full((48, 64), 255, np.uint8)
    levels[:8] = 0
    path = captures.heic(tmp_path / "photo.heic", levels, captures.depth_message(1, d_min=-1.0, d_max=1.0))
    depth = only(path).depth_lr[0]
    assert depth[:8].isnan().all()
    np.testing.assert_allclose(depth[8:], 1)


@pytest.mark.parametrize(("orientation", "quarters"), [(3, 2), (6, 3), (8, 1)])
def test_photo_map_and_camera_are_turned_as_the_file_says(tmp_path, orientation, quarters):
    numbers = 200.0, 201.0, 120.0, 90.0
    picture = only(write(tmp_path / "photo.heic", captures.apple_text(numbers=numbers), orientation=orientation))
    np.testing.assert_allclose(picture.depth_lr[0], np.rot90(1 / (0.5 + 1.5 * LEVELS / 255), quarters), rtol=1e-5)
    assert picture.rgb.shape[1:] == (captures.HEIC if quarters == 2 else captures.HEIC[::-1])
    spot = np.zeros(captures.HEIC, bool)
    spot[90, 120] = True
    (row,), (column,) = np.nonzero(np.rot90(spot, quarters))
    camera = picture.camera
    assert (camera.cx, camera.cy) == (column, row)
    assert (camera.fx, camera.fy) == (numbers[:2] if quarters == 2 else numbers[1::-1])


def test_camera_is_scaled_from_its_own_size(tmp_path):
    size = (2 * captures.HEIC[0], 2 * captures.HEIC[1])
    camera = only(write(tmp_path / "photo.heic", captures.apple_text(size, (400.0, 402.0, 240.5, 180.5)))).camera
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (200, 201, 120, 90))


def test_camera_is_that_of_exif_data_without_calibration(tmp_path):
    picture = only(write(tmp_path / "photo.heic", ""))
    assert picture.camera.fx == pytest.approx(52 / math.hypot(36, 24) * math.hypot(*captures.HEIC))
    assert any("may be relative" in str(each) for each in picture.assumptions)


def test_depth_that_is_relative_is_said_to_be(tmp_path, capsys):
    path, out = write(tmp_path / "photo.heic", captures.apple_text(accuracy="relative")), tmp_path / "out"
    assert main(["upsample", str(path), "-o", str(out), "--method", "bicubic", "--only", "depth"]) == 0
    assert "the depth is relative" in capsys.readouterr().out
    assert read_depth_file(out / "photo" / "depth_metres.tiff").shape == captures.HEIC


def test_photos_of_a_folder_are_found_among_those_without_depth(tmp_path):
    import pillow_heif  # noqa: PLC0415

    for name in ("b", "a"):
        write(tmp_path / f"{name}.HEIC")
    pillow_heif.from_pillow(Image.fromarray(captures.photo())).save(tmp_path / "plain.heic")
    pairs = pickle.loads(pickle.dumps(find_pairs_of_folder(tmp_path).pairs))
    assert [pair.name for pair in pairs] == ["a", "b"]
    with pytest.raises(ValueError, match=r"plain\.heic: expected HEIC photos with depth, got another \.heic file"):
        find_pairs_of_folder(tmp_path / "plain.heic")


@pytest.mark.parametrize("upright", [True, False])
@pytest.mark.parametrize(("orientation", "quarters"), [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_photo_of_a_pair_may_be_heic_and_is_turned_as_its_jpeg_would_be(tmp_path, orientation, quarters, upright):
    """The depth map, another file, lies as the photo is stored or, if only that fits, as it is shown."""
    path = write(tmp_path / "photo.heic", orientation=orientation)
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = captures.large_photo()
    Image.fromarray(stored).save(tmp_path / "photo.jpg", exif=exif, quality=98, subsampling=0)
    depth = np.rot90(captures.depth(), quarters if upright else 0)
    np.save(tmp_path / "depth.npy", depth)
    heic, jpeg = (
        read_picture(Pair(path.stem, path, tmp_path / "depth.npy"), Reading(camera=CameraChoice(fov=60)))
        for path in (path, tmp_path / "photo.jpg")
    )
    assert heic.rgb.shape == jpeg.rgb.shape
    assert float((heic.rgb - jpeg.rgb).abs().mean()) < 0.02
    assert heic.assumptions == jpeg.assumptions
    np.testing.assert_array_equal(heic.depth_lr[0], depth.astype(np.float32))


def test_heic_photos_of_a_folder_belong_to_depth_maps_of_their_names(tmp_path):
    import pillow_heif  # noqa: PLC0415

    for number in range(2):
        for kind in ("rgb", "depth"):
            (tmp_path / kind).mkdir(exist_ok=True)
        photo = pillow_heif.from_pillow(Image.fromarray(captures.photo(number)))
        photo.save(tmp_path / "rgb" / f"{number}.HEIC", quality=-1, chroma=444)
        np.save(tmp_path / "depth" / f"{number}.npy", captures.depth(number))
    lists = find_pairs_of_lists([tmp_path / "rgb"], [tmp_path / "depth"])
    assert lists.pairs == find_pairs_of_folder(tmp_path).pairs
    assert len(lists.pairs) == 2
    for number, pair in enumerate(lists.pairs):
        picture = read_picture(pair, Reading(camera=CameraChoice(fov=60)))
        assert np.abs(255 * picture.rgb.permute(1, 2, 0).numpy() - captures.photo(number)).mean() < 3
        np.testing.assert_allclose(picture.depth_lr[0], captures.depth(number), rtol=1e-5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (captures.apple_text().replace("<rdf:li>1</rdf:li>", ""), None),
        (captures.apple_text(numbers=("x", 1, 2, 3)), None),
        (captures.apple_text(numbers=("nan", 1, 2, 3)), None),
        (captures.apple_text(size=(100, 300)), None),
        ("", captures.depth_message(3)),
        ("", captures.depth_message(2, z_near=1.0)),
        ("", captures.depth_message(1, d_min=-2.0, d_max=-1.0)),
        (None, None),
    ],
    ids=["eight", "text", "nan", "aspect", "nonuniform", "half a range", "negative", "truncated"],
)
def test_damaged_descriptions_are_refused(tmp_path, text, message):
    path = write(tmp_path / "photo.heic", text or "", message=message)
    if text is None:
        path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(ValueError, match=r"photo\.heic.*: expected") as caught:
        only(path)
    assert "\n" not in str(caught.value)

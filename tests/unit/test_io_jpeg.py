"""JPEG photos with depth maps of their own: GDepth and Dynamic Depth, what stays a plain photo, and refusals."""

import math
import pickle

import captures
import numpy as np
import pytest
import torch
from captures import encoded_jpeg, imaging_model
from small_files import encoded_png, written

from dsr.io.inputs import read_picture
from dsr.io.layouts import NoPairError, find_pairs_of_folder
from dsr.io.reading import Reading

LEVELS = np.add.outer(3 * np.arange(48), np.arange(64)).astype(np.uint8) + np.uint8(20)
SHARES = LEVELS / 255
INVERSE = 1 / (2 - 1.75 * SHARES)  # from 0.5 to 4 m
SURE = np.full(LEVELS.shape, 255, np.uint8)


def only(path, **reading):
    (pair,) = pickle.loads(pickle.dumps(find_pairs_of_folder(path).pairs))
    return read_picture(pair, Reading(**reading))


def said(picture):
    return "\n".join(map(str, picture.assumptions))


@pytest.mark.parametrize("write", [captures.gdepth, captures.dynamic_depth])
@pytest.mark.parametrize(
    ("values", "expected", "relative"),
    [
        ({}, INVERSE, ""),
        ({"Format": "RangeLinear"}, 0.5 + 3.5 * SHARES, ""),
        ({"Units": "mm", "Near": 500.0, "Far": 4000.0}, INVERSE, ""),
        ({"Units": "Diopters", "Near": 2.0, "Far": 0.25, "Format": "RangeLinear"}, INVERSE, ""),
        ({"Units": ""}, INVERSE, "the depth may be relative, the file does not"),
        ({"Units": "None"}, INVERSE, "the depth is relative, as the"),
    ],
)
def test_depth_is_in_metres_or_said_to_be_relative(tmp_path, write, values, expected, relative):
    picture = only(write(tmp_path / "photo.jpg", LEVELS, **values))
    np.testing.assert_allclose(picture.depth_lr[0], expected, rtol=1e-5)
    assert np.abs(255 * picture.rgb.permute(1, 2, 0).numpy() - captures.large_photo()).mean() < 3
    assert relative in said(picture)
    assert ("relative" in said(picture)) == bool(relative)


def test_map_of_16_bits_of_an_extension_in_any_order_or_in_the_first_segment_is_read(tmp_path):
    levels = np.random.default_rng(0).integers(0, 65536, (192, 256)).astype(np.uint16)  # more than a segment
    plain, swapped = (only(captures.gdepth(tmp_path / f"{swap}.jpg", levels, swap=swap)) for swap in (False, True))
    np.testing.assert_allclose(plain.depth_lr[0], 1 / (2 - 1.75 * levels / 65535), rtol=1e-5)
    assert torch.equal(swapped.depth_lr, plain.depth_lr)
    small = only(captures.gdepth(tmp_path / "small.jpg", LEVELS, extended=False))
    np.testing.assert_allclose(small.depth_lr[0], INVERSE, rtol=1e-5)


@pytest.mark.parametrize("options", [{"padding": 7}, {"progressive": True}])
def test_files_behind_the_photo_are_found_by_its_end_and_their_lengths(tmp_path, options):
    photo = encoded_jpeg(255 - captures.large_photo())
    picture = only(captures.dynamic_depth(tmp_path / "photo.jpg", LEVELS, SURE, original=photo, **options))
    np.testing.assert_allclose(picture.depth_lr[0], INVERSE, rtol=1e-5)
    assert 255 * float(picture.rgb.mean()) == pytest.approx(255 - captures.photo().mean(), abs=2)


def test_photo_before_effects_is_taken_if_it_has_the_size_of_the_photo(tmp_path):
    dark = np.zeros((*captures.HEIC, 3), np.uint8)
    for original, same in ((dark, True), (dark[::2, ::2], False)):
        picture = only(captures.gdepth(tmp_path / "photo.jpg", LEVELS, original=encoded_jpeg(original)))
        assert picture.rgb.shape[1:] == captures.HEIC
        assert (float(picture.rgb.max()) < 0.1) == same


@pytest.mark.parametrize("write", [captures.gdepth, captures.dynamic_depth])
def test_depth_without_any_confidence_is_a_hole_and_confidence_is_read(tmp_path, write):
    confidence = SURE.copy()
    confidence[:8], confidence[8:16] = 0, 51
    path = write(tmp_path / "photo.jpg", LEVELS, confidence)
    picture = only(path)
    np.testing.assert_allclose(picture.confidence[0], confidence / 255, atol=1e-6)
    assert picture.depth_lr[0].isnan().sum(1).tolist() == [64] * 8 + [0] * 40
    assert only(path, min_confidence=0.5).depth_lr[0].isnan().sum(1).tolist() == [64] * 16 + [0] * 32


@pytest.mark.parametrize("point", [(0.5, 0.5), (127.5, 95.5)])
def test_camera_is_the_imaging_model_with_its_principal_point_in_shares_or_pixels(tmp_path, point):
    camera = only(captures.dynamic_depth(tmp_path / "a.jpg", LEVELS, model=imaging_model(*point))).camera
    assert (camera.width, camera.height, camera.fx, camera.fy) == (256, 192, 200, 201)
    assert (camera.cx, camera.cy) == (127.5, 95.5)


def test_distances_along_the_rays_become_depth(tmp_path):
    options = {"model": imaging_model(), "MeasureType": "OpticRay"}
    picture = only(captures.dynamic_depth(tmp_path / "a.jpg", LEVELS, **options))
    y, x = np.mgrid[:48, :64]
    ray = np.sqrt(1 + ((x - 31.5) / 50) ** 2 + ((y - 23.5) / 50.25) ** 2)
    np.testing.assert_allclose(picture.depth_lr[0], INVERSE / ray, rtol=1e-5)


def test_photo_with_an_orientation_lies_as_stored_and_its_focal_length_is_that_of_exif(tmp_path):
    exif = captures.Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 52
    photo = encoded_jpeg(captures.large_photo(), exif=exif)
    picture = only(captures.gdepth(tmp_path / "photo.jpg", LEVELS, file=photo))
    assert picture.rgb.shape[1:] == captures.HEIC
    assert "orientation is ignored" in said(picture)
    assert picture.camera.fx == pytest.approx(52 / math.hypot(36, 24) * math.hypot(*captures.HEIC))


def test_photos_of_a_folder_are_read_unless_depth_maps_are_beside_them(tmp_path):
    for name in ("b.jpeg", "a.jpg", "a.JPG"):
        captures.gdepth(tmp_path / name, LEVELS)
    no_xmp = encoded_jpeg(captures.photo()) + b"http://ns.google.com/photos/1.0/depthmap/"
    plain = written(tmp_path / "plain.jpg", no_xmp)
    found = find_pairs_of_folder(tmp_path).pairs
    assert [pair.rgb.name for pair in found] == ["a.JPG", "a.jpg", "b.jpeg"]
    assert len({pair.name for pair in found}) == 3
    captures.save(tmp_path / "a_depth.png", captures.millimetres())
    (pair,) = find_pairs_of_folder(tmp_path).pairs
    assert (pair.capture, pair.depth.name) == (None, "a_depth.png")
    with pytest.raises(NoPairError, match=r"plain\.jpg: expected a folder or depth in a file as .*\.jpg.*; got none"):
        find_pairs_of_folder(plain)


def changed(write, old, new, count=-1, **options):
    def damage(path):
        content = write(path, LEVELS, **options).read_bytes()
        assert old in content
        path.write_bytes(content.replace(old, new, count))

    return damage


PICTURE, NUMBERS = "expected a grey JPEG or PNG", "Near, Far: expected positive numbers, got "
MODEL = imaging_model()
LARGE = encoded_png(np.random.default_rng(0).integers(0, 256, (200, 200, 3)).astype(np.uint8))
DATA, BOMB = b'GDepth:Data="iVBO', b'<!DOCTYPE a [<!ENTITY b "&b;&b;">]><x:xmpmeta'
REFUSED = {
    "no number": (changed(captures.gdepth, b'Near="0.5"', b'Near="x.5"'), f"{NUMBERS}'x.5', '4.0'"),
    "entity": (changed(captures.gdepth, b"<x:xmpmeta", BOMB, extended=False, Near="&b;"), NUMBERS),
    "no range": (changed(captures.dynamic_depth, b'Far="4.0"', b'Fir="4.0"'), NUMBERS),
    "infinite": (changed(captures.gdepth, b'Far="4.0"', b'Far="inf"'), NUMBERS),
    "format": (changed(captures.gdepth, b"RangeInverse", b"RangeSquared"), "Format: expected one of rangeinverse"),
    "base64": (changed(captures.gdepth, DATA, DATA + b"ABC\"", extended=False), PICTURE),
    "no picture": (changed(captures.gdepth, DATA, b'GDepth:Data="AAAA', extended=False), PICTURE),
    "colours": (lambda path: captures.gdepth(path, captures.photo()), f"{PICTURE}, got uint8 of shape"),
    "segment lost": (changed(captures.gdepth, b"/xmp/extension/", b"/xmp/extensiom/"), "expected GDepth:Data"),
    "extension cut": (changed(captures.gdepth, b"/xmp/extension/", b"/xmp/extensiom/", 1, original=LARGE), "of XMP, "),
    "length": (changed(captures.dynamic_depth, b'Length="', b'Length="x'), "Item:Length, Item:Padding: expected whole"),
    "beyond the end": (changed(captures.dynamic_depth, b'Length="', b'Length="9'), PICTURE),
    "no item": (changed(captures.dynamic_depth, b'DepthURI="android/', b'DepthURI="andromeda/'), PICTURE),
    "model": (changed(captures.dynamic_depth, b'LengthX="200"', b'LengthX="nan"', model=MODEL), "ImagingModel"),
    "size of confidence": (lambda path: captures.gdepth(path, LEVELS, SURE[1:]), "expected confidence"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_damaged_photo_is_refused_in_one_line_that_names_it(tmp_path, what):
    damage, message = REFUSED[what]
    path = tmp_path / "photo.jpg"
    damage(path)
    with pytest.raises(ValueError, match=message) as caught:
        only(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)

"""What stored values mean: units from medians, holes, range types, and back to the file."""

import math

import numpy as np
import pytest
import torch

from dsr.geometry.camera import Camera
from dsr.io.depth_files import Encoding, decode, encode, find_holes, read_depth_file
from dsr.io.reading import parse_unit
from dsr.io.units import interpret

CAMERA = Camera(4, 3, 5.0, 6.0, 1.0, 1.5, baseline=0.1)


def guess(middle, dtype):
    values = np.full((3, 3), middle, dtype)
    reported = interpret("d", values, np.zeros((3, 3), bool))
    return reported.unit, reported.assumptions


@pytest.mark.parametrize(
    ("middle", "dtype", "unit", "word"),
    [
        (2000, "u2", 1e-3, "millimetres"), (51, "u2", 1e-3, "millimetres"), (20_000, "u2", 1e-3, "millimetres"),
        (100_000, "i4", 1e-4, "0.1 mm"), (500_000, "i4", 1e-4, "0.1 mm"), (3_000_000, "u4", 1e-6, "micrometres"),
        (49, "u2", 1e-2, "centimetres"), (4, "u2", None, None), (2.0, "f4", 1.0, "metres"),
        (150.0, "f8", 1.0, "metres"), (1500.0, "f4", 1e-3, "millimetres"),
    ],
)  # fmt: skip
def test_unit_is_guessed_from_type_and_median_and_reported(middle, dtype, unit, word):
    if word is None:
        with pytest.raises(ValueError, match="no usual unit makes its median of 4 a distance; give one"):
            guess(middle, dtype)
        return
    found, assumptions = guess(middle, dtype)
    assert found == unit
    assert word in assumptions[0].text
    assert assumptions[0].detail


def test_depth_too_far_too_near_or_too_sparse_is_pointed_out():
    assert any("1/5000" in assumption.text for assumption in guess(12_000, "u2")[1])
    assert not any("1/5000" in assumption.text for assumption in guess(9_000, "u2")[1])
    sparse = np.arange(9).reshape(3, 3) > 2
    assert any(
        "1/256" in assumption.text for assumption in interpret("d", np.full((3, 3), 2000, "u2"), sparse).assumptions
    )
    assert not any(
        "1/256" in assumption.text for assumption in interpret("d", np.full((3, 3), 2000, "u2"), ~sparse).assumptions
    )
    assert any("nearer than 5 cm" in assumption.text for assumption in guess(0.01, "f4")[1])


def test_object_that_was_cut_out_is_not_taken_for_a_laser_scan():
    rows, columns = np.mgrid[:60, :80]
    person = (rows - 30) ** 2 / 4 + (columns - 40) ** 2 < 100
    lines = (rows % 6 == 0) & (columns % 2 == 0) & (rows > 20)
    for known, scan in ((person, False), (lines, True)):
        try:
            reported = [str(each) for each in interpret("d", np.full((60, 80), 2000, "u2"), ~known).assumptions]
        except ValueError as error:
            reported = [str(error)]
        assert any("1/256" in each for each in reported) == scan


@pytest.mark.parametrize(
    ("text", "unit"), [("m", 1), ("cm", 0.01), ("mm", 0.001), ("0.0002", 0.0002), ("1/5000", 2e-4)]
)
def test_unit_is_a_name_a_number_or_a_fraction(text, unit):
    assert parse_unit(text) == pytest.approx(unit)


@pytest.mark.parametrize("text", ["inch", "", "0", "-1", "1/0", "nan", "inf", "1/2/3"])
def test_unknown_unit_is_refused(text):
    with pytest.raises(ValueError, match="expected m, cm, mm or metres per value"):
        parse_unit(text)


def test_zeros_and_the_largest_whole_number_are_holes():
    holes, mark, assumptions = find_holes(np.array([[0, 1, 65535], [0, 64999, 7]], "u2"), None)
    np.testing.assert_array_equal(holes, [[1, 0, 1], [1, 0, 0]])
    assert mark == 0
    assert [str(assumption) for assumption in assumptions] == [
        "zeros count as holes (33.3%)",
        "values that are 65535 count as holes (16.7%)",
    ]


def test_a_sensors_end_of_16_bits_is_a_hole_unless_the_map_reaches_that_far():
    ends = np.array([[900, 65000], [65534, 1200]], "u2")
    holes, mark, assumptions = find_holes(ends, None)
    np.testing.assert_array_equal(holes, [[0, 1], [1, 0]])
    assert mark == 0
    assert [str(assumption) for assumption in assumptions] == ["values that are 65000 or more count as holes (50.0%)"]
    assert not find_holes(np.array([[900, 65000], [65534, 51000]], "u2"), None)[0].any()
    assert not find_holes(ends.astype("i4"), None)[0].any()


@pytest.mark.parametrize(
    ("values", "hole_value", "mark"),
    [
        ([1, 0, 0, np.nan], None, 0.0), ([1, np.nan, np.nan, 0], None, math.nan), ([1, np.inf, 2, 3], None, math.inf),
        ([1, -1, -2, 3], None, math.nan), ([1, 2, 3, 4], None, math.nan), ([1, -1, 2, 0], -1.0, -1.0),
    ],
)  # fmt: skip
def test_invalid_floats_are_holes_and_the_commonest_mark_is_kept(values, hole_value, mark):
    array = np.array([values], "f4")
    holes, found, _ = find_holes(array, hole_value)
    np.testing.assert_array_equal(holes, ~(np.isfinite(array) & (array > 0)))
    np.testing.assert_equal(found, mark)


@pytest.mark.parametrize(
    "encoding",
    [
        Encoding(".png", "uint16", 1e-3, 0.0, "orthogonal"),
        Encoding(".png", "uint16", 1 / 5000, 0.0, "perspective"),
        Encoding(".npy", "float64", 0.01, math.nan, "orthogonal"),
        Encoding(".pfm", "float32", 1.0, math.inf, "disparity"),
    ],
)
def test_stored_map_round_trips_value_by_value(encoding):
    stored = np.random.default_rng(1).integers(300, 5000, (3, 4)).astype(encoding.dtype)
    holes = np.zeros((3, 4), bool)
    holes[1, 2] = True
    stored[holes] = encoding.hole
    depth = decode(stored, holes, encoding, CAMERA)
    assert (tuple(depth.shape), depth.dtype) == ((1, 3, 4), torch.float32)
    again, lost = encode(depth, encoding, CAMERA)
    assert (again.dtype, lost) == (stored.dtype, 0)
    np.testing.assert_allclose(again, stored, rtol=3e-7)
    if stored.dtype.kind == "u":
        np.testing.assert_array_equal(again, stored)


def test_range_types_equal_their_closed_forms():
    values, none = np.full((3, 4), 2.0), np.zeros((3, 4), bool)
    along_ray = decode(values, none, Encoding(".npy", "float64", 1.0, math.nan, "perspective"), CAMERA)
    assert float(along_ray[0, 0, 3]) == pytest.approx(2 / math.sqrt(1 + (2 / 5) ** 2 + (1.5 / 6) ** 2))
    disparity = decode(values, none, Encoding(".npy", "float64", 1.0, math.nan, "disparity"), CAMERA)
    assert float(disparity[0, 0, 0]) == pytest.approx(0.1 * 5 / 2)


def test_values_beyond_16_bits_of_a_millimetre_become_counted_holes():
    depth = torch.tensor([[[65.534, 65.6, 0.0001, math.nan], [1.0004, 1.0006, 2, 3], [1, 1, 1, 1]]])
    values, lost = encode(depth, Encoding(".png", "uint16", 1e-3, 0.0, "orthogonal"), CAMERA)
    assert lost == 2
    np.testing.assert_array_equal(values[:2], [[65534, 0, 0, 0], [1000, 1001, 2000, 3000]])


def test_maps_of_sensors_in_millimetres_and_metres_are_never_asked_about(shared):
    """Each is read in both, as it is and as floats; nothing is warned of."""
    paths = [
        *sorted((shared / "modern" / "RGBDD" / "Depth").glob("*.png"))[::4],
        *(shared / "real" / "depth_camera").glob("*/raw_depth.png"),
        *sorted((shared / "real" / "ddrnet").glob("*depth*/*.png"))[::4],
        *(shared / "real" / "stereo_board" / "depth").glob("*.png"),
        shared / "real" / "iphone_lidar" / "arkit_depth.png",
    ]
    assert len(paths) > 15
    for path in paths:
        values = read_depth_file(path)
        holes = find_holes(values, None)[0]
        for each, unit in ((values, 1e-3), (values.astype(np.float32) / 1000, 1.0)):
            reported = interpret(str(path), each, holes, Camera.from_fov(60, values.shape[1], values.shape[0]))
            assert (reported.unit, reported.range_type, reported.bits) == (unit, None, 0)
            assert not [each for each in reported.assumptions if each.code]

"""``dsr upsample`` on captures: what is printed, what info.json keeps, confidence, refusals."""

import captures
import numpy as np
import pytest
from captures import FRAMES, INTRINSICS
from PIL import Image
from upsampling import info, refused_line, upsample

from dsr.io.depth_files import read_depth_file

DEPTH_ONLY = ("--method", "bicubic", "--only", "depth")


def test_capture_of_a_phone_has_nothing_left_to_assume(tmp_path, capsys):
    folder, out = captures.stray(tmp_path / "scan"), tmp_path / "out"
    assert upsample(folder, "-o", out, *DEPTH_ONLY) == 0
    said = capsys.readouterr().out
    assert f"{FRAMES} pairs of photo and depth map\n  a capture of Stray Scanner: depth in millimetres; " in said
    assert "; from the capture: intrinsics, poses, confidence\n" in said
    assert "assumed" not in said
    assert "taken for" not in said
    for number in range(FRAMES):
        reported = info(out / f"{number:06}")
        np.testing.assert_allclose(reported["pose"], captures.pose(number), atol=1e-6)
        camera = [reported["camera"][name] for name in ("fx", "fy", "cx", "cy")]
        assert camera == [INTRINSICS[0] + number, *INTRINSICS[1:]]
        assert reported["input_depth"]["unit"] == 0.001
        assert (reported["inputs"]["rgb"]["file"], reported["inputs"]["rgb"]["frame"]) == ("rgb.mp4", number)
        metres = read_depth_file(out / f"{number:06}" / "depth_metres.tiff")
        assert np.abs(metres - captures.depth(number).mean()).max() < 0.3
    assert upsample(folder, "-o", out, *DEPTH_ONLY) == 0
    assert f"{FRAMES} complete already" in capsys.readouterr().out


@pytest.fixture
def lists(tmp_path):
    """Two pairs in folders, with confidence maps in a folder of their own."""
    for number in range(2):
        captures.save(tmp_path / "rgb" / f"{number}.png", captures.photo(number))
        captures.save(tmp_path / "depth" / f"{number}.png", captures.millimetres(number))
        captures.save(tmp_path / "sure" / f"confidence_{number:03}.png", captures.levels())
    return tmp_path


@pytest.mark.parametrize("kind", ["bytes", "fractions"])
def test_confidence_maps_may_be_bytes_or_fractions_and_the_least_is_kept_with_the_settings(lists, capsys, kind):
    for number in range(2):
        path = lists / "sure" / f"confidence_{number:03}.png"
        if kind == "bytes":
            captures.save(path, np.array([1, 130, 255], np.uint8)[captures.levels()])
        if kind == "fractions":
            path.unlink()
            np.save(path.with_suffix(".npy"), captures.levels().astype(np.float32) / 2)
    given = ("--rgb", lists / "rgb", "--depth", lists / "depth", "--confidence", lists / "sure")
    out = lists / "out"
    assert upsample(*given, "--min-confidence", 0.5, "--fill", "none", "-o", out, *DEPTH_ONLY) == 0
    assert "confidence below 0.5 counts as a hole (12.5%)" in capsys.readouterr().out
    for number in range(2):
        holes = np.asarray(Image.open(out / str(number) / "depth.png")) == 0
        np.testing.assert_array_equal(np.flatnonzero(holes.any(axis=0)), np.arange(8))
        assert info(out / str(number))["settings"]["min_confidence"] == 0.5


def test_confidence_that_does_not_fit_is_refused_in_one_line(lists, capsys):
    given = ("--rgb", lists / "rgb", "--depth", lists / "depth", "-o", lists / "out", *DEPTH_ONLY)
    sure = ("--confidence", lists / "sure")
    for options, named in ((sure, "--confidence: "), ((*sure, "--min-confidence", 2), "--min-confidence: ")):
        assert refused_line(capsys, upsample(*given, *options)).startswith(named)
    captures.save(lists / "sure" / "confidence_000.png", np.ones((5, 7), np.uint8))
    assert "confidence_000.png: " in refused_line(capsys, upsample(*given, *sure, "--min-confidence", 0.5))
    assert (lists / "out" / "1" / "depth.png").is_file()
    (lists / "sure" / "confidence_001.png").unlink()
    assert "such as 1" in refused_line(capsys, upsample(*given, *sure, "--min-confidence", 0.5))

"""NYU Depth v2: the labelled file's axes, frames and crop, and damage in single arrays; the splits of either layout."""

import h5py
import numpy as np
import pytest
from data_set_files import SETS
from refusals import refused
from small_files import written

from dsr.data.nyu import CAMERA, NYU, find_files, find_frames, load_frame

ROWS, COLUMNS = np.mgrid[0:480, 0:640]
RAW = np.stack([1.0 + ROWS / 512 + COLUMNS / 8192, 4.0 + ROWS / 512]).astype(np.float32)
"""(frames, rows, columns) in metres; not symmetric under any flip."""
FILLED = RAW + np.float32(0.25)
IMAGES = np.stack([ROWS % 256, COLUMNS % 256, ROWS * 0 + 51])[None].repeat(2, axis=0).astype(np.uint8)


def official(path, **changes):
    """Write a MATLAB 7.3 file: 512 bytes of text, then HDF5 with the axes turned around."""
    arrays = {"images": IMAGES.swapaxes(2, 3), "rawDepths": RAW.swapaxes(1, 2), "depths": FILLED.swapaxes(1, 2)}
    with h5py.File(path, "w", userblock_size=512) as file:
        for key, array in {**arrays, **changes}.items():
            if array is not None:
                file.create_dataset(key, data=array, chunks=(1, *array.shape[1:]) if array.ndim > 1 else None)
        file.create_group("#refs#")
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + path.read_bytes()[512:])
    return path


def load(path):
    return load_frame(path, 1, "nyu", "0001")


def test_frames_are_counted_from_1_and_turned_upright_with_or_without_their_border(tmp_path):
    path = official(tmp_path / "nyu.mat")
    assert find_frames(path) == {"0001": (path, 1), "0002": (path, 2)}
    for number, filled, truth in ((1, False, RAW), (2, False, RAW), (2, True, FILLED)):
        whole = load_frame(path, number, "nyu", "a", filled=filled, crop=False)
        np.testing.assert_array_equal(whole.depth[0], truth[number - 1])
        np.testing.assert_array_equal((whole.rgb * 255).round(), IMAGES[number - 1])
        assert whole.camera == CAMERA
        cropped = load_frame(path, number, "nyu", "a", filled=filled)
        np.testing.assert_array_equal(cropped.depth[0], truth[number - 1, 44:471, 40:601])
        np.testing.assert_array_equal((cropped.rgb * 255).round(), IMAGES[number - 1, :, 44:471, 40:601])
        camera = cropped.camera
        assert (camera.height, camera.width, camera.fx) == (427, 561, CAMERA.fx)
        assert (camera.cx, camera.cy) == pytest.approx((325.582449 - 41, 253.736166 - 45), abs=1e-6)


NEGATIVE = RAW.swapaxes(1, 2).copy()
NEGATIVE[0, 3, 4] = -1


@pytest.mark.parametrize(
    "changes",
    [
        {"images": None}, {"rawDepths": None}, {"images": IMAGES}, {"images": IMAGES.swapaxes(2, 3).astype(np.uint16)},
        {"rawDepths": RAW}, {"rawDepths": RAW.swapaxes(1, 2)[:1]}, {"depths": np.ones(5, np.float32)},
        {"rawDepths": RAW.swapaxes(1, 2).astype(np.float64)},
    ],
)  # fmt: skip
def test_file_of_other_arrays_is_refused_in_one_line(tmp_path, capfd, changes):
    [key] = changes
    path = official(tmp_path / "nyu.mat", **changes)
    assert key in refused(lambda: load(path), path, capfd)


@pytest.mark.parametrize("value", [np.nan, -1.0])
def test_non_finite_or_negative_depth_is_refused(tmp_path, capfd, value):
    path = official(tmp_path / "nyu.mat", rawDepths=np.where(NEGATIVE < 0, np.float32(value), NEGATIVE))
    assert "expected positive depth" in refused(lambda: load(path), path, capfd)


@pytest.fixture
def all_frames(tmp_path):
    """A folder with a labelled file of all frames, of which no block is stored: the filled depth is 2 m everywhere."""
    with h5py.File(tmp_path / "nyu_depth_v2_labeled.mat", "w") as file:
        for key, shape, dtype, value in (("images", (3, 640, 480), "u1", 51), ("depths", (640, 480), "f4", 2.0),
                                         ("rawDepths", (640, 480), "f4", 1.0)):  # fmt: skip
            file.create_dataset(key, (1449, *shape), dtype, chunks=(1, *shape), fillvalue=value)
    return str(tmp_path)


def test_splits_of_the_labelled_file_are_whole_frames_with_filled_depth(all_frames):
    test, train, whole = NYU(all_frames, split="test"), NYU(all_frames, split="train"), NYU(all_frames)
    assert test.scenes() == [f"{number:04d}" for number in range(1001, 1450)]
    assert train.scenes() == [f"{number:04d}" for number in range(1, 1001)]
    assert len(whole.scenes()) == 1449
    assert (test.evaluation, train.evaluation, whole.evaluation) == (True, False, True)
    filled = NYU(all_frames, filled=True)  # filled depth alone has mixtures at its steps
    assert [each.soft_edges for each in (test, train, filled, whole)] == [True, True, True, False]
    scene = test.load("1001")
    assert (scene.camera, scene.depth.unique().tolist(), tuple(scene.depth.shape)) == (CAMERA, [2.0], (1, 480, 640))


def test_files_are_named_as_the_frames_of_the_labelled_file(tmp_path):
    for number in ("1448", "1000"):
        for path, content in SETS["nyu"].files.items():
            written(tmp_path / path.replace("1000", number), content)
    written(tmp_path / "DCTNet/RGB/1002.jpg", b"")
    assert list(find_files(tmp_path)) == NYU(str(tmp_path), "found", split="test").scenes() == ["1001", "1449"]
    with pytest.raises(ValueError, match=r"expected 1002, .*, 1031 and 417 more in .* got 2 of 449 scenes"):
        NYU(str(tmp_path), split="test")

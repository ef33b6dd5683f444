"""NYU Depth v2: the labelled file, axes, crop and camera; the splits from either layout; every damage named."""

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
    raw = RAW.copy()
    raw[0, 100, 200] = 0
    arrays = {"images": IMAGES.swapaxes(2, 3), "rawDepths": raw.swapaxes(1, 2), "depths": FILLED.swapaxes(1, 2)}
    with h5py.File(path, "w", userblock_size=512) as file:
        for key, array in {**arrays, **changes}.items():
            if array is not None:
                file.create_dataset(key, data=array, chunks=(1, *array.shape[1:]) if array.ndim > 1 else None)
        file.create_group("#refs#")
    content = path.read_bytes()
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + content[512:])
    return path


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    return official(tmp_path_factory.mktemp("nyu") / "nyu_depth_v2_labeled.mat")


def refusal(act, path, capfd):
    return refused(lambda: act(path), path, capfd)


def load(path):
    return load_frame(path, 1, "nyu", "0001")


def test_frame_is_turned_upright_with_its_kinect_holes(labelled):
    scene = load_frame(labelled, 1, "nyu", "0001", crop=False)
    assert scene.camera == CAMERA
    np.testing.assert_array_equal((scene.rgb * 255).round(), IMAGES[0])
    assert scene.depth.isnan().nonzero().tolist() == [[0, 100, 200]]
    np.testing.assert_array_equal(scene.depth[0, 101:], RAW[0, 101:])


def test_inpainted_depth_is_read_on_request(labelled):
    scene = load_frame(labelled, 2, "nyu", "0002", filled=True, crop=False)
    np.testing.assert_array_equal(scene.depth[0], FILLED[1])


def test_border_is_cropped_with_the_camera(labelled):
    scene = load_frame(labelled, 2, "nyu", "0002")
    np.testing.assert_array_equal(scene.depth[0], RAW[1, 44:471, 40:601])
    np.testing.assert_array_equal((scene.rgb * 255).round(), IMAGES[1, :, 44:471, 40:601])
    camera = scene.camera
    assert (camera.height, camera.width, camera.fx) == (427, 561, CAMERA.fx)
    assert (camera.cx, camera.cy) == pytest.approx((325.582449 - 41, 253.736166 - 45), abs=1e-6)


def test_frames_are_counted_from_1(labelled):
    assert find_frames(labelled) == {"0001": (labelled, 1), "0002": (labelled, 2)}


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: b"", lambda whole: b"<html>not found</html>", lambda whole: whole[:512],
        lambda whole: whole[:1000], lambda whole: whole[: len(whole) // 2],
        lambda whole: whole[:600] + b"\xff" * 400 + whole[1000:], lambda whole: b"MATLAB 5.0 MAT-file".ljust(4096),
    ],
)  # fmt: skip
def test_damaged_or_foreign_file_is_refused_in_one_line(labelled, tmp_path, capfd, damage):
    path = tmp_path / "nyu.mat"
    path.write_bytes(damage(labelled.read_bytes()))
    for act in (load, find_frames):
        assert "expected" in refusal(act, path, capfd)


@pytest.mark.parametrize(
    "changes",
    [
        {"images": None}, {"rawDepths": None}, {"images": IMAGES}, {"images": IMAGES.swapaxes(2, 3).astype(np.uint16)},
        {"rawDepths": RAW}, {"rawDepths": RAW.swapaxes(1, 2)[:1]},
        {"rawDepths": RAW.swapaxes(1, 2).astype(np.float64)}, {"depths": np.ones(5, np.float32)},
    ],
)  # fmt: skip
def test_file_of_other_arrays_is_refused_in_one_line(tmp_path, capfd, changes):
    (key,) = changes
    path = official(tmp_path / "nyu.mat", **changes)
    assert key in refusal(load, path, capfd)


@pytest.mark.parametrize("value", [np.nan, -1.0])
def test_non_finite_or_negative_depth_is_refused(tmp_path, capfd, value):
    raw = RAW.swapaxes(1, 2).copy()
    raw[0, 3, 4] = value
    assert "expected positive depth" in refusal(load, official(tmp_path / "nyu.mat", rawDepths=raw), capfd)


def test_damaged_block_is_refused_without_affecting_other_frames(tmp_path, capfd):
    path = tmp_path / "nyu.mat"
    official(path, depths=None)
    with h5py.File(path, "a") as file:
        depths = file.create_dataset("depths", data=FILLED.swapaxes(1, 2), chunks=(1, 640, 480), compression="gzip")
        file.flush()
        block = depths.id.get_chunk_info(0)
    content = bytearray(path.read_bytes())
    start = content.index(b"\x89HDF") + block.byte_offset
    content[start : start + 1000] = bytes(1000)
    path.write_bytes(content)
    refusal(lambda path: load_frame(path, 1, "nyu", "a", filled=True), path, capfd)
    assert load_frame(path, 2, "nyu", "a", filled=True).depth.isfinite().all()
    assert load(path).depth.isfinite().any()


@pytest.fixture(scope="module")
def all_frames(tmp_path_factory):
    """A folder with a labelled file of all frames, of which no block is stored: the filled depth is 2 m everywhere."""
    folder = tmp_path_factory.mktemp("nyu")
    with h5py.File(folder / "nyu_depth_v2_labeled.mat", "w") as file:
        for key, shape, dtype, value in (("images", (3, 640, 480), "u1", 51), ("depths", (640, 480), "f4", 2.0),
                                         ("rawDepths", (640, 480), "f4", 1.0)):  # fmt: skip
            file.create_dataset(key, (1449, *shape), dtype, chunks=(1, *shape), fillvalue=value)
    return str(folder)


def test_splits_of_the_labelled_file_are_whole_frames_with_filled_depth(all_frames):
    test, train, whole = NYU(all_frames, split="test"), NYU(all_frames, split="train"), NYU(all_frames)
    assert (len(test.scenes()), test.scenes()[0], test.scenes()[-1]) == (449, "1001", "1449")
    assert (len(train.scenes()), train.scenes()[0], train.scenes()[-1]) == (1000, "0001", "1000")
    assert len(whole.scenes()) == 1449
    assert (test.evaluation, train.evaluation, whole.evaluation) == (True, False, True)
    scene = test.load("1001")
    assert (scene.camera, scene.depth.unique().tolist(), tuple(scene.depth.shape)) == (CAMERA, [2.0], (1, 480, 640))
    assert tuple(NYU(all_frames, size=None).load("1001").depth.shape) == (1, 427, 561)


def test_files_are_named_as_the_frames_of_the_labelled_file(tmp_path):
    for number in ("1448", "1000"):
        for path, content in SETS["nyu"].files.items():
            written(tmp_path / path.replace("1000", number), content)
    written(tmp_path / "DCTNet/RGB/1002.jpg", b"")
    assert list(find_files(tmp_path)) == ["1001", "1449"]
    data = NYU(str(tmp_path), "found", split="test")
    assert data.scenes() == ["1001", "1449"]
    assert data.load("1001").camera == CAMERA
    with pytest.raises(ValueError, match=r"expected 1002, .*, 1031 and 417 more in .* got 2 of 449 scenes"):
        NYU(str(tmp_path), split="test")


def test_real_test_images_are_read(shared):
    data = NYU(str(shared / "modern/NYU"), "found", split="test")
    assert data.scenes() == ["1001", "1002", "1003"]
    assert data.load("1001").depth.min().item() == pytest.approx(0.7139, abs=1e-4)

"""``dataset=nyu`` with a split: the frames that the field trains and tests on, from either layout."""

import io
import re

import cv2
import h5py
import numpy as np
import pytest
from refusals import refused

from dsr.data.nyu import CAMERA, NYU, find_files, load_files

ROWS, COLUMNS = np.mgrid[0:480, 0:640]
DEPTH = (1.0 + ROWS / 512 + COLUMNS / 8192).astype(np.float32)
PHOTO = cv2.imencode(".jpg", np.full((480, 640, 3), 51, np.uint8))[1].tobytes()


def npy(array, *, allow_pickle=False):
    content = io.BytesIO()
    np.save(content, array, allow_pickle=allow_pickle)
    return content.getvalue()


def files(root, number=1000):
    paths = (root / f"RGB/{number}.jpg", root / f"Depth/{number}.npy")
    for path, content in zip(paths, (PHOTO, npy(DEPTH)), strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return paths


@pytest.fixture(scope="module")
def labelled(tmp_path_factory):
    """A folder with a labelled file of all frames, of which no block is stored: the filled depth is 2 m everywhere."""
    folder = tmp_path_factory.mktemp("nyu")
    with h5py.File(folder / "nyu_depth_v2_labeled.mat", "w") as file:
        for key, shape, dtype, value in (("images", (3, 640, 480), "u1", 51), ("depths", (640, 480), "f4", 2.0),
                                         ("rawDepths", (640, 480), "f4", 1.0)):  # fmt: skip
            file.create_dataset(key, (1449, *shape), dtype, chunks=(1, *shape), fillvalue=value)
    return str(folder)


def test_splits_of_the_labelled_file_are_whole_frames_with_filled_depth(labelled):
    test, train, whole = NYU(labelled, split="test"), NYU(labelled, split="train"), NYU(labelled)
    assert (len(test.scenes()), test.scenes()[0], test.scenes()[-1]) == (449, "1001", "1449")
    assert (len(train.scenes()), train.scenes()[0], train.scenes()[-1]) == (1000, "0001", "1000")
    assert len(whole.scenes()) == 1449
    assert (test.evaluation, train.evaluation, whole.evaluation) == (True, False, True)
    scene = test.load("1001")
    assert (scene.camera, scene.depth.unique().tolist(), tuple(scene.depth.shape)) == (CAMERA, [2.0], (1, 480, 640))
    assert tuple(NYU(labelled, size=None).load("1001").depth.shape) == (1, 427, 561)


def test_files_are_named_as_the_frames_of_the_labelled_file(tmp_path):
    files(tmp_path / "NYU", 1448)
    written = files(tmp_path / "NYU", 1000)
    (tmp_path / "NYU/RGB/1002.jpg").write_bytes(PHOTO)
    assert list(find_files(tmp_path)) == ["1001", "1449"]
    data = NYU(str(tmp_path), "found", split="test")
    assert data.scenes() == ["1001", "1449"]
    scene = data.load("1001")
    np.testing.assert_array_equal(scene.depth[0], DEPTH)
    assert scene.camera == CAMERA
    assert load_files(*written, "nyu", "1001").rgb.unique().tolist() == pytest.approx([0.2])
    with pytest.raises(
        ValueError, match=r"expected 1002, .*, 1031 and 417 more in .* got 2 of 449 scenes; .*dataset\.scenes=found"
    ):
        NYU(str(tmp_path), split="test")
    with pytest.raises(ValueError, match=r"expected its files in .*, got no scene of it"):
        NYU(str(tmp_path), "found", split="train")
    with pytest.raises(ValueError, match="split: expected one of train, test, or null, got val"):
        NYU(str(tmp_path), split="val")


@pytest.mark.parametrize(
    ("which", "content", "message"),
    [
        (0, PHOTO[:99], "expected a picture"),
        (0, cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1].tobytes(), "expected 480 x 640 pixels"),
        (1, b"", "expected a NumPy array, got a damaged or foreign file"),
        (1, npy(DEPTH)[:5000], "expected a NumPy array, got a damaged or foreign file"),
        (1, npy(np.array([print], dtype=object), allow_pickle=True), "expected a NumPy array"),
        (1, npy(DEPTH[1:]), "expected 480 x 640 pixels"),
        (1, npy(DEPTH[None]), "expected one channel"),
        (1, npy(DEPTH.astype(np.uint8)), "expected 16-bit or floating point values"),
        (1, npy(-DEPTH), "expected positive depth"),
    ],
)
def test_damaged_or_foreign_file_is_refused_in_one_line_that_names_it(tmp_path, capfd, which, content, message):
    written = files(tmp_path)
    written[which].write_bytes(content)
    assert re.match(message, refused(lambda: load_files(*written, "nyu", "1001"), written[which], capfd))


def test_real_test_images_are_read(shared):
    data = NYU(str(shared / "modern/NYU"), "found", split="test")
    assert data.scenes() == ["1001", "1002", "1003"]
    assert data.load("1001").depth.min().item() == pytest.approx(0.7139, abs=1e-4)

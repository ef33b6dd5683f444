"""ToFMark: pictures whose scale the caller gives, .mat files whose variables are found, samples gathered in blocks."""

import struct

import cv2
import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse
import torch
from refusals import refused
from small_files import written

from dsr.data.matlab import read_variables
from dsr.data.tofmark import ToFMark, block_means, find_frames, load_frame, read_matrices

INTRINSICS = (40.0, 40.0, 19.5, 9.5)
SIZE = (22, 40)
ROWS, COLUMNS = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
TRUTH = 0.75 + ROWS / 64 + COLUMNS / 1024  # Metres; not symmetric under any flip
SPARSE = np.where((ROWS % 6 == 1) & (COLUMNS % 6 == 2), TRUTH, 0)
GREY = ((ROWS * 7 + COLUMNS) % 256).astype(np.uint8)


def bmp(levels):
    """Return a Windows bitmap of 256 greys."""
    return cv2.imencode(".bmp", levels.astype(np.uint8))[1].tobytes()


def old(path, variables, *, compress=False):
    scipy.io.savemat(path, variables, do_compression=compress)
    return path


def new(path, variables):
    """Write a MATLAB 7.3 file: 512 bytes of text, then HDF5 with the axes turned around."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in variables.items():
            file[name.replace(".", "/")] = np.asarray(values).T
        file["#refs#/a"] = TRUTH.T
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + path.read_bytes()[512:])
    return path


@pytest.fixture
def pictures(tmp_path):
    levels = np.zeros(SIZE)
    levels[1::6, 2::6] = np.arange(4)[:, None] * 60 + np.arange(7) + 1
    levels[1, 2], levels[1, 8] = 1, 255
    return written(tmp_path / "books.bmp", bmp(GREY)), written(tmp_path / "books_depth.bmp", bmp(levels))


def test_range_of_the_caller_converts_levels_to_metres_and_0_is_no_sample(pictures):
    scene = load_frame(*pictures, "tofmark", "books", intrinsics=INTRINSICS, depth_range=(0.5, 3.04))
    assert scene.depth is None
    assert scene.measured[4].shape == (1, 5, 10)
    samples = scene.measured[4][0]  # a sample in 28 of the blocks
    assert samples[[0, 0, 1], [0, 2, 0]].tolist() == pytest.approx([0.5, 3.04, 0.5 + 60 * 0.01])
    assert samples.isfinite().sum().item() == 28
    assert (scene.camera.height, scene.camera.width, scene.camera.cy) == (*SIZE, 9.5)
    np.testing.assert_array_equal((scene.rgb * 255).round()[2], GREY)


def test_pictures_without_a_range_or_a_camera_are_refused_with_the_reason(pictures, capfd):
    rgb, samples = pictures
    message = refused(lambda: load_frame(rgb, samples, "t", "b", intrinsics=INTRINSICS), samples, capfd)
    assert "lost the metric scale" in message
    assert "no camera" in refused(lambda: load_frame(rgb, samples, "t", "b", depth_range=(0.5, 1)), rgb, capfd)


@pytest.mark.parametrize("content", [b"", bmp(GREY)[:1078], bmp(GREY)[:-400], b"text", bmp(GREY * 0), bmp(GREY[:21])])
def test_damaged_picture_of_samples_is_refused(pictures, capfd, content):
    rgb, samples = pictures
    written(samples, content)
    act = lambda: load_frame(rgb, samples, "t", "b", intrinsics=INTRINSICS, depth_range=(0.5, 1.0))  # noqa: E731
    assert "expected" in refused(act, samples, capfd)


def test_depth_of_a_block_is_the_mean_of_its_samples_inverse_depths():
    depth = torch.full((1, 5, 9), torch.nan, dtype=torch.float64)
    depth[0, 0, 0], depth[0, 3, 3], depth[0, 1, 5], depth[0, 4, 8] = 1.0, 2.0, 3.0, 9.0
    means = block_means(depth, 4)
    torch.testing.assert_close(means, torch.tensor([[[4 / 3, 3.0]]], dtype=torch.float64))
    assert block_means(depth, 2).isfinite().sum().item() == 3


NAMINGS = {
    "plain": ("intensity", "depth_gt", "tof"),
    "capitals": ("I", "GT", "D_LR"),
    "one depth": ("gray", "ground_truth", "depth"),
    "no help": ("Image", "a", "b"),
    "structure": ("scene.img", "scene.depthHR", "scene.depth_sparse"),
}


@pytest.mark.parametrize(("kind", "scale"), [("5", 1.0), ("5 compressed", 1000.0), ("7.3", 1000.0)])
@pytest.mark.parametrize("naming", NAMINGS)
def test_variables_are_recognised_by_name_and_content_in_metres_or_millimetres(tmp_path, naming, kind, scale):
    arrays = dict(zip(NAMINGS[naming], (GREY, TRUTH * scale, SPARSE * scale), strict=True))
    arrays |= {"weights": (SPARSE > 0) * 0.5, "tof_lowres": np.ones((6, 7)), "version": "1"}
    if "." in NAMINGS[naming][0] and kind != "7.3":
        arrays = {"scene": {name.rpartition(".")[2]: array for name, array in arrays.items()}}
    path = tmp_path / "benchmarking_dataset_books.mat"
    if kind == "7.3":
        del arrays["version"]
        new(path, arrays)
    else:
        old(path, arrays, compress="compressed" in kind)
    scene = load_frame(path, None, "tofmark", "books", intrinsics=INTRINSICS)
    np.testing.assert_allclose(scene.depth[0], TRUTH)
    np.testing.assert_array_equal((scene.rgb * 255).round()[0], GREY)
    samples = torch.from_numpy(np.where(SPARSE, SPARSE, np.nan))[None]
    torch.testing.assert_close(scene.measured[4], block_means(samples, 4), equal_nan=True)
    assert set(scene.measured) == {4, 8}


TYPES = ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8")


@pytest.mark.parametrize("compress", [False, True])
def test_matrices_of_every_type_are_read_and_other_content_is_skipped(tmp_path, compress):
    arrays = {kind: (GREY % 100).astype(kind) for kind in TYPES}
    arrays |= {"logical": GREY > 9, "cube": np.arange(24.0).reshape(2, 3, 4), "empty": np.zeros((0, 3))}
    others = {"text": "abc", "cell": np.array([1, "a"], object), "sparse": scipy.sparse.csc_matrix(SPARSE)}
    structure = {"s": {"deep": {"m": TRUTH}, "word": "a"}}
    path = old(tmp_path / "a.mat", {**arrays, **others, **structure}, compress=compress)
    found = read_variables(path)
    assert set(found) == {*arrays, "s.deep.m"}
    np.testing.assert_array_equal(found["s.deep.m"], TRUTH)
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype or name == "logical"


def test_variable_names_can_be_given_by_the_caller_and_truth_may_be_missing(tmp_path):
    path = old(tmp_path / "a.mat", {"x": GREY / 255, "y": TRUTH, "z": TRUTH + 1, "w": SPARSE})
    rgb, depth, samples = read_matrices(path, {"intensity": "x", "depth": "z"})
    np.testing.assert_allclose(rgb[1], GREY / 255, rtol=1e-6)
    np.testing.assert_array_equal(depth[0], TRUTH + 1)
    assert samples.isfinite().sum().item() == (SPARSE > 0).sum()
    _, depth, samples = read_matrices(old(path, {"intensity": GREY, "tof": np.where(SPARSE, SPARSE, np.nan)}))
    assert (depth, samples.isfinite().sum().item()) == (None, (SPARSE > 0).sum())


@pytest.mark.parametrize(
    ("variables", "reason"),
    [
        ({"a": TRUTH, "b": SPARSE}, "a 22 x 40, b 22 x 40"),
        ({"intensity": GREY}, "intensity 22 x 40"),
        ({"intensity": GREY, "tof": SPARSE[:20]}, "tof 20 x 40"),
        ({"intensity": GREY, "u": TRUTH, "v": TRUTH, "tof": SPARSE}, "it may be any of u, v"),
        ({"intensity": GREY, "tof": -SPARSE, "gt": -TRUTH}, "expected positive depth"),
        ({"intensity": GREY * np.nan, "gt": TRUTH}, "expected an image"),
        ({"intensity": GREY * 1e9, "gt": TRUTH}, "expected an image"),
        ({"intensity": GREY, "gt": TRUTH * 0}, "all are holes"),
        ({"text": "nothing else"}, "no matrix"),
    ],
)
def test_file_of_other_variables_is_refused_with_their_names(tmp_path, capfd, variables, reason):
    path = old(tmp_path / "a.mat", variables)
    assert reason in refused(lambda: read_matrices(path), path, capfd)


def test_matrix_larger_than_its_file_can_hold_is_refused_before_it_is_read(tmp_path, capfd):
    path = tmp_path / "a.mat"
    with h5py.File(path, "w") as file:
        file.create_dataset("intensity", shape=(10**6, 10**6), dtype="f8", chunks=(100, 100))
    assert "intensity have 1000000000000 elements" in refused(lambda: read_matrices(path), path, capfd)
    old(path, {"intensity": GREY})
    content = path.read_bytes()
    size = struct.pack("<ii", *SIZE)
    assert content.count(size) == 1
    written(path, content.replace(size, struct.pack("<ii", 10**6, 10**3)))
    assert "cannot reshape" in refused(lambda: read_matrices(path), path, capfd)


def test_scenes_are_listed_once_with_the_metric_file_first(tmp_path):
    for name in ("books.bmp", "books_depth.bmp", "benchmarking_dataset_books.mat", "shark.bmp", "shark_depth.bmp",
                 "devil_depth.bmp", "other.mat"):  # fmt: skip
        written(tmp_path / name, b"")
    assert find_frames(tmp_path) == {
        "books": (tmp_path / "benchmarking_dataset_books.mat", None),
        "shark": (tmp_path / "shark.bmp", tmp_path / "shark_depth.bmp"),
    }


def test_real_pictures_have_the_camera_that_is_given_or_an_estimate(shared):
    devil = ToFMark(str(shared / "real/tofmark"), depth_range=[0.4, 0.9]).load("devil")
    assert (devil.camera.fx, devil.notes) == (549.2, ("the benchmark has no camera: it is an estimate",))
    given = ToFMark(str(shared / "real/tofmark"), None, [600.0, 600.0, 404.5, 304.5], [0.4, 0.9]).load("devil")
    assert (given.camera.fx, given.notes) == (600.0, ())

"""Files of poses and of extrinsics in every format, and every refusal."""

import json
from pathlib import Path

import captures
import numpy as np
import pytest
import realsense
from scipy.spatial.transform import Rotation

from dsr.io.inputs import read_picture
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.pairs import Pair
from dsr.io.reading import Reading
from dsr.io.trajectories import read_poses, read_transform

TURN = Rotation.from_euler("xyz", (10, -20, 30), degrees=True)
MATRIX = np.eye(4)
MATRIX[:3, :3], MATRIX[:3, 3] = TURN.as_matrix(), (0.1, -0.2, 0.3)
TUM = "{time} 0.1 -0.2 0.3 " + " ".join(f"{value:.9f}" for value in TURN.as_quat())


def text(matrix):
    return "\n".join(" ".join(f"{value:.9f}" for value in row) for row in matrix) + "\n"


def pairs(*names):
    return [Pair(name, Path(f"rgb/{name}.png"), Path(f"depth/{name}.png")) for name in names]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("x.txt", text(MATRIX)),
        ("x.txt", text(MATRIX[:3])),
        ("x.txt", "# depth to colour\n" + text(MATRIX).replace(" ", ", ")),
        ("x.txt", " ".join(str(value) for value in MATRIX.ravel())),
        ("x.json", json.dumps(MATRIX.tolist())),
        ("x.json", json.dumps({"unit": "m", "depth_to_photo": MATRIX[:3].tolist()})),
        ("x.json", json.dumps(MATRIX.ravel().tolist())),
    ],
)
def test_extrinsics_are_read_in_every_format(tmp_path, name, content):
    (tmp_path / name).write_text(content)
    assert read_transform(tmp_path / name) == pytest.approx(MATRIX, abs=1e-8)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("x.txt", text(MATRIX[:2]), "3 x 4 or 4 x 4 numbers, got 2 x 4"),
        ("x.txt", "1 0 0 0\n0 1 0\n", "rows of different lengths"),
        ("x.txt", text(1.2 * MATRIX), "0 0 0 1 as the last row"),
        ("x.txt", text(1.2 * MATRIX[:3]), "rigid transform"),
        ("x.txt", text(MATRIX).replace("0.100000000", "nan", 1), "finite numbers, got nan"),
        ("x.txt", "hello\n", "line 1: expected numbers, got 'hello'"),
        ("x.txt", "", "3 x 4 or 4 x 4 numbers"),
        ("x.json", "{", "expected JSON"),
        ("x.json", '{"a": 1}', "got something else"),
        ("x.json", '[["a", 1]]', "got something else"),
        ("x.txt", text(np.block([[np.eye(3), np.array([[15.0], [0], [0]])]])), "are these millimetres"),
        ("x.txt", "1 0 0 -1e308\n0 1 0 0\n0 0 1 0\n", "expected a translation"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_bad_extrinsics_are_refused_in_one_line(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_transform(tmp_path / name)
    assert str(caught.value).startswith(str(tmp_path / name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        TUM.format(time=0) + "\n" + TUM.format(time=1) + "\n",
        text(MATRIX) + text(MATRIX),
        "0 0 1\n" + text(MATRIX) + "1 1 2\n" + text(MATRIX),
        2 * (" ".join(str(value) for value in MATRIX.ravel()) + "\n"),
        2 * (" ".join(str(value) for value in MATRIX[:3].ravel()) + "\n"),
    ],
)
def test_poses_are_read_in_every_format(tmp_path, content):
    (tmp_path / "poses.txt").write_text(content)
    found = read_poses(tmp_path / "poses.txt").assign(pairs("a", "b"))
    assert list(found) == ["a", "b"]
    assert found["b"] == pytest.approx(MATRIX, abs=1e-8)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "got lines of none"),
        ("1 2\n", "got lines of 2"),
        (text(MATRIX)[:-40], "expected lines of 8 numbers"),
        (TUM.format(time=0).rsplit(" ", 1)[0] + " 3\n", "pose 1: expected a quaternion of length 1"),
        (TUM.format(time=0).replace("0.1", "nan", 1) + "\n", "expected poses of finite numbers"),
        (TUM.format(time="nan") + "\n", "expected finite times"),
        (text(MATRIX) + text(np.diag([1.0, 1.0, 2.0, 1.0])), "pose 2: expected a rigid transform"),
        ("x y z\n", "line 1: expected numbers"),
    ],
)
def test_bad_poses_are_refused_in_one_line(tmp_path, content, message):
    (tmp_path / "poses.txt").write_text(content)
    with pytest.raises(ValueError, match=message) as caught:
        read_poses(tmp_path / "poses.txt")
    assert "\n" not in str(caught.value)


def write_tum(folder, *times):
    path = folder / "poses.txt"
    path.write_text("".join(f"{time} {number} 0 0 0 0 0 1\n" for number, time in enumerate(times)))
    return read_poses(path)


def test_times_in_names_get_the_nearest_pose_within_20_ms(tmp_path):
    trajectory = write_tum(tmp_path, 1305031102.00, 1305031102.03, 1305031102.06)
    found = trajectory.assign(pairs("1305031102.035", "1305031102.055", "1305031102.5"))
    assert {name: pose[0, 3] for name, pose in found.items()} == {"1305031102.035": 1, "1305031102.055": 2}


def test_numbers_in_names_get_the_pose_of_that_number(tmp_path):
    found = write_tum(tmp_path, 7, 8, 9).assign(pairs("frame_0009", "frame_0007", "frame_0011"))
    assert {name: pose[0, 3] for name, pose in found.items()} == {"frame_0009": 2, "frame_0007": 0}


@pytest.mark.parametrize("kind", ["ros 1", "ros 2", "realsense", "sens", "stray"])
def test_frames_of_recordings_get_the_pose_nearest_to_their_own_time(tmp_path, kind):
    """Of poses at 200 Hz in any order, of which those near the second frame are missing."""
    pytest.importorskip("rosbags")
    make, start, step = {
        "ros 1": (lambda: captures.ros(tmp_path / "a.bag", 1), 100, 0.033),
        "ros 2": (lambda: captures.ros(tmp_path / "a", 2), 100, 0.033),
        "realsense": (lambda: realsense.bag(tmp_path / "a.bag", realsense.Recording()), 1, 0.0333),
        "sens": (lambda: captures.sens(tmp_path / "a.sens"), 1, 0.033333),
        "stray": (lambda: captures.stray(tmp_path, video=False), 10, 1 / 60),
    }[kind]
    frames = find_pairs_of_folder(make() or tmp_path).pairs
    assert len(frames) == captures.FRAMES
    times = start - 0.1 + 0.005 * np.arange(100)
    times = times[abs(times - start - step) > 0.02] if kind != "stray" else times
    found = write_tum(tmp_path, *np.random.default_rng(0).permutation(times)).assign(frames)
    trajectory = read_poses(tmp_path / "poses.txt")
    for number, frame in enumerate(frames):
        gaps = abs(np.array(trajectory.times) - start - step * number)
        if gaps.min() > 0.02:
            assert frame.name not in found
        else:
            np.testing.assert_array_equal(found[frame.name], trajectory.poses[gaps.argmin()])
    for count in (len(frames), 2):  # times of another clock, also of as many poses as frames
        with pytest.raises(ValueError, match=rf"times as those of the frames, {start:.3f} to .*, got 5000\.500"):
            write_tum(tmp_path, *(step * number + 5000.5 for number in range(count))).assign(frames)


def write_lists(folder, times, truth=()):
    """Write lists of TUM RGB-D of pictures whose names are numbers; depth is 10 ms late."""
    for kind, late in (("rgb", 0.0), ("depth", 0.01)):
        lines = [f"{time + late} {kind}/{number:06}.png" for number, time in enumerate(times)]
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
        for number in range(len(times)):
            picture = captures.photo(number) if kind == "rgb" else captures.millimetres(number)
            captures.save(folder / kind / f"{number:06}.png", picture)
    if truth:
        (folder / "groundtruth.txt").write_text("".join(f"{time} 0 0 0 0 0 0 1\n" for time in truth))
    return find_pairs_of_folder(folder).pairs


@pytest.mark.parametrize("truth", [(), (1, 2, 3)])
def test_frames_of_tum_lists_get_the_pose_nearest_to_the_time_in_the_list(tmp_path, truth):
    frames = write_lists(tmp_path, (1, 2, 3), truth)
    found = write_tum(tmp_path, 1, 2, 3, 9).assign(frames)
    assert [found[frame.name][0, 3] for frame in frames] == [0, 1, 2]
    assert read_picture(frames[1], Reading()).time == 2
    with pytest.raises(ValueError, match="expected times as those of the frames"):
        write_tum(tmp_path, 11, 12, 13).assign(frames)


def test_first_frame_of_times_that_begin_at_0_has_one(tmp_path):
    frames = find_pairs_of_folder(captures.sens(tmp_path / "a.sens", start=0)).pairs
    found = write_tum(tmp_path, 0.066, 0.033, 0.0, 5).assign(frames)
    assert [found[frame.name][0, 3] for frame in frames] == [2, 1, 0]
    assert read_picture(frames[0], Reading()).time == 0
    frames = find_pairs_of_folder(captures.sens(tmp_path / "b.sens", start=0, step=0)).pairs
    assert [read_picture(frame, Reading()).time for frame in frames] == [None] * captures.FRAMES
    found = write_tum(tmp_path, 105, 106, 107).assign(frames)  # in order
    assert [found[frame.name][0, 3] for frame in frames] == [0, 1, 2]


def test_numbers_in_names_suit_more_frames_than_a_time_that_is_one_by_chance(tmp_path):
    frames = find_pairs_of_folder(captures.stray(tmp_path, video=False) or tmp_path).pairs  # 10.000 s, 10.017 s ...
    found = write_tum(tmp_path, 10, 0, 1, 2).assign(frames)
    assert [found[frame.name][0, 3] for frame in frames] == [1, 2, 3]


def test_poses_without_times_have_to_be_as_many_as_frames(tmp_path):
    (tmp_path / "poses.txt").write_text(text(MATRIX))
    with pytest.raises(ValueError, match="poses for 2 frames"):
        read_poses(tmp_path / "poses.txt").assign(pairs("a", "b"))

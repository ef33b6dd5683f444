"""Poses that are read wrongly are noticed by the depth maps, and nothing is said where these cannot show it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_frames import room, walk

from dsr.geometry.camera import Camera
from dsr.geometry.poses import PosedMap, check_poses, invert, sample

CAMERA = Camera.centred(64, 48, 52.0)
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
NED = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""The axes forward, right, down of a camera in its frame right, down, forward."""


def scaled(pose, factor):
    changed = pose.copy()
    changed[:3, 3] *= factor
    return changed


def turned(pose, change):
    changed = pose.copy()
    changed[:3, :3] = change(pose[:3, :3])
    return changed


def scalar_first(turn):
    """Return what x y z w is read as where w x y z is written."""
    x, y, z, w = Rotation.from_matrix(turn).as_quat()
    return Rotation.from_quat((w, x, y, z)).as_matrix()


WRONG = [
    ("from world to camera", invert),
    ("in millimetres", lambda pose: scaled(pose, 1000)),
    ("in centimetres", lambda pose: scaled(pose, 100)),
    ("10 times too small", lambda pose: scaled(pose, 0.1)),
    ("of cameras with y up and z backward", lambda pose: pose @ OPENGL),
    ("of cameras with x forward and z down", lambda pose: pose @ NED),
    ("with rotations by columns", lambda pose: turned(pose, np.transpose)),
    ("with quaternions w x y z", lambda pose: turned(pose, scalar_first)),
    ("from world to camera, in millimetres", lambda pose: scaled(invert(pose), 1000)),
    ("from world to camera, of cameras with y up and z backward", lambda pose: invert(pose @ OPENGL)),
]


def checked(
    poses,
    change=lambda pose: pose,
    depth=room,
):
    """Return what is said of poses that were changed, of maps with the noise of a sensor."""

    def load(number):
        draws = np.random.default_rng(number).standard_normal((CAMERA.height, CAMERA.width))
        return PosedMap(depth(CAMERA, poses[number]) * (1 + 0.005 * draws), CAMERA, change(poses[number]))

    return check_poses(len(poses), load)


def wall(camera, pose):
    return 2 / np.einsum("j,jhw->hw", pose[2, :3], camera.rays().numpy())


@pytest.mark.parametrize(("name", "change"), WRONG, ids=[name for name, _ in WRONG])
def test_wrong_reading_is_reported_by_its_name_with_figures(name, change):
    found = checked(walk(8), change)
    assert found.code == "poses"
    assert name in found.text.removeprefix("the poses are probably ").split(" or ")
    assert found.value > 0.25


@pytest.mark.parametrize(
    "poses",
    [walk(8), walk(2), walk(60, 0.004, 0.3), walk(8, 0.0), walk(8, 0.08, 0.0), walk(20, 0.0, 0.0), walk(1), []],
    ids=["photos", "two", "video", "rotation", "translation", "tripod", "one", "none"],
)
def test_right_poses_are_silent(poses):
    assert checked(poses) is None


@pytest.mark.parametrize(("name", "change"), WRONG, ids=[name for name, _ in WRONG])
def test_wall_along_which_the_camera_moves_shows_nothing(name, change):
    del name
    poses = [np.eye(4) for _ in range(12)]
    for number, pose in enumerate(poses):
        pose[:2, 3] = 0.03 * number, 0.01 * number
    found = checked(poses, change, wall)
    assert found is None or found.code != "poses"


def test_camera_that_hardly_moves_is_not_far_away_in_the_next_frame():
    poses = [np.eye(4) + 0.03 * number * np.eye(4, k=3) for number in range(12)]
    assert checked(poses, depth=wall) is None
    found = checked(poses, lambda pose: scaled(pose, 1000), wall)
    assert (found.code, found.value) == ("poses-far", pytest.approx(1000 * 0.03 / 2, rel=0.05))
    assert checked(poses, lambda pose: scaled(pose, 1 / 1000), wall) is None


def test_poses_that_no_reading_explains_disagree():
    poses = walk(8, 0.02, 0.5)
    rng = np.random.default_rng(3)
    strange = {id(pose): Rotation.from_rotvec(rng.normal(0, 12, 3), degrees=True).as_matrix() for pose in poses}
    found = checked(poses, lambda pose: turned(pose, lambda turn: turn @ strange[id(pose)]))
    assert found.code == "poses-disagree"


def test_frames_that_cannot_be_read_are_left_out():
    poses = walk(8)
    assert check_poses(8, lambda number: None) is None
    some = check_poses(8, lambda n: None if n == 1 else PosedMap(room(CAMERA, poses[n]), CAMERA, invert(poses[n])))
    assert some is not None


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("factor", [1e-300, 1e30, 1e307])
def test_poses_of_any_magnitude_are_compared(factor):
    found = checked(walk(4), lambda pose: scaled(pose, factor))
    assert found is None or found.code.startswith("poses")


def test_frames_are_sampled_within_the_sequence_and_few_of_a_long_one():
    for count in (0, 1, 2, 5, 31, 100_000):
        groups = sample(count)
        assert all(0 <= number < count for group in groups for number in group)
        assert sum(map(len, groups)) <= 20
        assert (len(groups) > 0) == (count > 1)

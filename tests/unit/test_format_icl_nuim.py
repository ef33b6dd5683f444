"""ICL-NUIM: known numbers in both forms of its frames, every damage refused by name, real walls flat."""

import numpy as np
import pytest
import torch
from refusals import refused
from small_files import png_by_its_specification as png
from small_files import written

from dsr.data.icl import CAMERA, find_frames, load_frame, read_depth

ROWS, COLUMNS = np.mgrid[0:480, 0:640]
DISTANCES = 100.0 + ROWS + COLUMNS / 1000  # Centimetres; not symmetric under any flip


def text(values):
    return " ".join(f"{value:.6g}" for value in np.ravel(values)).encode() + b" "


def refusal(path, capfd):
    message = refused(lambda: read_depth(path), path, capfd)
    assert message.startswith("expected ")
    return message


@pytest.fixture(scope="module")
def distances():
    return text(DISTANCES)


def test_distances_in_centimetres_along_the_rays_become_orthogonal_metres(tmp_path, distances):
    depth = read_depth(written(tmp_path / "scene_00_0000.depth", distances))
    assert depth.shape == (1, 480, 640)
    assert depth.dtype == torch.float64
    ray = np.hypot(1, np.hypot((600 - 319.5) / 481.2, (100 - 239.5) / 480))
    assert depth[0, 100, 600].item() == pytest.approx((100 + 100 + 0.6) / 100 / ray, rel=1e-5)
    assert depth[0, 239, 320].item() == pytest.approx(3.3932, rel=1e-5)  # the ray of the centre: no conversion


def test_ray_of_length_0_or_beyond_the_rooms_is_a_hole(tmp_path):
    values = DISTANCES.copy()
    values[0, :3] = 0, 10001, np.inf
    depth = read_depth(written(tmp_path / "a.depth", text(values)))
    assert depth.isnan().nonzero().tolist() == [[0, 0, 0], [0, 0, 1], [0, 0, 2]]


def test_depth_picture_has_5000_levels_a_metre_and_0_is_a_hole(tmp_path):
    levels = 1 + ROWS * 100 + COLUMNS
    levels[3, 7] = 0
    depth = read_depth(written(tmp_path / "0.png", png(levels)))
    assert depth[0, 2, 9].item() == 210 / 5000
    assert depth.isnan().nonzero().tolist() == [[0, 3, 7]]


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: b"", lambda whole: b" \n ", lambda whole: whole[: len(whole) // 2],
        lambda whole: whole.rpartition(b" ")[0].rpartition(b" ")[0], lambda whole: whole + b"1.0",
        lambda whole: whole + b"1.0 " * 5_000_000, lambda whole: b"-1" + whole[3:], lambda whole: b"nan" + whole[3:],
        lambda whole: b"1_0" + whole[3:], lambda whole: b"1.2.3" + whole[3:], lambda whole: b"<html>" + whole[6:],
        lambda whole: bytes(1000), lambda whole: b"0 " * 307200, lambda whole: b"1e30 " * 307200,
    ],
)  # fmt: skip
def test_damaged_text_of_distances_is_refused_in_one_line(tmp_path, capfd, distances, damage):
    refusal(written(tmp_path / "scene_00_0000.depth", damage(distances)), capfd)


def test_16_bit_picture_keeps_its_values(tmp_path):
    colours = np.zeros((480, 640, 3))
    colours[5, 6] = 65535, 257, 1
    rgb = written(tmp_path / "scene_00_0000.png", png(colours, colour=2))
    depth = written(tmp_path / "d.png", png(np.full((480, 640), 5000)))
    scene = load_frame(rgb, depth, "icl_nuim", "a/0000")
    assert (scene.dataset, scene.name, scene.camera) == ("icl_nuim", "a/0000", CAMERA)
    torch.testing.assert_close(scene.rgb[:, 5, 6], torch.tensor([1, 257 / 65535, 1 / 65535]))


def test_frames_of_all_three_layouts_are_listed_by_folder_and_number(tmp_path, monkeypatch):
    for name in ("b/rgb/0.png", "b/depth/0.png", "b/rgb/10.png", "b/depth/10.png", "b/rgb/2.png", "b/depth/2.png",
                 "b/rgb/3.png", "b/associations.txt", "a/scene_00_0001.png", "a/scene_00_0001.depth",
                 "a/scene_00_0002.depth", "c/d/rgb.png", "c/d/depth.png", ".trash/rgb.png", ".trash/depth.png",
                 "b/rgb/thumbnail.png", "b/depth/thumbnail.png"):  # fmt: skip
        written(tmp_path / "icl" / name, b"")
    monkeypatch.chdir(tmp_path)
    for root in (tmp_path / "icl", (tmp_path / "icl").relative_to(tmp_path)):
        found = find_frames(root)
        assert list(found) == ["a/0001", "b/0000", "b/0002", "b/0010", "c/d"]
        assert found["b/0010"] == (root / "b/rgb/10.png", root / "b/depth/10.png")
        assert found["a/0001"] == (root / "a/scene_00_0001.png", root / "a/scene_00_0001.depth")
    assert list(find_frames(tmp_path / "icl/c/d")) == ["d"]


def test_office_ceiling_is_flat_in_orthogonal_depth(shared):
    frames = find_frames(shared / "real/icl_nuim")
    assert list(frames) == ["living", "office/0000"]
    scene = load_frame(*frames["office/0000"], "icl_nuim", "office/0000")
    orthogonal = scene.depth[0, :120, :560]
    along = orthogonal * scene.camera.ray_lengths()[:120, :560]

    def bend(depth):
        """Return how far the depth lies from a plane, 1/z = a u + b v + c, in metres (root mean square)."""
        known = torch.ones_like(depth).nonzero().double()
        system = torch.column_stack((known, torch.ones(len(known))))
        plane = torch.linalg.lstsq(system, depth.reciprocal().reshape(-1, 1)).solution
        return ((system @ plane).reciprocal()[:, 0] - depth.reshape(-1)).square().mean().sqrt().item()

    assert bend(orthogonal) < 0.01
    assert bend(along) > 5 * bend(orthogonal)


def test_living_room_has_the_size_of_a_room(shared):
    folder = shared / "real/icl_nuim/living"
    scene = load_frame(folder / "rgb.png", folder / "depth.png", "icl_nuim", "living")
    assert (scene.depth.min().item(), scene.depth.max().item()) == (1.641, 3.43)

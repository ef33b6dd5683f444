"""Pictures of scenes: contact sheets with a row for each, and that of a result, whatever is unknown of it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.geometry.camera import Camera
from dsr.metrics.catalogue import KNOWN_FORMATS
from dsr.pictures.panels import save_picture
from dsr.pictures.sheets import save_contact_sheet
from dsr.sample import Scene

pytestmark = pytest.mark.slow  # drawing takes a second

PHOTO = (0.2, 0.4, 0.6)
PINK = (214, 132, 180)
KNOWN = (228, 228, 228)
WIDTH = 1355  # Pixels: 0.15 inches of margin, 2.6 of text, four panels of 2.56 and 0.14 between them, at 100 dpi
PAGE = 6


def toy_scene(height=32, width=32, name="toy", **changes):
    camera = Camera(width, height, width / 2, height / 2, (width - 1) / 2, (height - 1) / 2)
    rgb = torch.tensor(PHOTO).view(3, 1, 1).expand(3, height, width).clone()
    depth = torch.full((1, height, width), 2.0)
    return Scene(**{"dataset": "set", "name": name, "rgb": rgb, "camera": camera, "depth": depth, **changes})


def drawn(folder, *scenes, title="Toys"):
    """Draw one page and return its pixels, (H, W, 3) red, green, blue."""
    path = folder / "sheets" / "toys.png"
    assert save_contact_sheet(path, scenes, title) == [path]
    assert [file.name for file in path.parent.iterdir()] == ["toys.png"]
    return cv2.imread(str(path))[..., ::-1]


def panel(page, column, row=0):
    """Return the pixels of a square panel of a page of square scenes, a few from its border left out."""
    top, left = 80 + row * 306, 275 + column * 270
    return page[top + 4 : top + 252, left + 4 : left + 252]


@pytest.fixture
def written(monkeypatch):
    """All that is written on pages, but for what belongs to a panel."""
    texts, original = [], Figure.text

    def text(self, x, y, content, **settings):
        texts.append(content)
        return original(self, x, y, content, **settings)

    monkeypatch.setattr(Figure, "text", text)
    return texts


def test_row_shows_photo_depth_holes_and_renderings(tmp_path):
    scene = toy_scene()
    scene.depth[0, :16, 16:] = torch.nan
    page = drawn(tmp_path, scene)
    assert page.shape == (80 + 306, WIDTH, 3)
    assert (panel(page, 0) == (51, 102, 153)).all()
    depth, holes, lights = (panel(page, column) for column in (1, 2, 3))
    assert (depth[:116, 132:] == PINK).all()
    assert (depth[132:] == (68, 1, 84)).all()  # the nearest in viridis
    assert (holes[:116, 132:] == PINK).all()
    assert (holes[132:] == KNOWN).all()
    frontal = lights[-40:, -100:]  # e4, right below; the wall faces it
    assert (frontal == 255).all()
    slanted = lights[80:100, 40:60]  # e1: e . n is 1 / sqrt 3
    assert np.abs(slanted.astype(int) - round(255 / 3**0.5)).max() <= 1


def test_scene_without_high_resolution_depth_shows_its_lowest_measured_map(tmp_path, written):
    coarse = torch.full((1, 4, 4), 3.0)
    coarse[0, :2] = torch.nan
    page = drawn(tmp_path, toy_scene(depth=None, measured={2: torch.ones(1, 16, 16), 8: coarse}))
    assert (panel(page, 2)[:116] == PINK).all()
    assert (panel(page, 2)[132:] == KNOWN).all()
    assert any(
        "measured: x2, x8; no high-resolution depth\nshown: x8, 4 x 4\ndepth 3 to 3 m\nholes: 50 %" in t
        for t in written
    )


def test_many_scenes_make_numbered_pages_and_are_loaded_one_at_a_time(tmp_path, written):
    def scenes():
        for number in range(PAGE + 2):
            assert (tmp_path / "toys-1.png").is_file() == (number > PAGE)
            yield toy_scene(8, 8, f"scene {number}")

    assert save_contact_sheet(tmp_path / "toys.png", scenes(), "Toys") == sorted(tmp_path.iterdir())
    assert [text for text in written if text.startswith("scene ")] == [f"scene {n}" for n in range(PAGE + 2)]


# The picture of a result


@pytest.mark.parametrize("case", ["without truth", "with holes", "of holes alone", "of holes alone, without truth"])
def test_picture_of_a_result_is_drawn_whatever_is_unknown(tmp_path, case):
    sample = make_sample(toy_scene(), 4, Downsampling("box"), "orthogonal")
    sample = replace(sample, depth=None) if "without" in case else sample
    depth = torch.full((1, 32, 32), torch.nan if "alone" in case else 2.0)
    if case == "with holes":
        depth[0, :10], sample.depth[0, 5:20, :9], sample.depth_lr[0, 0] = torch.nan, torch.nan, torch.nan
    scores = {"RMSE_d": float("nan") if "alone" in case else 0.07, "DSSIM_v": 0.3}
    save_picture(tmp_path / "pictures" / "scene.png", sample, depth, scores, "Toy", KNOWN_FORMATS)
    [path] = (tmp_path / "pictures").iterdir()
    height, width = cv2.imread(str(path)).shape[:2]
    rows = 2 if sample.depth is None else 3
    assert width == 2656  # five panels of 3.2 inches and 0.6 inches of margin at 160 dpi
    assert height == pytest.approx(160 * (0.8 + rows * (3.2 + 0.95)), abs=1)

"""The page of `dsr view` in a browser: it draws, turns, lights and compares what it should, and asks nobody."""

import re

import cv2
import numpy as np
import pytest
import torch
from small_results import CAMERA, HOLE, SIZE, waves, write_result

from dsr.cli import main
from dsr.geometry.mesh import triangulate
from dsr.geometry.surface import render_for_viewing
from dsr.pictures.depth_views import normals_seen_by

SPITEFUL = "<img src=x onerror=alert(1)>'&"


@pytest.fixture(scope="module")
def page_of_one(tmp_path_factory):
    folder = write_result(tmp_path_factory.mktemp("view") / "room")
    assert main(["view", str(folder), "--no-open"]) == 0
    return (folder / "view.html").as_uri()


@pytest.fixture(scope="module")
def page_of_two(tmp_path_factory):
    folder = tmp_path_factory.mktemp("views")
    write_result(folder / SPITEFUL, assumptions=[SPITEFUL], method=SPITEFUL)
    write_result(folder / "b", waves(hole=False), with_input=False, with_errors=False)
    assert main(["view", str(folder), "--no-open"]) == 0
    return (folder / "view.html").as_uri()


def opened(window, url):
    """Open a page; its stage is about as wide as it is high."""
    shown = window(viewport={"width": 900, "height": 900})
    shown.page.goto(url)
    shown.page.wait_for_selector(".stage[data-shown]")
    return shown


def seen(shown, *keys):
    """Press keys, and return the stage as it is on the screen, (h, w, 3), without what lies upon the surface."""
    shown.press(*keys)
    shown.settle()
    shown.page.evaluate("document.querySelector('#stage').style.outline = 'none'")
    for selector in (".divider", ".name", ".zoom"):
        shown.page.evaluate("(s) => document.querySelectorAll(s).forEach((e) => e.style.opacity = 0)", selector)
    content = shown.page.locator("#stage").screenshot()
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)


def label(shown):
    shown.settle()
    return shown.page.locator("#stage canvas").get_attribute("aria-label")


def at(picture, u, v, size=SIZE):
    """Return the colour at the middle of a pixel of the photo, which fills the height of the stage."""
    height, width = picture.shape[:2]
    scale = min(height, width) / size
    x = (width - scale * size) / 2 + scale * (np.asarray(u) + 0.5)
    y = (height - scale * size) / 2 + scale * (np.asarray(v) + 0.5)
    return picture[np.asarray(y).astype(int), np.asarray(x).astype(int)]


def magma(level):
    bgr = cv2.applyColorMap(np.uint8([[level]]), cv2.COLORMAP_MAGMA)[0, 0]
    return bgr[::-1].astype(int)


def test_surface_is_the_results_own_in_every_light_and_from_every_side(window, page_of_one):
    """One visit: rendering, holes, before and after, the mesh, light, turning and zoom."""
    shown = opened(window, page_of_one)
    picture = first = seen(shown, "3", "g")
    normals = normals_seen_by(CAMERA, torch.from_numpy(waves())[None].double())
    expected = 255 * render_for_viewing(normals)[0, 0].numpy()
    v, u = np.mgrid[6:36:3, 6:36:3]
    found = at(picture, u, v)
    assert np.ptp(expected[v, u]) > 30
    assert np.abs(found - expected[v, u][..., None]).mean() < 3  # normals of vertices, of pixels

    picture = seen(shown, "p")
    beside = picture[picture.shape[0] // 2, 5]
    assert np.abs(at(picture, 15.5, 45.5) - beside).max() < 40
    assert at(picture, 12, 30)[0] > 120  # the photo is red there
    rows, columns = np.mgrid[HOLE[0].start + 1 : HOLE[0].stop - 1, HOLE[1].start + 1 : HOLE[1].stop - 1]
    assert at(picture, columns, rows).max() < 90
    shown.press("g")

    before, both, after = (seen(shown, key) for key in "123")
    half = after.shape[1] // 2
    assert np.abs(before - after).mean() > 1
    assert np.abs(both[:, : half - 20] - before[:, : half - 20]).max() <= 1
    assert np.abs(both[:, half + 20 :] - after[:, half + 20 :]).max() <= 1

    depth = torch.from_numpy(waves())[None].double()
    certain = depth.masked_fill(torch.from_numpy(errors()) > 0.02 * depth, torch.nan)
    for each in (certain, depth):
        count = f"{len(triangulate(each, CAMERA).faces):,} triangles"
        assert f"After: 4,096 vertices (64 \u00d7 64, 4.7 % holes), {count}" in shown.page.inner_text(".amounts")
        shown.page.locator(".doubtful input").check()
    shown.page.locator(".doubtful input").uncheck()

    ball = shown.page.locator(".ball").bounding_box()
    shown.page.mouse.click(ball["x"] + 0.9 * ball["width"], ball["y"] + 0.5 * ball["height"])
    lit = seen(shown)
    assert np.abs(lit - first).mean() > 1.5
    shown.page.locator("#stage").focus()
    for keys in (["ArrowLeft"] * 4, ["Shift+ArrowRight"] * 4, ["+"] * 3):
        assert np.abs(seen(shown, *keys) - lit).mean() > 2
        shown.press("0")
    stage, mouse = shown.page.locator("#stage").bounding_box(), shown.page.mouse
    mouse.move(stage["x"] + 0.4 * stage["width"], stage["y"] + 0.5 * stage["height"])
    mouse.down()
    mouse.move(stage["x"] + 0.6 * stage["width"], stage["y"] + 0.5 * stage["height"], steps=3)
    mouse.up()
    assert np.abs(seen(shown) - lit).mean() > 5
    assert re.search(r"turned \d+\u00b0 to the right", label(shown))


def errors():
    """Return the expected errors of the depth of a result, (1, SIZE, SIZE) in metres."""
    return np.tile((0.002 * 30 ** np.linspace(0, 1, SIZE)).astype(np.float32), (1, SIZE, 1))


def test_errors_have_the_colours_of_the_legend(window, page_of_one):
    shown = opened(window, page_of_one)
    picture = seen(shown, "3", "d")
    middle = float(np.nanmedian(waves()))
    columns = np.array([4, 16, 28])  # beyond, the error is larger than the mesh allows
    for u in columns:
        level = 1 + 254 * np.log(errors()[0, 0, u] / (1e-3 * middle)) / np.log(100)
        assert np.abs(at(picture, u, 20) - magma(round(max(level, 1)))).max() < 8
    assert shown.page.locator(".scale-title").inner_text() == "Expected error of the depth, mm"
    ticks = shown.page.locator(".ticks span").all_inner_texts()
    low, high = (f"{float(f'{value:.2g}'):g}" for value in (middle, 100 * middle))
    assert (ticks[0], ticks[-1]) == (f"\u2264 {low}", f"\u2265 {high}")
    assert "10" in ticks
    shown.press("n")
    assert shown.page.locator(".scale-title").inner_text() == "Expected error of the normal, degrees"
    ticks = shown.page.locator(".ticks span").all_inner_texts()
    assert ticks == ["\u2264 1", "2", "5", "10", "20", "\u2265 60"]
    assert np.abs(seen(shown) - picture).mean() > 3
    shown.press("g")
    assert shown.page.locator(".scale").is_hidden()


def test_results_are_chosen_by_list_strip_and_keys_and_names_are_text(window, page_of_two):
    shown = opened(window, page_of_two)
    page = shown.page
    assert page.locator("#result option").all_inner_texts() == [SPITEFUL, "b"]
    assert page.locator(".facts dd").first.inner_text() == f"{SPITEFUL} x4"
    assert SPITEFUL in label(shown)
    page.locator(".strip button").nth(1).click()
    page.wait_for_selector(".stage[data-shown='1']")
    assert page.locator(".sides").is_hidden()
    assert page.locator("[data-colour=depth]").is_hidden()
    assert "After: 4,096 vertices (64 \u00d7 64)" in page.locator(".amounts").inner_text()
    assert page.url.endswith("#b")
    shown.press(".")
    page.wait_for_selector(".stage[data-shown='0']")
    assert page.locator(".sides").is_visible()
    page.locator("#result").select_option("1")
    page.wait_for_selector(".stage[data-shown='1']")
    page.reload()
    page.wait_for_selector(".stage[data-shown='1']")


def test_browser_without_webgl_shows_pictures_and_says_why(window, page_of_two):
    shown = window()
    shown.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    shown.page.goto(page_of_two)
    alert = shown.page.locator("[role=alert]")
    assert "cannot be turned in this browser (no WebGL 2)" in alert.inner_text()
    assert shown.page.locator("#viewer").is_hidden()
    pictures = shown.page.locator("#stills img")
    assert pictures.count() == 3  # before and after, and after alone
    assert pictures.evaluate_all("(all) => all.every((e) => e.complete && e.naturalWidth > 0)")
    assert pictures.first.get_attribute("alt") == (
        f"{SPITEFUL}, before: the depth map as it came, as a grey surface lit from the upper left; holes are pink"
    )
    assert shown.page.locator("#stills h2").all_inner_texts() == [SPITEFUL, "b"]

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
DESKTOP = {"width": 900, "height": 900}


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


class Window:
    """A page, and what it said or asked for that it should not have."""

    def __init__(self, browser, **options):
        self.context = browser.new_context(**({"viewport": DESKTOP} | options))
        self.page, self.wrong = self.context.new_page(), []
        self.page.on("console", lambda message: self.wrong.append(message.text))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("dialog", lambda dialog: (self.wrong.append(dialog.message), dialog.dismiss()))
        self.page.on("request", lambda request: None if harmless(request.url) else self.wrong.append(request.url))

    def open(self, url):
        self.page.goto(url)
        self.page.wait_for_selector(".stage[data-shown]")
        return self

    def press(self, *keys):
        for key in keys:
            self.page.keyboard.press(key)
        return self

    def seen(self, hide=(".divider", ".name", ".zoom")):
        """Return the stage as it is on the screen, (h, w, 3), without what lies upon the surface."""
        self.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        self.page.evaluate("document.querySelector('#stage').style.outline = 'none'")
        for selector in hide:
            self.page.evaluate("(s) => document.querySelectorAll(s).forEach((e) => e.style.opacity = 0)", selector)
        content = self.page.locator("#stage").screenshot()
        return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)

    def drag(self, start, end, button="left"):
        """Drag from one place of the stage to another, both as fractions of it."""
        box = self.page.locator("#stage").bounding_box()
        place = lambda part: (box["x"] + part[0] * box["width"], box["y"] + part[1] * box["height"])  # noqa: E731
        mouse = self.page.mouse
        mouse.move(*place(start))
        mouse.down(button=button)
        mouse.move(*place(end), steps=3)
        mouse.up(button=button)
        return self

    def label(self):
        self.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        return self.page.locator("#stage canvas").get_attribute("aria-label")


def harmless(url):
    return url.startswith(("data:", "blob:", "about:")) or (url.startswith("file:") and ".html" in url)


@pytest.fixture
def window(webgl_browser):
    """Return what makes a window; errors and requests of its page fail the test at its end."""
    windows = []

    def make(**options):
        windows.append(Window(webgl_browser, **options))
        return windows[-1]

    yield make
    for each in windows:
        each.context.close()
        assert each.wrong == []


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
    shown = window().open(page_of_one)
    picture = first = shown.press("3", "g").seen()
    normals = normals_seen_by(CAMERA, torch.from_numpy(waves())[None].double())
    expected = 255 * render_for_viewing(normals)[0, 0].numpy()
    v, u = np.mgrid[6:36:3, 6:36:3]
    found = at(picture, u, v)
    assert np.ptp(expected[v, u]) > 30
    assert np.abs(found - expected[v, u][..., None]).mean() < 3  # normals of vertices, of pixels

    picture = shown.press("p").seen()
    beside = picture[picture.shape[0] // 2, 5]
    assert np.abs(at(picture, 15.5, 45.5) - beside).max() < 40
    assert at(picture, 12, 30)[0] > 120  # the photo is red there
    rows, columns = np.mgrid[HOLE[0].start + 1 : HOLE[0].stop - 1, HOLE[1].start + 1 : HOLE[1].stop - 1]
    assert at(picture, columns, rows).max() < 90
    shown.press("g")

    before, both, after = (shown.press(key).seen() for key in "123")
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
    lit = shown.seen()
    assert np.abs(lit - first).mean() > 1.5
    shown.page.locator("#stage").focus()
    for keys in (["ArrowLeft"] * 4, ["Shift+ArrowRight"] * 4, ["+"] * 3):
        assert np.abs(shown.press(*keys).seen() - lit).mean() > 2
        shown.press("0")
    assert np.abs(shown.drag((0.4, 0.5), (0.6, 0.5)).seen() - lit).mean() > 5
    assert re.search(r"turned \d+\u00b0 to the right", shown.label())


def errors():
    """Return the expected errors of the depth of a result, (1, SIZE, SIZE) in metres."""
    return np.tile((0.002 * 30 ** np.linspace(0, 1, SIZE)).astype(np.float32), (1, SIZE, 1))


def test_errors_have_the_colours_of_the_legend(window, page_of_one):
    shown = window().open(page_of_one)
    picture = shown.press("3", "d").seen()
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
    assert np.abs(shown.seen() - picture).mean() > 3
    shown.press("g")
    assert shown.page.locator(".scale").is_hidden()


def test_results_are_chosen_by_list_strip_and_keys_and_names_are_text(window, page_of_two):
    shown = window().open(page_of_two)
    page = shown.page
    assert page.locator("#result option").all_inner_texts() == [SPITEFUL, "b"]
    assert page.locator(".facts dd").first.inner_text() == f"{SPITEFUL} x4"
    assert SPITEFUL in shown.label()
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


def test_browser_without_webgl_shows_pictures_and_says_why(browser, page_of_two):
    shown = Window(browser)
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
    shown.context.close()
    assert shown.wrong == []

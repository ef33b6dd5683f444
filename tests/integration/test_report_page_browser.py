"""The page of a report in a browser: it sorts, lights, compares and reads out what it should, and asks nobody."""

import base64

import cv2
import matplotlib as mpl
import numpy as np
import pytest
from small_runs import hostile_run

from dsr.evaluation.run_files import load_results
from dsr.geometry.surface import render
from dsr.pictures.depth_views import normals_seen_by
from dsr.report.page import Pictures, save_page
from dsr.report.table_layouts import write_tables
from dsr.report.worker_pool import WorkerPool

SPITEFUL = "<img src=x onerror=alert(1)>\"'&</script><script>alert(2)</script>"
SIZE = 64
SCENES = ("cube_no_texture", "statue")


@pytest.fixture
def opened(window):
    """Return what opens a page whose stage is drawn."""
    shown = window(has_touch=True, reduced_motion="reduce")

    def open_page(url):
        shown.page.goto("about:blank")
        shown.page.goto(url)
        shown.page.wait_for_selector(".stage[data-shown]")
        shown.page.evaluate("document.querySelector('#scenes').scrollIntoView()")
        shown.settle()
        return shown

    return open_page


def pixels(page, selector):
    """Return a canvas's pixels, (H, W, 3)."""
    url = page.evaluate("(selector) => document.querySelector(selector).toDataURL()", selector)
    content = np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8)
    return cv2.imdecode(content, cv2.IMREAD_COLOR)[..., ::-1]


def run_of(results, label):
    return next(run for run in results.runs if run.label == label and run.scale == 4)


def depth_of(results, label, scene=SCENES[0]):
    run = run_of(results, "Bicubic" if label == "truth" else label)
    return run.sample(scene).depth if label == "truth" else run.prediction(scene)


def normals(results, label, scene=SCENES[0]):
    return normals_seen_by(run_of(results, "Bicubic").sample(scene).camera, depth_of(results, label, scene))


def rendering(results, label, light):
    """Return a rendering as grey levels, (H, W)."""
    return 255 * render(normals(results, label))[0, light].numpy()


def choose(shown, side, label):
    shown.page.locator(f"#scenes select.{side}").select_option(label=label)
    shown.settle()


def test_reader_lights_compares_reads_out_sorts_and_follows_a_link(opened, make_run, tmp_path):
    """One visit: renderings, the divider, the errors under the pointer, and a table that sorts and leads back."""
    for label in ("Bicubic", "MSG-V"):
        make_run(tmp_path / label, method=label.lower(), label=label, scenes=SCENES, size=SIZE)
    make_run(tmp_path / "x8", scale=8, scenes=SCENES[:1], size=SIZE)
    results = load_results([tmp_path])
    save_page(tmp_path / "index.html", Pictures(WorkerPool(results)), title="A report")
    shown = opened((tmp_path / "index.html").as_uri())
    page = shown.page
    choose(shown, "left", "MSG-V")
    page.locator(".stage").focus()
    for light in (1, 0, 3, 2):
        page.keyboard.press(str(light + 1)) if light % 2 else page.click(f"[data-light=e{light + 1}]")
        shown.settle()
        for side, label in (("left", "MSG-V"), ("right", "truth")):
            drawn = pixels(page, f".pane-{side} canvas").astype(float)
            assert drawn.shape == (SIZE, SIZE, 3)
            assert np.abs(drawn[..., 0] - rendering(results, label, light)).max() <= (1.51 if light < 3 else 2.3)
            assert (drawn == drawn[..., :1]).all()

    divider = page.locator(".divider")
    divider.focus()
    for key, expected in (("ArrowLeft", "49"), ("Shift+ArrowRight", "59"), ("Home", "0")):
        page.keyboard.press(key)
        assert divider.get_attribute("aria-valuenow") == expected

    page.hover(".strip button:has-text('MSG-V')")
    assert page.inner_text(".errors-heading") == "Errors of MSG-V"
    canvas = page.locator(".depth-error > canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    error = (depth_of(results, "MSG-V") - depth_of(results, "truth"))[0].numpy()
    row, across = 20, 33
    page.mouse.move(box["x"] + (across + 0.5) * box["width"] / SIZE, box["y"] + (row + 0.5) * box["height"] / SIZE)
    text = page.inner_text(".error-readout").replace("\N{MINUS SIGN}", "-")
    value, unit = text.split("error ")[1].split(",")[0].split()
    metres = float(value) / {"cm": 100, "mm": 1000}[unit]
    assert metres == pytest.approx(error[row, across], abs=0.02 * np.abs(error).max())
    mine, truth = (normals(results, label)[0, :, row, across] for label in ("MSG-V", "truth"))
    degrees = np.degrees(np.arccos(float((mine * truth).sum())))
    assert float(text.split("off by ")[1].split("\N{DEGREE SIGN}")[0]) == pytest.approx(degrees, abs=0.6)

    heading = page.locator("#tables table").first.locator("th").nth(1)
    heading.click()
    cells = page.locator("#tables table").first.locator("tbody tr td:nth-child(2)").all_inner_texts()
    assert [float(cell) for cell in cells] == sorted(map(float, cells))
    assert heading.get_attribute("aria-sort") == "ascending"

    page.evaluate("document.querySelectorAll('#tables details').forEach((each) => { each.open = true; })")
    page.locator("#tables .go:has-text('statue')").last.click()
    page.wait_for_selector(".stage[data-shown=s1]")
    again = opened(page.url).page
    again.wait_for_selector(".stage[data-shown=s1]")
    assert again.inner_text(".name-left") == "MSG-V"


def test_expected_errors_have_the_colours_and_limits_of_the_measured_ones(opened, make_run, tmp_path):
    make_run(tmp_path / "plain", size=SIZE)
    make_run(tmp_path / "sure", method="sure", label="Sure", size=SIZE, confident=True)
    results = load_results([tmp_path])
    save_page(tmp_path / "index.html", Pictures(WorkerPool(results)))
    shown = opened((tmp_path / "index.html").as_uri())
    page = shown.page
    choose(shown, "left", "Sure")
    run = run_of(results, "Sure")
    errors = [each[0].double().numpy() for each in run.expected_errors(SCENES[0])]
    measured = [np.abs((each.prediction(SCENES[0]) - each.sample(SCENES[0]).depth).numpy()) for each in results.runs]
    limit = np.median([np.percentile(each, 98) for each in measured])
    scaled = {"expectedError": (errors[0] / limit + 1) / 2, "expectedAngle": errors[1] / 60}
    for view, colours in (("expectedError", "RdBu_r"), ("expectedAngle", "magma")):
        page.click(f"[data-view={view}]")
        shown.settle()
        expected = 255 * mpl.colormaps[colours](scaled[view])[..., :3]
        assert np.abs(pixels(page, ".pane-left canvas") - expected).max() <= 6
        truth = pixels(page, ".pane-right canvas")
        assert (truth == truth[0, 0]).all()
        assert page.locator(".pane .silent").all_inner_texts() == ["", ""]
        assert "expected error" in page.inner_text(".stage-scale")
    page.click("[data-view=expectedError]")
    end = page.inner_text(".stage-scale").split("≥")[1]
    page.click("[data-view=error]")
    assert page.inner_text(".stage-scale").split("≥")[1].replace("+", "") == end


def test_names_in_the_files_of_a_run_are_shown_and_not_run(opened, make_run, tmp_path):
    folder, name = hostile_run(make_run, tmp_path / "run", SPITEFUL), SPITEFUL.replace("/", "")
    results = load_results([folder])
    write_tables(tmp_path / "tables", results)
    save_page(tmp_path / "index.html", Pictures(WorkerPool(results)))
    page = opened((tmp_path / "index.html").as_uri()).page
    assert SPITEFUL in page.inner_text("#tables")
    assert name in page.inner_text("body")
    assert page.locator("img").count() == 0

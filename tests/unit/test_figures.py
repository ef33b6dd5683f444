"""Figures: every scene and method has its panel, colours are comparable, and the PDF's text is text."""

import re
import shutil
import subprocess

import numpy as np
import pytest

from dsr.evaluation.run_files import load_results
from dsr.geometry.surface import lights
from dsr.pictures import canvas, lights_figure
from dsr.pictures.depth_views import Window, strongest_window
from dsr.report import figures as figures_of_runs
from dsr.report.figures import Figures, details_of, draw_page, pages_of
from dsr.report.worker_pool import WorkerPool

pytestmark = pytest.mark.slow  # drawing takes a second


def save_grids(folder, results, *kinds, light="e1", notes=None):
    notes = [] if notes is None else notes
    for page in pages_of(results, kinds, light):
        notes += draw_page(folder, results, page)[1]


@pytest.fixture
def results(tmp_path, make_run):
    """Two methods on two scenes, and one that has the first scene alone."""
    make_run(tmp_path / "runs" / "a", scenes=("one", "two"), size=24)
    make_run(tmp_path / "runs" / "b", method="msg_v", label="MSG-V", scenes=("one", "two"), size=24)
    make_run(tmp_path / "runs" / "c", method="dip", label="DIP", scenes=("one",), size=24)
    return load_results([tmp_path / "runs"])


@pytest.fixture
def drawn(monkeypatch):
    """What would have been written, by name."""
    figures = {}
    for module in (figures_of_runs, lights_figure):
        monkeypatch.setattr(module, "save_both", lambda _, name, figure: [figures.setdefault(name, figure)])
    return figures


def panels(figure, row, kind="panel"):
    """Return the pictures of a row, from left to right."""
    return [image for image in figure.axes[0].images if image.get_label() == f"{row}: {kind}"]


def empty_panels(figure, row):
    return [frame for frame in figure.axes[0].patches if frame.get_label() == f"{row}: panel"]


def texts(figure):
    return [text.get_text() for text in figure.texts] + [text.get_text() for axes in figure.axes for text in axes.texts]


def change(path, **arrays):
    """Replace arrays of an archive."""
    with np.load(path) as file:
        content = dict(file)
    np.savez(path, **{**content, **arrays})


def test_figures_are_written_as_pdf_and_png(tmp_path, results, monkeypatch):
    monkeypatch.setattr(canvas, "_DPI", 60)  # for speed
    reported = []
    paths = Figures(tmp_path / "new", WorkerPool(results)).save(lambda *progress: reported.append(progress))
    names = ["renderings_simgeo_x4_box_1", "depth_simgeo_x4_box_1", "errors_simgeo_x4_box_1", "lights"]
    assert [path.name for path in paths] == [f"{name}.{kind}" for name in names for kind in ("pdf", "png")]
    assert sorted(tmp_path.joinpath("new").iterdir()) == sorted(paths)
    assert reported == [(number, 4, name) for number, name in enumerate(names)]
    pdf = paths[0].read_bytes()
    assert b"/CIDFontType2" in pdf  # TrueType, which keeps text selectable, and not outlines
    assert b"/Type3" not in pdf
    widths = {int(width) for width in re.findall(rb"/Width (\d+)", pdf)}
    assert 24 in widths  # pictures with their own pixels
    assert max(widths) == 24
    if shutil.which("pdftotext"):
        text = subprocess.run(["pdftotext", str(paths[0]), "-"], capture_output=True, text=True, check=True).stdout
        assert {"Bicubic", "MSG-V", "DIP", "photo", "input", "truth", "one", "two"} <= set(text.split())


def test_columns_are_photo_input_methods_in_the_papers_order_and_truth(results, drawn, tmp_path):
    save_grids(tmp_path, results, "renderings")
    [figure] = drawn.values()
    headings = ["photo", "input", "Bicubic", "DIP", "MSG-V", "truth"]
    assert [text for text in texts(figure) if text in headings] == headings
    assert len(panels(figure, "one")) == len(panels(figure, "two") + empty_panels(figure, "two")) == 6


@pytest.mark.parametrize(("error", "unit", "factor"), [(0.003, "mm", 1e3), (0.3, "cm", 1e2)])
def test_errors_are_centred_at_zero_and_signed(tmp_path, make_run, drawn, error, unit, factor):
    for name, sign in (("a", 1), ("b", -1)):
        run = make_run(tmp_path / name, method=name, label=name, size=16, scenes=("one",))
        scene = load_results([run]).runs[0].sample("one")
        change(run / "predictions" / "one.npz", depth=(scene.depth + sign * error)[0].numpy())
    save_grids(tmp_path, load_results([tmp_path]), "errors")
    [figure] = drawn.values()
    photo, *both = panels(figure, "one")
    assert photo.get_array().ndim == 3
    for image, sign in zip(both, (1, -1), strict=True):
        low, high = image.get_clim()
        assert -low == high == pytest.approx(factor * error, rel=1e-3)
        np.testing.assert_allclose(image.get_array(), sign * factor * error, rtol=1e-3)
    red, _, blue = both[0].cmap(1.0)[:3]
    assert red > 2 * blue
    [bar] = [axes for axes in figure.axes if axes.get_label() == "one: bar"]
    assert bar.get_ylabel() == f"result - truth, {unit}"


def test_details_are_where_the_results_differ_most_from_the_truth():
    truth = np.full((40, 60), 0.5)
    results = [truth.copy(), truth.copy()]
    results[0][8:16, 40:48] = 1.0
    results[1][8:16, 40:48] = 0.1
    results[0][24:32, 4:12] = 0.8  # the second most
    results[1][0, 0] = np.nan
    first, second = details_of(results, truth, 4)
    assert first == Window(8, 40, 8, 8)
    assert second == Window(24, 4, 8, 8)


@pytest.mark.parametrize("seed", range(4))
def test_strongest_window_equals_an_exhaustive_search(seed):
    values = np.random.default_rng(seed).random((9, 11))
    means = {(top, left): values[top : top + 3, left : left + 4].mean() for top in range(7) for left in range(8)}
    first = strongest_window(values, 3, 4)
    assert first[:2] == max(means, key=means.get)
    clear = {at: mean for at, mean in means.items() if abs(at[0] - first.top) >= 3 or abs(at[1] - first.left) >= 4}
    assert strongest_window(values, 3, 4, [first])[:2] == max(clear, key=clear.get)


def test_figure_of_lights_shows_their_closed_form(drawn, tmp_path):
    lights_figure.save_lights_figure(tmp_path)
    [figure] = drawn.values()
    size = 401
    ramp = np.linspace(-1, 1, size)
    y, x = np.meshgrid(ramp, ramp, indexing="ij")
    inside = np.hypot(x, y) < 0.999
    for number, light in enumerate(lights().numpy(), start=1):
        [axes] = [axes for axes in figure.axes if axes.get_label() == f"sphere under e{number}"]
        image = axes.images[0].get_array()
        brightness = np.clip(light[0] * x - light[2] * np.sqrt(np.clip(1 - x**2 - y**2, 0, 1)) + light[1] * y, 0, 1)
        np.testing.assert_allclose(image[inside], brightness[inside], atol=1e-9)
        if number < 4:  # the arrow comes from where the light is
            [arrow] = [text for text in axes.texts if text.arrow_patch is not None]
            assert np.dot(arrow.xyann, light[:2]) > np.dot(arrow.xy, light[:2]) > 0

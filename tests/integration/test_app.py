"""`dsr app`: what it computes, what it refuses, that it ends whatever it is given, and its page in a browser."""

import os
import signal
import subprocess
import sys
import urllib.error
import urllib.request
import zipfile
from pathlib import Path

import captures
import cv2
import numpy as np
import pytest
from small_results import waves
from upsampling import upsample

from dsr.app.browser import Work, offered
from dsr.app.requests import BrowserRequest
from dsr.app.upsample.stored import find_results, read_result
from dsr.cli import main
from dsr.utils.progress import show_length

QUICK = {"--depth-unit": "", "--fov": "", "--method": "bicubic", "--fill": "small"}


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A photo and a depth map of a quarter of its size, with a hole."""
    folder = tmp_path_factory.mktemp("pair")
    v, u = np.mgrid[:64, :64].astype(np.uint8)
    cv2.imwrite(str(folder / "photo.png"), np.stack((2 * u, 2 * v, 200 - u), -1))
    cv2.imwrite(str(folder / "depth.png"), np.nan_to_num(1000 * waves()[::4, ::4]).astype(np.uint16))
    return {"--rgb": str(folder / "photo.png"), "--depth": str(folder / "depth.png"), "--mask": None}


@pytest.fixture
def folder(tmp_path):
    """The folder of uploads and results; nothing is left in it."""
    made = tmp_path / "app"
    made.mkdir()
    yield made
    assert list(made.iterdir()) == []


def results_of(steps, folder):
    """Return what is said in the end, the page, and the folder into which the results are unpacked."""
    for said, page, files in steps:
        if files:
            zipfile.ZipFile(files[0]).extractall(folder)
            assert files[1].endswith("mesh.glb")
            last = said, page, folder / "dsr-result"
    return last


def refusal(steps):
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the caller looks at it
        list(steps)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_methods_on_the_page_need_no_files_and_not_minutes():
    names = {name for _, name in offered()}
    assert {"facets", "msg_v", "tgv", "guided_filter", "bicubic", "nearest"} <= names
    assert not names & {"dip", "dip_v", "external", "onnx", "monocular", "prompt_da", "fdkn"}


def test_pair_becomes_what_the_command_makes_of_it(pair, folder, tmp_path):
    options = {**pair, "--depth-unit": "1/500", "--fov": "70", "--method": "bicubic", "--fill": "all"}
    said, page, here = results_of(Work(BrowserRequest(), folder).compute(None, 1, options), tmp_path)
    assert said.endswith("-> dsr-result\n")
    assert 'sandbox="allow-scripts"' in page
    assert {"view.html", "info.json", "mesh.glb"} <= {path.name for path in here.iterdir()}
    command = [f"{flag}={value}" for flag, value in options.items() if value]
    assert upsample(*command, "-o", tmp_path / "out") == 0
    of_page, of_command = (read_result(place, "") for place in (here, tmp_path / "out"))
    assert np.array_equal(of_page.depth, of_command.depth, equal_nan=True)
    middle = show_length(float(np.nanmedian(of_page.depth_error)), 2)
    assert f"{middle}, 90 % below" in page


def test_frame_of_a_capture_is_chosen(folder, tmp_path):
    scan, work = str(captures.record3d(tmp_path / "scan.r3d")), Work(BrowserRequest(), folder)
    assert "from 1 to 3, got 4" in refusal(work.compute(scan, 4, QUICK))
    said, *_, result = results_of(work.compute(scan, 3, QUICK), tmp_path)
    assert "frames 3 to 3 of 3" in said
    (found,) = find_results(result)
    assert np.nanmedian(read_result(found, "").depth) == pytest.approx(np.median(captures.depth(2)), abs=0.02)


def test_incomplete_input_and_wrong_choices_are_refused_in_one_line(pair, folder):
    work = Work(BrowserRequest(), folder)
    assert "a photo and a depth map, or a capture" in refusal(work.compute(None, 1, {**pair, "--depth": None}))
    assert "--fov" in refusal(work.compute(None, 1, {**pair, **QUICK, "--fov": "-1"}))


def test_computation_ends_at_its_limits_of_time_and_memory_and_when_it_is_cancelled(pair, folder):
    given = (None, 1, {**pair, **QUICK})
    assert "--max-seconds" in refusal(Work(BrowserRequest(max_seconds=0.5), folder).compute(*given))
    if sys.platform == "linux":
        assert "memory" in refusal(Work(BrowserRequest(max_memory=0.1), folder).compute(*given))
    work = Work(BrowserRequest(), folder)
    steps = work.compute(*given)
    next(steps)
    assert work.process.poll() is None
    steps.close()
    assert work.process.poll() is not None


def test_missing_library_is_named(monkeypatch, capsys):
    for name in ("GRADIO_ANALYTICS_ENABLED", "GRADIO_TEMP_DIR", "HF_HUB_OFFLINE"):
        monkeypatch.setenv(name, "")
    monkeypatch.setitem(sys.modules, "gradio", None)
    assert main(["app", "--port", "0", "--no-open"]) == 2
    assert "[app]" in capsys.readouterr().err


@pytest.fixture
def served(tmp_path):
    """Run the command, and yield the address of its page; it leaves nothing at its end."""
    pytest.importorskip("gradio", reason="needs the extra [app]")
    command = [sys.executable, "-m", "dsr", "app", "--no-open", "--port", "0", "--max-upload", "0.1"]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
    yield process.stdout.readline().split()[-1]
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 143
    process.stdout.close()
    assert list(tmp_path.glob("dsr-app-*")) == []


@pytest.mark.skipif(os.name == "nt", reason="needs signals of POSIX")
def test_page_takes_pairs_refuses_wrong_files_and_asks_nobody_else(served, webgl_browser, pair, tmp_path_factory):
    origin = served.rsplit("/", 2)[0]
    for path in ("/", "/gradio_api/info", "/config", "/docs"):  # without the token
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(origin + path, timeout=60)
    with urllib.request.urlopen(served, timeout=60) as answer:
        assert "default-src 'self'" in answer.headers["content-security-policy"]
    place = tmp_path_factory.mktemp("files")
    (place / "wrong.zip").write_bytes(b"no archive")
    (place / "large.zip").write_bytes(bytes(200_000))
    context = webgl_browser.new_context(viewport={"width": 1400, "height": 1000}, accept_downloads=True)
    context.set_default_timeout(120_000)
    page, wrong = context.new_page(), []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("request", lambda request: request.url.startswith((origin, "data:", "blob:")) or wrong.append(request.url))
    page.goto(served)
    compute, said = page.get_by_role("button", name="Compute"), page.get_by_label("What was read and done")

    def give(suffix, path):
        page.locator(f'input[accept*="{suffix}"]').set_input_files(path)
        page.get_by_label(path.name).wait_for()

    page.locator('input[accept*=".r3d"]').set_input_files(place / "large.zip")
    page.get_by_text("maximum allowed size").first.wait_for()
    give(".r3d", place / "wrong.zip")
    compute.click()
    page.get_by_text("wrong.zip: expected a ZIP archive").first.wait_for()
    page.get_by_label("Clear").click()
    page.get_by_label("wrong.zip").wait_for(state="detached")

    give(".ppm", Path(pair["--rgb"]))
    give(".pfm", Path(pair["--depth"]))
    compute.click()
    page.frame_locator("iframe").locator("#stage[data-shown]").wait_for()
    assert said.input_value().startswith("photo.png and depth.png\n")
    assert (
        "degrees"
        in page.frame_locator("iframe").get_by_text("expected error of the normals").locator("..").inner_text()
    )
    with page.expect_download() as download:
        page.locator('a[download="dsr-result.zip"]').click()
    assert "dsr-result/view.html" in zipfile.ZipFile(download.value.path()).namelist()
    compute.click()
    page.locator("iframe").wait_for(state="detached")  # the command is ended while it computes
    context.close()
    assert wrong == []

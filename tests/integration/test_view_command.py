"""``dsr view`` on folders of results: what it writes and says, and every refusal."""

import json
import re
import webbrowser

import numpy as np
import pytest
from PIL import Image
from small_results import waves, write_result
from upsampling import refused_line, upsample

from dsr.cli import main
from dsr.geometry.camera import Camera
from dsr.io.depth_files import write_depth_file
from dsr.synthetic.simgeo import render_scene


@pytest.fixture
def opened(monkeypatch):
    """The addresses that the browser was asked to open."""
    addresses = []
    monkeypatch.setattr(webbrowser, "open", lambda address: addresses.append(address) or True)
    return addresses


def view(*arguments):
    return main(["view", *map(str, arguments)])


def content(page):
    return json.loads(re.search(r'id="content">(.*?)</script>', page.read_text(), re.DOTALL)[1])


def cut(path):
    path.write_bytes(path.read_bytes()[:300])


def spoil_camera(folder):
    info = json.loads((folder / "info.json").read_text())
    (folder / "info.json").write_text(json.dumps({**info, "camera": {**info["camera"], "fx": -1.0}}))


def all_holes(folder):
    write_depth_file(folder / "depth_metres.tiff", np.full((64, 64), np.nan, "f4"))


def test_what_upsample_writes_is_shown_with_photo_input_and_errors(tmp_path, opened, capsys):
    scene = render_scene("cube_no_texture", 64)
    Image.fromarray(scene.rgb).save(tmp_path / "photo.png")
    values = np.round(1000 * scene.depth.reshape(16, 4, 16, 4).mean((1, 3))).astype(np.uint16)
    Image.fromarray(values).save(tmp_path / "depth.png")
    pair = ("--rgb", tmp_path / "photo.png", "--depth", tmp_path / "depth.png", "--only", "depth,confidence,input")
    assert upsample(*pair, "-o", tmp_path / "out") == 0
    assert view(tmp_path / "out") == 0
    page = tmp_path / "out" / "view.html"
    assert opened == [page.as_uri()]
    assert f"1 result, at most 4,096 vertices each, 0.1 MB -> {page}" in capsys.readouterr().out
    (result,) = content(page)["results"]
    assert (result["name"], result["facts"]["method"], result["facts"]["input"]) == ("out", "facets x4", "16 x 16")
    assert (result["before"]["size"], result["after"]["size"]) == ([16, 16], [64, 64])
    assert {"depth", "angle"} == set(result["errors"])
    assert 'id="photo-0"' in page.read_text()
    assert upsample(*pair, "-o", tmp_path / "out") == 0
    assert page.is_file()  # a result that is complete leaves the page alone


def test_folder_of_results_is_one_page_in_the_order_of_the_numbers_and_tells_what_is_left_out(tmp_path, opened, capsys):
    for number in (10, 9, 1):
        write_result(tmp_path / "all" / f"frame{number}", with_input=False, with_errors=False)
    write_result(tmp_path / "all" / "more" / "x")
    page = tmp_path / "page.html"
    assert view(tmp_path / "all", "--no-open", "-o", page) == 0
    assert opened == []
    results = content(page)["results"]
    assert [result["name"] for result in results] == ["frame1", "frame9", "frame10", "more/x"]
    assert not {"before", "errors"} & set(results[0])
    assert "neither the photo nor the input" in results[0]["notes"][-1]
    assert "4 results, " in capsys.readouterr().out
    assert view(tmp_path / "all", "--no-open", "-o", page, "--most", "2") == 0
    assert [result["name"] for result in content(page)["results"]] == ["frame1", "more/x"]
    [note] = content(page)["notes"]
    assert note.startswith("2 of 4 results, taken at equal distances")
    assert note in capsys.readouterr().out
    cut(tmp_path / "all" / "frame9" / "depth_metres.tiff")
    assert "frame9/depth_metres.tiff: expected" in refused_line(capsys, view(tmp_path / "all", "--no-open", "-o", page))
    assert [result["name"] for result in content(page)["results"]] == ["frame1", "frame10", "more/x"]
    assert content(page)["notes"] == ["1 of 4 results could not be read and are left out."]


def test_vertices_are_limited_for_each_surface_and_for_the_page(tmp_path, capsys):
    write_result(tmp_path / "one", waves(128, hole=False), camera=large())
    assert view(tmp_path / "one", "--no-open", "--vertices", "5000") == 0
    assert "at most 4,096 vertices each, maps reduced by 2 each way" in capsys.readouterr().out
    for number in range(8):
        write_result(tmp_path / "many" / str(number), waves(128, hole=False), camera=large(), with_input=False)
    assert view(tmp_path / "many", "--no-open", "--vertices", "5000") == 0
    maps = [each["after"] for each in content(tmp_path / "many/view.html")["results"]]
    sizes = [each["width"] * each["height"] for each in maps]
    assert len(sizes) == 8
    assert sum(sizes) <= 6 * 5000


def large():
    return Camera(128, 128, 160.0, 160.0, 63.0, 64.0)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / "info.json").unlink(), "r: expected a result of `dsr upsample`, or a folder of them"),
        (lambda folder: (folder / "info.json").write_text("{}"), "r/info.json: expected a file of `dsr upsample`"),
        (lambda folder: write_result(folder, complete=False), "r/info.json: expected a complete result"),
        (lambda folder: write_result(folder, camera=large()), "expected float32 of shape (128, 128)"),
        (spoil_camera, "r/info.json: expected the photo's camera under `camera`"),
        (lambda folder: (folder / "depth_metres.tiff").unlink(), "r: expected a result with depth"),
        (lambda folder: cut(folder / "depth_metres.tiff"), "depth_metres.tiff: expected a picture as PNG"),
        (all_holes, "expected depths, all"),
        (lambda folder: cut(folder / "confidence.npz"), "r/confidence.npz: expected an archive of arrays"),
        (lambda folder: cut(folder / "input.npz"), "r/input.npz: expected an archive of arrays, got a damaged"),
    ],
)
def test_damaged_result_is_refused_on_one_line_and_nothing_is_written(tmp_path, capsys, opened, damage, message):
    folder = write_result(tmp_path / "r")
    damage(folder)
    before = sorted(tmp_path.rglob("*"))
    assert message in refused_line(capsys, view(folder))
    assert sorted(tmp_path.rglob("*")) == before
    assert opened == []


def test_page_replaces_a_page_and_nothing_else(tmp_path, capsys):
    folder = write_result(tmp_path / "r")
    assert view(folder, "--no-open") == 0
    assert view(folder, "--no-open") == 0
    capsys.readouterr()
    (tmp_path / "mine.html").write_text("<p>mine</p>")
    message = refused_line(capsys, view(folder, "--no-open", "-o", tmp_path / "mine.html"))
    assert message == f"{tmp_path / 'mine.html'}: is there already and no page of `dsr view`; take another -o"
    assert (tmp_path / "mine.html").read_text() == "<p>mine</p>"

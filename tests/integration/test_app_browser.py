"""The page of `dsr app` in a browser: files to surfaces and back to files, by the mouse and by keys alone."""

import io
import zipfile

import captures
import cv2
import numpy as np
import pytest
from app_server import serving
from small_results import waves

DESKTOP = {"width": 1280, "height": 900}
SHOWN = "#stage[data-shown]"


@pytest.fixture(scope="module")
def client():
    with serving() as made:
        yield made


@pytest.fixture
def page(webgl_browser, client):
    """A page of the server; what it says on the console, or asks of others, fails the test at its end."""
    context = webgl_browser.new_context(viewport=DESKTOP, accept_downloads=True)
    made, wrong = context.new_page(), []
    made.on("console", lambda message: wrong.append(message.text))
    made.on("pageerror", lambda error: wrong.append(str(error)))
    own = (f"http://127.0.0.1:{client.port}/", "data:", "blob:")
    made.on("request", lambda request: None if request.url.startswith(own) else wrong.append(request.url))
    made.goto(client.page)
    yield made
    context.close()
    assert wrong == []


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A photo and a depth map of a quarter of its size, with a hole."""
    folder = tmp_path_factory.mktemp("pair")
    photo = np.zeros((128, 128, 3), np.uint8)
    photo[:, :64, 2], photo[:, 64:, 0] = 200, 200  # red, then blue
    cv2.imwrite(str(folder / "front.png"), photo)
    cv2.imwrite(str(folder / "front_depth.png"), np.nan_to_num(1000 * waves(128)[::2, ::2]).astype(np.uint16))
    return folder / "front.png", folder / "front_depth.png"


def drop(page, *paths):
    """Drop files on the page."""
    files = [{"name": path.name, "content": list(path.read_bytes())} for path in paths]
    dropped = page.evaluate_handle(
        """(files) => { const all = new DataTransfer();
        for (const { name, content } of files) all.items.add(new File([Uint8Array.from(content)], name));
        return all; }""",
        files,
    )
    for kind in ("dragover", "drop"):
        page.dispatch_event(".drop", kind, {"dataTransfer": dropped})


def finished(page):
    """Wait for the end of the work under way."""
    page.wait_for_selector(".under-way", state="hidden", timeout=200_000)
    return page.inner_text(".status"), page.inner_text(".refused")


def computed(page):
    page.click(".compute")
    status, problem = finished(page)
    assert (status[:4], problem) == ("Done", "")
    page.wait_for_selector(SHOWN)


def label(page):
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return page.locator("#stage canvas").get_attribute("aria-label")


def panels(page):
    """Return the panels as they are on the screen, by name, without what lies upon the surfaces."""
    label(page)
    for selector in (".panels .name", ".panels .spot", ".zoom"):
        page.evaluate("(s) => document.querySelectorAll(s).forEach((e) => e.style.opacity = 0)", selector)
    stage = cv2.imdecode(np.frombuffer(page.locator("#stage").screenshot(), np.uint8), cv2.IMREAD_COLOR)
    box, found = page.locator("#stage").bounding_box(), {}
    for each in page.locator(".panels > div").all():
        own = each.bounding_box()
        x, y = round(own["x"] - box["x"]), round(own["y"] - box["y"])
        found[each.inner_text()] = stage[y : y + round(own["height"]), x : x + round(own["width"]), ::-1].astype(int)
    return found


def middle(picture, u=0.5, v=0.5):
    """Return the mean colour around a place of a panel."""
    height, width = picture.shape[:2]
    side = min(height, width)
    x, y = round(width / 2 + (u - 0.5) * side), round(height / 2 + (v - 0.5) * side)
    return picture[y - 4 : y + 4, x - 4 : x + 4].mean((0, 1))


def test_dropped_pair_is_shown_beside_its_result_under_one_light_and_computed_anew(page, pair):
    drop(page, *reversed(pair))
    assert page.evaluate("document.querySelector('#photo').files[0].name") == pair[0].name
    assert page.evaluate("document.querySelector('#depth').files[0].name") == pair[1].name
    page.select_option("#method", "bicubic")
    page.fill("#fov", "70")
    page.click(".settings summary")
    page.select_option("#fill", "all")
    computed(page)
    assert "70.0 degrees" in page.inner_text(".facts")
    seen = panels(page)
    assert list(seen) == ["photo", "before", "after, with the photo", "after"]
    assert np.abs(middle(seen["photo"], 0.25) - (200, 0, 0)).max() < 12
    assert middle(seen["after, with the photo"], 0.25)[0] > 2 * middle(seen["after, with the photo"], 0.25)[2]

    box = page.locator(".panels > div").last.bounding_box()
    centre = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    before = label(page)
    page.mouse.move(*centre)
    page.mouse.down()
    page.mouse.move(centre[0], centre[1] + 0.47 * box["height"], steps=4)
    page.mouse.up()
    assert label(page) != before
    assert "down" in label(page)
    low = panels(page)
    page.mouse.move(*centre)
    page.mouse.down()
    page.mouse.up()
    assert "from the viewer" in label(page)
    facing = panels(page)
    for name in ("before", "after"):
        assert middle(facing[name]).mean() > middle(low[name]).mean() + 20
    assert np.abs(middle(facing["photo"]) - middle(low["photo"])).max() < 3

    page.click("[data-colour=filled]")
    red, _, blue = np.moveaxis(panels(page)["after"], -1, 0)
    assert 0.001 < ((red > 120) & (red > 1.3 * blue)).mean() < 0.02  # the input's hole has 1.2 % of the photo
    assert "Orange" in page.inner_text(".scale")

    depth = page.inner_text(".facts")
    page.select_option("#unit", "1/5000")
    assert "Compute" in page.inner_text(".status")
    computed(page)
    assert page.inner_text(".facts") != depth
    assert page.get_attribute("[data-colour=filled]", "aria-pressed") == "true"

    page.select_option("#range", "disparity")
    page.click(".compute")
    assert "baseline" in finished(page)[1]
    page.fill("#fov", "0")
    page.click(".compute")  # the browser itself says what is expected
    assert page.is_hidden(".under-way")


def test_phones_capture_goes_to_a_downloaded_mesh_by_keys_alone(page, tmp_path):
    scan = captures.record3d(tmp_path / "scan.r3d")
    keys = page.keyboard

    def tab_to(selector):
        for _ in range(60):
            keys.press("Tab")
            focused = page.evaluate("(s) => document.activeElement.matches(s)", selector)
            if focused:
                outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
                assert outline != "none"
                return
        raise AssertionError(selector)

    tab_to("#capture")
    with page.expect_file_chooser() as chooser:
        keys.press("Space")
    chooser.value.set_files(scan)
    finished(page)
    assert page.locator("[data-frame]").count() == 3
    tab_to("#frame")
    keys.press("ArrowUp")
    assert page.input_value("#frame") == "2"
    tab_to("#method")
    keys.type("bicubic")
    tab_to(".compute")
    keys.press("Enter")
    assert finished(page)[0].startswith("Done")
    page.wait_for_selector(SHOWN)
    assert f"focal length {captures.INTRINSICS[0] + 1:.0f} pixels" in page.inner_text(".facts")

    tab_to(".ball")
    before = label(page)
    for _ in range(5):
        keys.press("ArrowRight")
    assert label(page) != before
    keys.press("d")
    keys.press("1")
    assert "before" in label(page)
    tab_to(".prepare")
    keys.press("Enter")
    finished(page)
    names = []
    for number in range(page.locator(".links a").count()):
        page.locator(".links a").nth(number).focus()
        with page.expect_download() as download:
            keys.press("Enter")
        names.append(download.value.suggested_filename)
        if names[-1].endswith(".zip"):
            with zipfile.ZipFile(io.BytesIO(download.value.path().read_bytes())) as packed:
                assert {"dsr-result/info.json", "dsr-result/view.html"} <= set(packed.namelist())
    assert names[:2] == ["dsr-result.zip", "mesh.glb"]


def test_wrong_and_large_files_are_refused_before_they_are_sent_and_work_can_be_cancelled(page, client, pair, tmp_path):
    (tmp_path / "notes.txt").write_text("no picture")
    (tmp_path / "large.r3d").write_bytes(bytes(client.desk.most_bytes + 1))
    page.set_input_files("#photo", tmp_path / "notes.txt")
    assert "notes.txt" in page.inner_text(".refused")
    page.set_input_files("#capture", tmp_path / "large.r3d")
    assert "--max-upload" in page.inner_text(".refused")
    assert page.is_disabled(".compute")
    drop(page, *pair)
    assert page.inner_text(".refused") == ""
    page.click(".compute")
    page.click(".cancel")
    assert finished(page)[0] == "Cancelled."
    assert page.is_enabled(".compute")


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("photo", "depth", "size"),
    [
        ("iphone_lidar/image.jpg", "iphone_lidar/arkit_depth.png", "1920 x 1440"),
        ("depth_camera/0/rgb.png", "depth_camera/0/raw_depth.png", "640 x 480"),
    ],
)
def test_real_pairs_of_a_phone_and_of_a_depth_camera(page, shared, photo, depth, size):
    page.set_input_files("#photo", shared / "real" / photo)
    page.set_input_files("#depth", shared / "real" / depth)
    page.select_option("#method", "bicubic")
    computed(page)
    assert size in page.inner_text(".facts")
    assert page.locator(".job-notes li").count() > 0
    seen = panels(page)
    assert middle(seen["after"]).mean() > 30
    assert seen["after"].std() > 5

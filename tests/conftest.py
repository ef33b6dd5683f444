"""Fixtures that every kind of test uses."""

import gc
import json
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from hydra.core.hydra_config import HydraConfig

from dsr.degradation.downsampling import Downsampling, make_sample
from dsr.evaluation.results import prediction_path, sample_path
from dsr.evaluation.scenes import SCORE_COLUMNS
from dsr.geometry.camera import Camera
from dsr.metrics.catalogue import catalogue, score_image
from dsr.sample import Scene
from dsr.utils.compute_device import pick_device

REPOSITORY = Path(__file__).resolve().parents[1]
UNIT_TESTS = REPOSITORY / "tests" / "unit"
NIGHTLY = tuple(REPOSITORY / "tests" / name for name in ("chaos", "fuzz"))
CHROMIUMS = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM_ARGUMENTS = (
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)  # fmt: skip


def pytest_configure() -> None:
    """Let Ctrl-C do what it does at a terminal: a shell without one starts ``pytest &`` with SIGINT ignored."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give every test its tiers, and put those that run whole commands first.

    ``shared`` tests need the shared material, ``browser`` tests a browser, and ``slow`` tests run whole commands or are
    marked so. All others are ``unit``. Campaigns, and what is marked so, are ``nightly``: `make test` leaves them out.
    The first test of each file of a command is ``command``, too: it shows that the command works.
    """
    files = set()
    for item in items:
        if item.path not in files and item.path.stem.endswith(("_command", "_commands")):
            item.add_marker("command")
        files.add(item.path)
        fixtures = getattr(item, "fixturenames", ())
        if "shared" in fixtures:
            item.add_marker("shared")
        if "webgl_browser" in fixtures:
            item.add_marker("browser")
        if UNIT_TESTS not in item.path.parents or "in_process" in fixtures:
            item.add_marker("slow")
        if any(folder in item.path.parents for folder in NIGHTLY):
            item.add_marker("nightly")
        if not any(item.get_closest_marker(tier) for tier in ("shared", "browser", "slow")):
            item.add_marker("unit")
    long = {item.path for item in items if not item.get_closest_marker("unit")}
    # Long files first, so that at the end no worker has one alone
    items.sort(key=lambda item: (UNIT_TESTS in item.path.parents, item.path not in long))


def pytest_collection_finish() -> None:
    """Take what collecting has made out of garbage collections, which would go through it thousands of times."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _two_threads() -> None:
    several = "PYTEST_XDIST_WORKER" in os.environ
    torch.set_num_threads(int(os.environ.get("DSR_TEST_THREADS", "1" if several else "2")))


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """Small maps gain nothing from threads, and wait for each other's where other processes want the cores, too."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def device() -> torch.device:
    """The device to test on: $DSR_DEVICE, or the CPU."""
    return pick_device(os.environ.get("DSR_DEVICE", "cpu"))


@pytest.fixture(scope="session", autouse=True)
def dsr_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """$DSR_CACHE, one for all tests and workers: the user's own stays as it is."""
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "dsr_cache"
    folder.mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DSR_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real scenes, published networks and golden results: $DSR_SHARED, or beside the checkout."""
    folder = Path(os.environ.get("DSR_SHARED", REPOSITORY.parent / "shared"))
    if not (folder / "expected" / "metrics.json").is_file():
        message = f"needs the shared material (set DSR_SHARED); none at {folder}"
        if os.environ.get("DSR_REQUIRE_SHARED"):
            pytest.fail(message)
        pytest.skip(message)
    return folder


class QuietServer(ThreadingHTTPServer):
    """A server that says nothing of clients that hang up, as interrupted ones do; ``url`` is its address."""

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing."""

    @property
    def url(self) -> str:
        """The address to ask."""
        return f"http://127.0.0.1:{self.server_address[1]}"


@pytest.fixture
def serve(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[type[BaseHTTPRequestHandler]], QuietServer]]:
    """Return what starts a server of this machine with a handler; it ends with the test."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    running: list[tuple[QuietServer, threading.Thread]] = []

    def start(handler: type[BaseHTTPRequestHandler]) -> QuietServer:
        server = QuietServer(("127.0.0.1", 0), handler)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        running.append((server, thread))
        return server

    yield start
    for server, thread in running:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture(scope="session")
def webgl_browser() -> Iterator[Any]:
    """A headless Chromium with WebGL on the CPU, driven by playwright; $DSR_CHROMIUM names another than the path's."""
    path = os.environ.get("DSR_CHROMIUM") or next(filter(None, map(shutil.which, CHROMIUMS)), None)
    sync_api = pytest.importorskip("playwright.sync_api")
    if path is None:
        message = f"needs a browser ({', '.join(CHROMIUMS)} on the path, or DSR_CHROMIUM)"
        if os.environ.get("DSR_REQUIRE_BROWSER"):
            pytest.fail(message)
        pytest.skip(message)
    with sync_api.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=path, args=list(CHROMIUM_ARGUMENTS))
        yield started
        started.close()


class Window:
    """A page; ``wrong`` has its errors, and its requests of anything but local pages, ``dialogs`` what it asks."""

    def __init__(self, browser: Any, **options: Any) -> None:
        self.context = browser.new_context(**({"viewport": {"width": 1280, "height": 900}} | options))
        self.page = self.context.new_page()
        self.wrong: list[str] = []
        self.dialogs: list[str] = []
        self.page.on("console", lambda message: self.wrong.append(message.text))
        self.page.on("pageerror", lambda error: self.wrong.append(str(error)))
        self.page.on("dialog", lambda dialog: (self.dialogs.append(dialog.message), dialog.dismiss()))
        self.page.on("request", lambda request: None if _harmless(request.url) else self.wrong.append(request.url))

    def settle(self) -> None:
        """Wait until what was asked for is drawn."""
        self.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def press(self, *keys: str) -> None:
        """Press keys one after the other."""
        for key in keys:
            self.page.keyboard.press(key)

    def close(self) -> None:
        """Close the page, which must have done nothing wrong."""
        self.context.close()
        assert self.wrong == self.dialogs == []


def _harmless(url: str) -> bool:
    return url.startswith(("data:", "blob:", "about:")) or (url.startswith("file:") and ".html" in url)


@pytest.fixture
def window(webgl_browser: Any) -> Iterator[Callable[..., Window]]:
    """Return what opens a window with options of its context; what its page does wrong fails the test."""
    windows: list[Window] = []

    def make(**options: Any) -> Window:
        windows.append(Window(webgl_browser, **options))
        return windows[-1]

    yield make
    for each in windows:
        each.close()


@pytest.fixture
def in_process(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> Iterator[Callable[..., tuple[int, str, list[str]]]]:
    """Return a runner of ``eval.py`` and ``train.py`` in this process: exit code, output, lines of errors."""
    from dsr.app.entry import run_command  # noqa: PLC0415 - takes seconds, as the next ones
    from dsr.app.evaluate import evaluate  # noqa: PLC0415
    from dsr.app.train import train  # noqa: PLC0415

    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DSR_LPIPS_TRUNK", raising=False)
    for name, value in (("HYDRA_FULL_ERROR", "1"), ("PL_GLOBAL_SEED", "0"), ("PL_SEED_WORKERS", "1")):
        monkeypatch.setenv(name, value)  # and so put back afterwards

    def call(name: str, *arguments: str) -> tuple[int, str, list[str]]:
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
        code = 0
        try:
            run_command(name, {"train": train, "eval": evaluate}[name])
        except SystemExit as ended:
            code = int(ended.code or 0)
        captured = capfd.readouterr()
        return code, captured.out, captured.err.splitlines()

    yield call
    HydraConfig.instance().cfg = None  # as in a process without a command


@pytest.fixture(scope="session")
def make_run() -> Callable[..., Path]:
    """Return what writes the directory of a run, whole and with real depth maps, without running a method."""
    return write_run


def write_run(
    folder,
    *,
    method="bicubic",
    label="Bicubic",
    dataset="simgeo",
    scale=4,
    downsampling="box",
    seed=0,
    scenes=("cube_no_texture",),
    size=32,
    confident=False,
):
    """Write a run whose method repeats LR pixels with a little noise of its own; truths are waves, one a scene.

    A ``confident`` one expects errors of 2 to 12 mm, from left to right, and of 5 to 25 degrees, from top to bottom.
    """
    camera = Camera(size, size, 1.2 * size, 1.2 * size, (size - 1) / 2, (size - 1) / 2)
    kind = Downsampling("box")
    rows, seconds, truths = [], {}, {}
    for scene in scenes:
        generator = torch.Generator().manual_seed(sum(scene.encode()))
        x, y = torch.meshgrid(*2 * [torch.arange(size, dtype=torch.float64) / size], indexing="xy")
        phase = float(torch.rand(1, generator=generator))
        truth = (2 + 0.3 * torch.sin(6 * (x + phase)) + 0.2 * torch.cos(5 * y))[None]
        rgb = torch.rand(3, size, size, generator=generator)
        sample = make_sample(Scene(dataset, scene, rgb, camera, truth), scale, kind, "orthogonal")
        noise = torch.Generator().manual_seed(seed + sum((method + label + scene).encode()))
        depth = sample.depth_lr.repeat_interleave(scale, 1).repeat_interleave(scale, 2)
        depth = depth + 0.002 * torch.randn(depth.shape, generator=noise, dtype=depth.dtype)
        sample.save(sample_path(folder, scene))
        seconds[scene], truths[scene] = 0.25, f"{sum(scene.encode()):08x}"
        path = prediction_path(folder, scene)
        path.parent.mkdir(parents=True, exist_ok=True)
        errors = {"depth_error": 0.002 + 0.01 * x, "angle_error": 5 + 20 * y} if confident else {}
        halves = {name: each.half().numpy() for name, each in errors.items()}
        np.savez_compressed(path, depth=depth[0].numpy(), config="{}", seconds=seconds[scene], **halves)
        about = (dataset, scene, scale, downsampling, method, seed)
        results = score_image(depth, sample.depth, camera.rays(), catalogue())
        rows += [(*about, each.metric, each.variant, each.value, each.valid_share) for each in results]
    pd.DataFrame(rows, columns=list(SCORE_COLUMNS)).to_csv(folder / "scores.csv", index=False)
    named = {"dataset": dataset, "scale": scale, "downsampling": downsampling, "method": method, "label": label}
    (folder / "summary.json").write_text(json.dumps({**named, "seed": seed, "seconds": seconds, "truths": truths}))
    identity = {"method": {"name": method, "label": label}, "dataset": {"name": dataset}, "seed": seed, "scale": scale}
    versions = {"packages": {"dsr": "0.1.0"}, "python": "3.11.7", "platform": "Linux", "cpu_threads": 2}
    (folder / "versions.json").write_text(json.dumps({**versions, "identity": identity}))
    return folder

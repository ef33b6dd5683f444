"""Fixtures that every kind of test uses."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import torch

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session", autouse=True)
def _two_threads() -> None:
    torch.set_num_threads(int(os.environ.get("DSR_TEST_THREADS", "2")))


@pytest.fixture(scope="session", autouse=True)
def dsr_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """$DSR_CACHE, one for all tests: the user's own stays as it is."""
    folder = tmp_path_factory.mktemp("dsr_cache")
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

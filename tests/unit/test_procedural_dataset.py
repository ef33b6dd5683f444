"""The procedural data set: numbered scenes, rendered once, kept in the cache."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from dsr.data import rendered as module
from dsr.data.rendered import Procedural
from dsr.synthetic.procedural.random_scene import render_random_scene

SIZE = 48


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("DSR_CACHE", str(tmp_path))
    return tmp_path


def test_scene_is_the_rendering_of_its_number(cache: Path) -> None:
    scene = Procedural(count=3, size=SIZE, seed=5).load("00002")
    expected = render_random_scene(5, 2, SIZE)
    assert scene.depth is not None
    assert np.array_equal(scene.depth[0].numpy(), expected.depth)
    assert np.array_equal((255 * scene.rgb).round().permute(1, 2, 0).numpy(), expected.rgb)
    assert scene.camera == expected.camera
    assert (scene.dataset, scene.name) == ("procedural", "00002")


def test_scene_is_rendered_once(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = Procedural(count=1, size=SIZE).load("00000")
    monkeypatch.setattr(module, "render_random_scene", lambda *_: pytest.fail("rendered again"))
    second = Procedural(count=1, size=SIZE).load("00000")
    assert first.depth is not None
    assert second.depth is not None
    assert first.depth.equal(second.depth)


@pytest.mark.slow
def test_preparing_renders_what_is_missing_and_names_every_scene(cache: Path) -> None:
    source = Procedural(count=3, size=SIZE)
    source.load("00001")
    assert sorted(source.prepare(source.scenes())) == ["00000", "00001", "00002"]
    assert len(list(cache.rglob("*.npz"))) == 3
    assert list(source.prepare(["00002", "00000"])) == ["00002", "00000"]


@pytest.fixture
def kill(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
    """Let scenes be rendered by a single worker, and return a function that kills so many workers one after another."""
    monkeypatch.setattr(module, "_WORTH_WORKERS", 0)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    threads = []

    others = {child.pid for child in multiprocessing.active_children()}

    def kill_workers(times: int) -> None:
        killed: set[int | None] = set()
        while len(killed) < times:
            for worker in multiprocessing.active_children():
                if worker.pid not in killed | others:
                    killed.add(worker.pid)
                    worker.kill()
            time.sleep(0.01)

    def begin(times: int) -> None:
        threads.append(threading.Thread(target=kill_workers, args=(times,), daemon=True))
        threads[0].start()

    yield begin
    threads[0].join(60)


@pytest.mark.slow
def test_scene_of_a_killed_worker_is_rendered_by_another(cache: Path, kill: Callable[[int], None]) -> None:
    said: list[str] = []
    kill(1)
    names = ["00000", "00001", "00002"]
    assert list(Procedural(count=3, size=SIZE).prepare(names, said.append)) == names
    assert len(said) == 1
    assert len(list(cache.rglob("*.npz"))) == 3


@pytest.mark.slow
def test_seeds_and_sizes_do_not_share_scenes(cache: Path) -> None:
    sources = [Procedural(count=1, size=SIZE), Procedural(count=1, size=SIZE, seed=1), Procedural(count=1, size=64)]
    for source in sources:
        source.load("00000")
    assert len(list(cache.rglob("*.npz"))) == 3
    assert len({source.fingerprint("00000") for source in sources}) == 3


@pytest.mark.parametrize("wrong", [{"count": 0}, {"size": 16}, {"seed": -1}])
def test_values_out_of_range_are_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="dataset: expected count at least 1, size at least 32, seed at least 0"):
        Procedural(**wrong)

"""``dataset=procedural``, random scenes to train on, and ``dataset=simgeo``, scenes like the paper's: rendered here.

The paper's sixth scene, Lucy, replaces the statue where ``root/lucy`` holds it in the layout of
:mod:`dsr.data.folder`. Renderings are cached, see :func:`dsr.synthetic.cache_directory`.
"""

import os
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from dsr.data.folder import Folder
from dsr.data.scene_source import SceneSelection, SceneSource, select_scenes
from dsr.sample import Scene
from dsr.synthetic import Rendering, cache_directory, expect_room_for, load_or_render
from dsr.synthetic.procedural.random_scene import PROCEDURAL_VERSION, render_random_scene
from dsr.synthetic.simgeo import SCENES, SCENES_VERSION, render_scene
from dsr.utils.processes import Pool
from dsr.utils.progress import SILENT

_WORTH_WORKERS = 5.0  # seconds of rendering from which worker processes are used; they take some seconds to start


class Procedural(SceneSource):
    """Random scenes number 0 .. ``count`` - 1, each a pure function of seed, number and size, kept in the cache."""

    name = "procedural"
    evaluation = False

    def __init__(self, count: int = 200, size: int = 512, seed: int = 0) -> None:
        if count < 1 or seed < 0:
            raise ValueError(f"dataset: expected count at least 1 and seed at least 0, got {count} and {seed}")
        expect_room_for(size)
        self._size, self._seed = size, seed
        self._series = f"procedural-v{PROCEDURAL_VERSION}-{seed}-{size}"
        self._scenes = [f"{index:05d}" for index in range(count)]

    def load(self, scene: str) -> Scene:
        """Return one scene."""
        return self._render(scene).scene(self.name, scene)

    def fingerprint(self, scene: str) -> str:
        """Return the version, seed, size and number that determine the scene."""
        return f"{self._series}-{scene}"

    def prepare(self, scenes: Sequence[str], say: Callable[[str], None] = SILENT.say) -> Iterable[str]:
        """Render scenes that are not in the cache, with all processors if it takes long; yield each that is ready."""
        folder = cache_directory() / self._series
        missing = [scene for scene in scenes if not (folder / f"{scene}.npz").is_file()]
        yield from (scene for scene in scenes if scene not in missing)
        begun = time.perf_counter()
        for number, scene in enumerate(missing, start=1):
            self._render(scene)
            yield scene
            rest = missing[number:]
            if len(rest) * (time.perf_counter() - begun) / number > _WORTH_WORKERS:
                with Pool(os.cpu_count() or 1, say=say) as pool:
                    yield from (ready for ready, _ in pool.results(self._store, rest))
                return

    def _store(self, scene: str) -> None:
        self._render(scene)

    def _render(self, scene: str) -> Rendering:
        """Return a scene from the cache, into which it is rendered unless it is there."""
        path = Path(self._series, f"{scene}.npz")
        return load_or_render(path, lambda: render_random_scene(self._seed, int(scene), self._size))


class SimGeo(SceneSource):
    """The SimGeo scenes; without a directory ``lucy`` in ``root`` the statue is used."""

    name = "simgeo"
    evaluation = True

    def __init__(self, root: str | None = None, scenes: SceneSelection = None, size: int = 512) -> None:
        expect_room_for(size)
        self._size = size
        self._lucy: Folder | None = None
        available = list(SCENES)
        if root is not None and (Path(root).expanduser() / "lucy").is_dir():
            self._lucy = Folder(root, ["lucy"], self.name)
            available[available.index("statue")] = "lucy"
        self._scenes = select_scenes(available, scenes)

    def load(self, scene: str) -> Scene:
        """Return one scene."""
        if scene == "lucy" and self._lucy is not None:
            return self._lucy.load(scene)
        path = Path(f"simgeo-v{SCENES_VERSION}-{self._size}", f"{scene}.npz")
        return load_or_render(path, lambda: render_scene(scene, self._size)).scene(self.name, scene)

    def fingerprint(self, scene: str) -> str:
        """Return the version of the renderings, or the SHA-256 of Lucy's files."""
        if scene == "lucy" and self._lucy is not None:
            return self._lucy.fingerprint(scene)
        return f"simgeo-v{SCENES_VERSION}-{self._size}-{scene}"

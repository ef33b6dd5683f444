"""``dataset=simgeo``: geometric scenes like the paper's, and a statue, all rendered by this package.

The paper's sixth scene, Lucy, replaces the statue where ``root/lucy`` holds it in the layout of
:mod:`dsr.data.folder`. Renderings are cached, see :func:`dsr.synthetic.rendering.cache_directory`.
"""

from __future__ import annotations

from pathlib import Path

from dsr.data.base import SceneSelection, select_scenes
from dsr.data.folder import Folder
from dsr.sample import Scene
from dsr.synthetic.rendering import load_or_render
from dsr.synthetic.simgeo.scenes import SCENES, SCENES_VERSION, render_scene


class SimGeo:
    """The SimGeo scenes.

    Args:
        root: directory that may hold ``lucy``; without it the statue is used.
        scenes: names of the scenes to use; None for all.
        size: height and width in pixels, 512 in the paper.

    Raises:
        ValueError: an unknown scene or a size below 32.

    """

    name = "simgeo"
    evaluation = True

    def __init__(self, root: str | None = None, scenes: SceneSelection = None, size: int = 512) -> None:
        if size < 32:
            raise ValueError(f"size: expected at least 32 pixels, got {size}")
        self._size = size
        self._lucy: Folder | None = None
        available = list(SCENES)
        if root is not None and (Path(root).expanduser() / "lucy").is_dir():
            self._lucy = Folder(root, ["lucy"], self.name)
            available[available.index("statue")] = "lucy"
        self._scenes = select_scenes(available, scenes)

    def scenes(self) -> list[str]:
        """Return the names of the scenes, in order."""
        return list(self._scenes)

    def load(self, scene: str) -> Scene:
        """Return one scene; see :class:`dsr.data.base.SceneSource`."""
        if scene == "lucy" and self._lucy is not None:
            return self._lucy.load(scene)
        path = Path(f"simgeo-v{SCENES_VERSION}-{self._size}", f"{scene}.npz")
        return load_or_render(path, lambda: render_scene(scene, self._size)).scene(self.name, scene)

    def fingerprint(self, scene: str) -> str:
        """Return the version of the renderings, or the SHA-256 of Lucy's files."""
        if scene == "lucy" and self._lucy is not None:
            return self._lucy.fingerprint(scene)
        return f"simgeo-v{SCENES_VERSION}-{self._size}-{scene}"

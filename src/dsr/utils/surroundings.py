"""Keep code and settings in the working directory from being loaded, since it may hold a stranger's files.

Python, the loader of libraries and matplotlib all look there under some circumstances: Python for modules where it runs
``-m`` or ``-c``, as worker processes are started; the loader, in processes that this one starts, where
``LD_LIBRARY_PATH`` has an empty entry, as OpenCV leaves it; matplotlib for ``matplotlibrc``, which may have LaTeX run.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

_LIBRARIES, _SETTINGS = "LD_LIBRARY_PATH", "matplotlibrc"


def close() -> None:
    """Take the working directory from where this process, and those that it starts, look for code and settings."""
    os.environ["PYTHONSAFEPATH"] = "1"
    if not os.environ.get(_LIBRARIES):  # to which OpenCV puts a colon and this
        os.environ[_LIBRARIES] = str(Path(__file__).parent)
    with contextlib.suppress(OSError):
        if getattr(sys.modules["__main__"], "__spec__", None) is not None and sys.path[:1] == [str(Path.cwd())]:
            del sys.path[0]  # where ``python -m`` puts it
    close_to_settings()


def close_to_settings() -> None:
    """Let matplotlib, if it is not there yet, not read the working directory's settings, but the user's own ones."""
    if "matplotlib" not in sys.modules and not any(isinstance(each, _Finder) for each in sys.meta_path):
        sys.meta_path.insert(0, _Finder())


class _Finder(MetaPathFinder):
    """Finds matplotlib, once."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        """Return how it is loaded; None for other modules."""
        if fullname != "matplotlib":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(fullname)
        if spec is not None and spec.loader is not None:
            spec.loader = _Blind(spec.loader)
        return spec


class _Blind(Loader):
    """Loads matplotlib as another loader does, where there seem to be no settings in the working directory."""

    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Return the module, None for a plain one."""
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """Run the module, which looks once for settings."""
        exists = os.path.exists
        os.path.exists = lambda path: path != _SETTINGS and exists(path)
        try:
            self._loader.exec_module(module)
        finally:
            os.path.exists = exists

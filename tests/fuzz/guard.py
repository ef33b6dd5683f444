"""What a reader must not do: execute what a file says, start a process, connect, read or write outside of its folders.

Python tells an audit hook of such things (https://docs.python.org/3/library/audit_events.html). A hook cannot be
removed, so there is one for the process, which looks only while a case runs.
"""

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

MARK = "dsr_fuzz_canary"  # A word in everything that a file could execute
_NEVER = (
    "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty", "subprocess.Popen", "pty.spawn",
    "socket.connect", "socket.getaddrinfo", "webbrowser.open", "pickle.find_class", "urllib.Request",
)  # fmt: skip
_CHANGES = (
    "os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.truncate", "os.chmod", "os.chown",
    "shutil.rmtree", "shutil.move", "shutil.copyfile",
)  # fmt: skip
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


class Watch:
    """What was ``seen`` that must not be, while a case ran that may use the ``allowed`` folders."""

    def __init__(self, *allowed: Path | str) -> None:
        self._allowed = tuple(map(_absolute, allowed))
        self.seen: list[str] = []

    def look(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Look at one event."""
        if event == "subprocess.Popen" and list(arguments[1])[:2] == ["git", "-C"]:
            return  # the version of the project, which runs store
        if event in _NEVER:
            self.seen.append(f"{event}{arguments!r:.200}")
        elif event == "exec" and MARK in repr((arguments[0].co_names, arguments[0].co_consts)):
            self.seen.append(f"executes code of a file ({arguments[0]!r:.100})")
        elif event in _CHANGES or (event == "open" and _writes(*arguments)):
            self.seen += [
                f"{event} of {path!r:.200}" for path in _paths(event, arguments) if not self._may(event, path)
            ]
        elif event == "open":
            for path in _paths(event, arguments):
                if path.startswith(self._allowed) and not _absolute(path).startswith(self._allowed):
                    self.seen.append(f"reads {path!r:.200}, to which a name in a file leads")

    def _may(self, event: str, path: str) -> bool:
        """Return whether a file may be written."""
        full = _absolute(path)
        made_already = event == "os.mkdir" and os.path.isdir(full)  # noqa: PTH112 - of texts that are no paths, too
        return made_already or full == os.devnull or full.startswith(self._allowed)


def _absolute(path: Path | str) -> str:
    return os.path.abspath(path)  # noqa: PTH100 - without following links, and of texts that are no paths


def _paths(event: str, arguments: tuple[Any, ...]) -> list[str]:
    """Return the paths that an event is about, those below an open folder with its path."""
    count = 2 if event in ("os.rename", "os.link", "shutil.move") else 1
    given = arguments[1:2] if event == "os.symlink" else arguments[:count]  # where a link leads to is not written
    paths = [os.fsdecode(path) for path in given if isinstance(path, str | bytes | os.PathLike)]
    folder = arguments[-1] if event in ("os.remove", "os.rmdir", "os.mkdir", "os.chmod") else -1
    if isinstance(folder, int) and folder >= 0:
        with contextlib.suppress(OSError):
            paths = [str(Path(f"/proc/self/fd/{folder}").readlink() / path) for path in paths]
    return paths


def _writes(_: Any, mode: Any, flags: Any) -> bool:
    """Return whether the arguments of the event ``open`` are those of writing."""
    return any(letter in mode for letter in "wax+") if isinstance(mode, str) else bool((flags or 0) & _WRITING)


class _Finder:
    """Sees imports of a module that only a file names; ``importlib`` raises no event of its own."""

    @staticmethod
    def find_spec(name: str, *_: Any) -> None:
        """Note the name of a module that is looked for."""
        if _current is not None and MARK in name:
            _current.seen.append(f"imports {name}, which a file names")


_current: Watch | None = None
_installed = False


@contextlib.contextmanager
def watching(*folders: Path) -> Iterator[Watch]:
    """Watch in the block what the process does; it may write below some folders, the cache and temporary folders."""
    global _current, _installed  # noqa: PLW0603 - a hook is one for the process
    if not _installed:
        sys.addaudithook(lambda event, arguments: _current.look(event, arguments) if _current is not None else None)
        sys.meta_path.insert(0, _Finder)
        _installed = True
    temporary = [f"{tempfile.gettempdir()}/{beginning}" for beginning in ("tmp", ".dsr-")]
    cache = [os.environ[name] for name in ("DSR_CACHE",) if name in os.environ]
    _current = Watch(*folders, *temporary, *cache)
    try:
        yield _current
    finally:
        _current = None

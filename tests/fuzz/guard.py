"""What a reader must not do: execute what a file says, start a process, connect, read or write outside of its folders.

Python tells an audit hook of such things (https://docs.python.org/3/library/audit_events.html). A hook cannot be
removed, so there is one for the process, which looks only while a case runs.
"""

import contextlib
import os
import sys
import tempfile
import types
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fuzz.place import MARK

_NEVER = (
    "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty", "os.startfile", "subprocess.Popen",
    "socket.connect", "socket.getaddrinfo", "webbrowser.open", "pty.spawn", "pickle.find_class",
    "ftplib.connect", "http.client.connect", "urllib.Request", "smtplib.connect",
)  # fmt: skip
_CHANGES = (
    "os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.truncate", "os.chmod", "os.chown",
    "shutil.rmtree", "shutil.move", "shutil.copyfile",
)  # fmt: skip
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC


@dataclass
class Watch:
    """What was seen while a case ran.

    Args:
        allowed: folders below which files may be written, and that no name in a file may lead out of.
        seen: what was done that must not be.

    """

    allowed: tuple[str, ...]
    seen: list[str] = field(default_factory=list)

    def look(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Look at one event."""
        if event == "subprocess.Popen" and list(arguments[1])[:2] == ["git", "-C"]:
            return  # the version of the project, which runs store
        if event in _NEVER:
            self.seen.append(f"{event}{arguments!r:.200}")
        elif event == "exec" and _mentions(arguments[0]):
            self.seen.append(f"executes code of a file ({arguments[0]!r:.100})")
        elif (event == "open" and _writes(arguments)) or event in _CHANGES:
            for path in _paths(event, arguments):
                if not self._may(event, path):
                    self.seen.append(f"{event} of {path!r:.200}")
        elif event == "open" and any(map(self._leads_out, _paths(event, arguments))):
            self.seen.append(f"reads {arguments[0]!r:.200}, to which a name in a file leads")

    def _leads_out(self, path: str) -> bool:
        """Return whether a path begins in a folder that is read or written, and leads out of it."""
        full = os.path.abspath(path)  # noqa: PTH100 - as below
        return path.startswith(self.allowed) and not full.startswith(self.allowed)

    def _may(self, event: str, path: str) -> bool:
        """Return whether a file may be written."""
        full = os.path.abspath(path)  # noqa: PTH100 - without following links, and of texts that are no paths
        if os.path.isdir(full) and event == "os.mkdir":  # noqa: PTH112
            return True
        return full == os.devnull or any(full.startswith(folder) for folder in self.allowed)


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


def _writes(arguments: tuple[Any, ...]) -> bool:
    """Return whether the arguments of the event ``open`` are those of writing."""
    _, mode, flags = arguments
    return any(letter in mode for letter in "wax+") if isinstance(mode, str) else bool((flags or 0) & _WRITING)


def _mentions(code: Any) -> bool:
    """Return whether code has the mark in one of its names or constants."""
    if not isinstance(code, types.CodeType):
        return False
    return any(MARK in each for each in (*code.co_names, *code.co_consts) if isinstance(each, str)) or any(
        _mentions(each) for each in code.co_consts
    )


class _Finder:
    """Sees imports of a module that only a file names; ``importlib`` raises no event of its own."""

    @staticmethod
    def find_spec(name: str, *_: Any) -> None:
        """Note the name of a module that is looked for."""
        if _current is not None and MARK in name:
            _current.seen.append(f"imports {name}, which a file names")


_current: Watch | None = None
_installed = False


def _hook(event: str, arguments: tuple[Any, ...]) -> None:
    if _current is not None:
        _current.look(event, arguments)


@contextlib.contextmanager
def watching(*folders: Path) -> Iterator[Watch]:
    """Return a context in which is watched what the process does; it may write below some folders.

    Temporary files and the cache of dsr are always allowed.
    """
    global _current, _installed  # noqa: PLW0603 - a hook is one for the process
    if not _installed:
        sys.addaudithook(_hook)
        sys.meta_path.insert(0, _Finder)
        _installed = True
    more = [os.environ[name] for name in ("DSR_CACHE",) if name in os.environ]
    temporary = [f"{tempfile.gettempdir()}/{beginning}" for beginning in ("tmp", ".dsr-")]
    watch = Watch(tuple(os.path.abspath(each) for each in (*folders, *more, *temporary)))  # noqa: PTH100
    _current = watch
    try:
        yield watch
    finally:
        _current = None

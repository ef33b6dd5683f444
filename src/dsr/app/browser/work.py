"""The process of ``dsr app`` that opens what was uploaded: it looks for frames, upsamples one, or writes all its files.

It does what ``dsr upsample`` does with the same arguments. It reports in lines of JSON on its standard output,
one object each, such as ``{"note": ..., "warning": ...}``. It ends with the process that started it.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import zipfile
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn, TextIO

from dsr.app.upsample.request import UpsampleRequest
from dsr.notes import Assumption
from dsr.utils.console import one_line, printable, shorten
from dsr.utils.guards import refusing_excess
from dsr.utils.interruption import start
from dsr.utils.options import add_options, build
from dsr.utils.progress import Progress, Task, Unit

if TYPE_CHECKING:
    from dsr.app.upsample.frames import Frames
    from dsr.geometry.camera import Camera
    from dsr.io.pairs import Pair

What = Literal["look", "result", "files"]
SHOWN, ARCHIVE = "shown.json", "result.zip"
"""What ``result`` and ``files`` write beside the folder of the result."""
RESULT = "result"
_QUICK = "depth,confidence,input"
"""The parts that the page shows."""
_MOST_NAMES, _NAMES, _LONGEST_NAME = 5000, 100, 400
"""Frames whose names the page shows; of more it has their numbers; names of a line, and characters of a name."""
_LONGEST_NOTE = 10_000
_THUMBS, _THUMB = 12, 200
"""Frames of which there is a small picture, and its longer side in pixels."""
_VERTICES, _PHOTO = 400_000, 2048
"""Most vertices of a surface on the page, and the longer side of the photo in pixels."""
_LARGEST_FILE = 8 << 30
_OUTPUT: list[TextIO] = []
"""Where :func:`send` writes."""
_PACKED = (".png", ".glb", ".npz", ".jpg")
"""Suffixes of files that another compression would not make smaller."""


def send(**facts: Any) -> None:
    """Send facts to the server."""
    _OUTPUT[-1].write(f"{json.dumps(facts)}\n")
    _OUTPUT[-1].flush()


def _tell(message: str | Sequence[Assumption]) -> None:
    """Send notes; what else is said is about the command's files."""
    for fact in () if isinstance(message, str) else message:
        send(note=shorten(printable(fact.message), _LONGEST_NOTE), warning=bool(fact.code))


class _Steps(Progress):
    """Sends how many steps of the frame are done."""

    @contextlib.contextmanager
    def task(self, name: str, total: int | None = None, *, done: int = 0, unit: Unit = "items") -> Iterator[Task]:
        """Return a context in which the steps are sent."""

        def report(done: int, total: int | None = total, remark: str | None = None) -> None:
            send(done=done, total=total)

        yield report
        send(done=0, total=0)

    def stage(self, name: str) -> None:
        """Send which stage of the frame begins."""
        send(stage=name)


class _Parser(ArgumentParser):
    """A parser whose errors are ValueErrors."""

    def error(self, message: str) -> NoReturn:
        """Raise the error."""
        raise ValueError(message.removeprefix("argument "))


def main() -> int:
    """Run one job; the arguments: its kind, its folder, the memory limit in bytes, and those of ``dsr upsample``."""
    what, folder, memory, *arguments = sys.argv[1:]
    _OUTPUT.append(os.fdopen(os.dup(1), "w", encoding="ascii"))
    os.dup2(2, 1)  # leaves the standard output to :func:`send`: what libraries print goes where errors go
    _limit(int(memory))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        with refusing_excess():
            request = _request(Path(folder), arguments, None if what == "files" else _QUICK)
            _TASKS[what](request, Path(folder))
    except (ValueError, OSError, ArgumentTypeError) as error:
        send(problem=one_line(error))
    return 0


def _limit(memory: int) -> None:
    """Limit this process to some bytes of memory and files of moderate size, and let the system end it first."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource  # noqa: PLC0415 - Windows has none

        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
        resource.setrlimit(resource.RLIMIT_FSIZE, (_LARGEST_FILE, _LARGEST_FILE))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def _end_with_parent() -> None:
    """End this process when the server closes its standard input, or ends."""
    while os.read(0, 4096):  # not by sys.stdin, whose lock Python would want at its end
        pass
    os._exit(1)


def _request(folder: Path, arguments: Sequence[str], parts: str | None) -> UpsampleRequest:
    """Return what is asked for."""
    parser = _Parser("dsr upsample", add_help=False)
    add_options(parser, UpsampleRequest)
    only = [] if parts is None else [f"--only={parts}"]
    return build(UpsampleRequest, parser.parse_args([*arguments, f"--output={folder / RESULT}", *only]))


def _look(request: UpsampleRequest, _: Path) -> None:
    """List the frames, and send thumbnails of some."""
    from dsr.app.upsample.frames import find_frames  # noqa: PLC0415 - it takes seconds to import

    frames = find_frames(request)
    whole = frames.whole
    _send_found(frames)
    send(count=len(whole))
    names = [shorten(printable(pair.name), _LONGEST_NAME) for pair in whole[:_MOST_NAMES]]
    for first in range(0, len(names), _NAMES):
        send(names=names[first : first + _NAMES])
    if len(whole) > 1:
        step = max(1, len(whole) // _THUMBS)
        for number in range(0, len(whole), step):
            send(thumb=_thumb_of(whole[number]), frame=number + 1)


def _thumb_of(pair: Pair) -> str:
    """Return a small picture of a frame as a data URL; empty where the photo cannot be read."""
    from dsr.io.photos import data_url, read_photo, to_jpeg  # noqa: PLC0415

    with contextlib.suppress(ValueError, OSError):
        photo = None if pair.capture is None else pair.capture.photo
        pixels = read_photo(pair.rgb, (3, 4))[0] if photo is None else photo.read()
        return data_url(to_jpeg(pixels, _THUMB, 80))
    return ""


def _send_found(frames: Frames) -> None:
    """Send the notes that concern all frames together."""
    _tell(frames.found.assumptions)
    if frames.found.unpaired:
        send(note=f"files without a partner, left out: {len(frames.found.unpaired)}", warning=False)


def _upsample(request: UpsampleRequest) -> Path:
    """Upsample the frame, and return the folder of its result."""
    from dsr.app.upsample.frames import find_frames  # noqa: PLC0415
    from dsr.app.upsample.run import work_through  # noqa: PLC0415

    frames = find_frames(request)
    _send_found(frames)
    if len(frames.found.pairs) != 1:
        raise ValueError(f"expected one frame, got {len(frames.found.pairs)}")
    (done,) = work_through(request, frames, _tell, _Steps())
    if done.problem is not None:
        raise ValueError(done.problem)
    return done.target


def _result(request: UpsampleRequest, folder: Path) -> None:
    """Upsample the frame, and write what the page shows of it."""
    from dsr.app.upsample.stored import read_complete, read_result  # noqa: PLC0415
    from dsr.report.surface_page import content_of, data_of, pack_result  # noqa: PLC0415

    target = _upsample(request)
    send(stage="preparing the surfaces")
    viewed = read_result(target, "result")
    facts = {**(viewed.facts or {}), **_facts(viewed.camera, read_complete(target))}
    packed = pack_result(replace(viewed, facts=facts), _VERTICES, _PHOTO)
    shown = {"content": content_of([packed], "dsr app"), "data": data_of([packed])}
    (folder / SHOWN).write_text(json.dumps(shown), encoding="utf-8")


def _facts(camera: Camera, info: Mapping[str, Any]) -> dict[str, str]:
    """Return the camera and the unit as they were read."""
    from dsr.geometry.plausible import view_of  # noqa: PLC0415
    from dsr.utils.progress import show_length  # noqa: PLC0415

    depth = info["input_depth"]
    unit = f"{depth['unit']:g} pixels" if depth["range_type"] == "disparity" else show_length(depth["unit"])
    return {
        "camera as read": f"{view_of(camera):.1f} degrees wide, focal length {camera.fx:.0f} pixels",
        "unit as read": f"{unit} per value, {depth['range_type']}",
    }


def _files(request: UpsampleRequest, folder: Path) -> None:
    """Write all files of the result, the page of `dsr view` among them, and an archive of them."""
    from dsr.app.upsample.stored import read_result  # noqa: PLC0415
    from dsr.report.surface_page import pack_result, save_view  # noqa: PLC0415

    send(stage="writing cloud, mesh and pictures")
    target = _upsample(request)
    packed = pack_result(read_result(target, "result"), _VERTICES, _PHOTO)
    save_view(target / "view.html", [packed], title="Depth before and after")
    send(stage="packing the files")
    with zipfile.ZipFile(folder / ARCHIVE, "w", compresslevel=1) as archive:
        for path in sorted(target.rglob("*")):
            name = path.relative_to(target)
            if path.is_file() and not name.parts[0].startswith("."):
                kind = zipfile.ZIP_STORED if path.suffix in _PACKED else zipfile.ZIP_DEFLATED
                archive.write(path, Path("dsr-result") / name, kind)
    files = [path for path in (folder / ARCHIVE, target / "mesh.glb", target / "mesh.ply") if path.is_file()]
    send(files=[path.relative_to(folder).as_posix() for path in files], sizes=[path.stat().st_size for path in files])


_TASKS: dict[str, Callable[[UpsampleRequest, Path], None]] = {"look": _look, "result": _result, "files": _files}

if __name__ == "__main__":
    start("dsr.app.browser.work", "main")

"""The command behind ``dsr app``: a local web page that runs ``dsr upsample`` and ``dsr view`` on uploaded files.

Each command is a process of its own with limits of memory, file size and time, one at a time, so that a hostile file
ends in a line on the page. The page's address contains a token, which other accounts of the machine and other sites do
not know; its content security policy forbids the browser to ask any other server.
"""

import contextlib
import html
import os
import re
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import time
import webbrowser
from collections.abc import Awaitable, Callable, Generator, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from omegaconf import OmegaConf
from rich.console import Console

from dsr.app.requests import BrowserRequest
from dsr.inference import DEFAULT
from dsr.io.depth_files import READ_SUFFIXES
from dsr.io.layouts import CAPTURE_FILES
from dsr.io.pairs import PHOTO_SUFFIXES
from dsr.methods.recipe import list_methods, read_recipe
from dsr.utils.console import show
from dsr.utils.guards import free_memory, refusing
from dsr.utils.progress import megabytes
from dsr.utils.versions import how_to_install

_PRIVATE = {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_OFFLINE": "1"}
_POLICY = "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; frame-ancestors 'none'"
_LARGEST_FILE = 8 << 30
_BETWEEN_LOOKS = 0.3  # seconds
_KEPT = 3600  # seconds for which an upload is kept
_UNITS = ["mm", "cm", "m", "1/5000", "1/1000", "1/10000", "sunrgbd"]
_Shown = tuple[str, str, list[str] | None]  # what was said, the surfaces, and the files


def browse(request: BrowserRequest, console: Console) -> list[str]:
    """Serve the page until the process is interrupted; a ValueError if the port is taken."""
    try:
        listening = socket.create_server(("127.0.0.1", request.port))
    except OSError as error:
        reason = os.strerror(error.errno or 0)
        raise ValueError(f"--port {request.port}: expected a free port, got: {reason}") from error
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:  # the terminal is closed
        signal.signal(signal.SIGHUP, lambda *_: signal.raise_signal(signal.SIGTERM))
    token = secrets.token_urlsafe(24)
    url = f"http://127.0.0.1:{listening.getsockname()[1]}/{token}/"
    with TemporaryDirectory(prefix="dsr-app-") as folder, listening:
        os.environ |= {**_PRIVATE, "GRADIO_TEMP_DIR": str(Path(folder) / "uploads")}
        with refusing(f"`dsr app` needs gradio: {how_to_install('app')}", ImportError):
            import uvicorn  # noqa: PLC0415 - it is an extra, and Gradio reads the environment at import

            work = Work(request, Path(folder).resolve())
            app = make_app(work, f"/{token}")
        server = uvicorn.Server(uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=1))
        show(console, f"dsr app: {url}")
        show(console, "  Ctrl-C ends it, and deletes what was uploaded and computed")
        if request.open_page:
            webbrowser.open(url)  # it waits until the server answers
        try:
            server.run(sockets=[listening])
        except KeyboardInterrupt:
            raise KeyboardInterrupt("ended; the files that were uploaded, and their results, are deleted") from None
        finally:
            work.stop()
    return ["the server ended by itself"]


def offered() -> list[tuple[str, str]]:
    """Return labels and names of the methods that need no files of the user's, and do not optimise for minutes."""
    found = []
    for recipe in map(read_recipe, list_methods()):
        node = recipe.at(4)
        packaged = recipe.abilities.needs is None or "packaged" in node["weights"]
        if packaged and not OmegaConf.missing_keys(node) and not recipe.abilities.optimises:
            found.append((str(recipe.label), recipe.name))
    return found


class Work:
    """Runs commands on uploads, in processes with limits, and in a folder that is deleted with its results."""

    def __init__(self, request: BrowserRequest, folder: Path) -> None:
        self.request, self._folder = request, folder
        self.process: subprocess.Popen[bytes] | None = None

    def compute(self, capture: str | None, frame: int, options: Mapping[str, str | None]) -> Iterator[_Shown]:
        """Upsample a photo's depth map, or a frame of a capture, numbered from 1; yield what to show."""
        given = {flag: value for flag, value in options.items() if value}
        if bool(capture) == ({"--rgb", "--depth"} <= given.keys()):
            raise ValueError("expected a photo and a depth map, or a capture")
        arguments = [f"{flag}={value}" for flag, value in given.items()]
        with TemporaryDirectory(dir=self._folder) as place:
            result = Path(place) / "dsr-result"
            upsample = "upsample", f"--output={result.name}"
            if capture:
                count = "--dry-run", "--shard=1/999999999"  # counts the frames, and reads a sample of them
                text = yield from self._run(Path(place), "", *upsample, capture, *count)
                found = re.search(r"^(\d+) pairs of photo and depth map$", text, re.MULTILINE)
                frames = 1 if found is None else int(found[1])
                if frame not in range(1, frames + 1):
                    raise ValueError(f"frame: expected a number from 1 to {frames}, got {frame}")
                arguments += [capture, f"--shard={frame}/{frames}"]
            text = yield from self._run(Path(place), "", *upsample, *arguments)
            yield from self._run(Path(place), f"{text}preparing the surfaces\n", "view", result.name, "--no-open")
            page = html.escape((result / "view.html").read_text(encoding="utf-8"))
            surfaces = f'<iframe title="the surfaces" sandbox="allow-scripts" srcdoc="{page}"></iframe>'
            archive = shutil.make_archive(str(result), "zip", place, result.name)
            meshes = [str(path) for path in sorted(result.rglob("mesh.*"))]
            yield text, surfaces, [archive, *meshes]

    def stop(self) -> None:
        """End the process that is running."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def _run(self, place: Path, before: str, *arguments: str) -> Generator[_Shown, None, str]:
        """Run a command, and yield ``before`` and what it has said so far; a ValueError with its reason if it fails."""
        memory = free_memory()
        if self.request.max_memory is not None:
            memory = min(memory, int(1e9 * self.request.max_memory))
        end = time.monotonic() + self.request.max_seconds
        with (place / "said.txt").open("wb") as said:
            self.process = process = subprocess.Popen(  # noqa: S603 - files and checked choices
                [sys.executable, "-P", "-m", "dsr", *arguments],
                cwd=place,
                env={**os.environ, "TMPDIR": str(place)},
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is the server's
            )
        try:
            with contextlib.suppress(ImportError, AttributeError, ProcessLookupError):  # only Linux has it
                import resource  # noqa: PLC0415 - Windows has none

                resource.prlimit(process.pid, resource.RLIMIT_DATA, (memory, memory))
                resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (_LARGEST_FILE, _LARGEST_FILE))
            while process.poll() is None:
                yield before + self._said(place), "", None
                if time.monotonic() > end:
                    limit = self.request.max_seconds
                    raise ValueError(f"it took more than {limit:g} s (--max-seconds), and was ended")
                time.sleep(_BETWEEN_LOOKS)
        finally:
            self.stop()
        text = self._said(place)
        if process.returncode:
            problems = re.findall(r"^error: (.+)$", text, re.MULTILINE)
            ended = f"the process ended ({process.returncode}); it may need more than {megabytes(memory)} of memory"
            raise ValueError("; ".join(problems) or ended)
        return text

    def _said(self, place: Path) -> str:
        """Return what a command has said so far, without the folders of uploads and results."""
        text = (place / "said.txt").read_text(encoding="utf-8", errors="replace")
        return re.sub(rf"{re.escape(str(self._folder))}{os.sep}(uploads{os.sep})?[^{os.sep}\s]+{os.sep}", "", text)


def make_app(work: Work, path: str) -> Any:
    """Return the ASGI application that serves the page at a path, and nothing elsewhere."""
    import gradio as gr  # noqa: PLC0415 - it is an extra
    from fastapi import FastAPI, Request, Response  # noqa: PLC0415

    app = FastAPI(openapi_url=None)

    @app.middleware("http")
    async def confine(request: Request, answer: Callable[[Request], Awaitable[Response]]) -> Response:
        response = await answer(request)
        response.headers["content-security-policy"] = _POLICY
        response.headers["referrer-policy"] = "no-referrer"
        return response

    gr.mount_gradio_app(
        app, make_page(work), path, footer_links=[], run_history=False, ssr_mode=False, mcp_server=False,
        max_file_size=int(1e6 * work.request.max_upload), css="iframe { width: 100%; height: 85vh; border: 0; }",
    )  # fmt: skip
    return app


def make_page(work: Work) -> Any:
    """Return the page, a ``gradio.Blocks``: files and options on the left, the result on the right."""
    import gradio as gr  # noqa: PLC0415 - it is an extra

    def file(label: str, *suffixes: str) -> gr.File:
        return gr.File(label=label, file_types=list(suffixes), height=120)

    def compute(capture: str | None, frame: int, *given: str | None) -> Iterator[Any]:
        try:
            yield from work.compute(capture, frame, dict(zip(options, given, strict=True)))
        except (ValueError, OSError) as error:
            gr.Warning(html.escape(str(error)), duration=None)
            yield f"error: {error}", "", None

    ranges = ["orthogonal", "perspective", "disparity"]
    with gr.Blocks(title="dsr app", analytics_enabled=False, delete_cache=(_KEPT // 4, _KEPT), fill_width=True) as page:
        gr.Markdown("# Depth super-resolution\nThe files stay on this machine.")
        with gr.Row():
            with gr.Column(scale=1, min_width=320):
                with gr.Row():
                    photo, depth = file("Photo", *PHOTO_SUFFIXES), file("Depth map", *READ_SUFFIXES)
                capture = file("or a capture: .r3d, .zip, ...", *CAPTURE_FILES)
                frame = gr.Number(1, precision=0, label="Frame of the capture")
                with gr.Accordion("Camera file, mask", open=False), gr.Row():
                    camera, mask = file("Camera", ".json", ".txt"), file("Mask, 0 where depth is missing", ".png")
                with gr.Row():
                    unit = gr.Dropdown([("as in the files", ""), *_UNITS], value="", label="Unit of the depth")
                    fov = gr.Textbox(label="Field of view, degrees", placeholder="as in the files")
                with gr.Row():
                    range_type = gr.Dropdown([("as in the files", ""), *ranges], value="", label="Values are")
                    baseline = gr.Textbox(label="Baseline, metres", placeholder="of disparities")
                with gr.Row():
                    method = gr.Dropdown(offered(), value=DEFAULT, label="Method")
                    fill = gr.Dropdown(["small", "all", "none"], value="small", label="Holes that are filled")
                smooth = gr.Textbox(label="Smoothing by Facets, 0 (keeps what may be noise) to 2", placeholder="1")
                with gr.Row():
                    go = gr.Button("Compute", variant="primary", min_width=100)
                    cancel = gr.Button("Cancel", min_width=100)
                said = gr.Textbox(label="What was read and done", lines=6, max_lines=20, interactive=False)
            with gr.Column(scale=3, min_width=320):
                shown = gr.HTML(), gr.File(label="Results", interactive=False, height=140)
        options = {
            "--rgb": photo, "--depth": depth, "--camera": camera, "--mask": mask, "--depth-unit": unit, "--fov": fov,
            "--range-type": range_type, "--baseline": baseline, "--method": method, "--fill": fill, "--smooth": smooth,
        }  # fmt: skip
        given = [capture, frame, *options.values()]
        computing = go.click(compute, given, [said, *shown], concurrency_limit=1, api_visibility="private")
        cancel.click(None, cancels=computing)
    return page

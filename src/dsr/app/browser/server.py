"""The server of ``dsr app``: one page, uploads of limited size, and their results.

It answers this machine alone unless another address is asked for. Other accounts of the machine reach it, too: its page
is for those who know the token in the address that it prints. A page of another site can make a browser ask it: it
therefore refuses names of hosts that are not its own, which a stranger's name server may point here (DNS rebinding),
and accepts nothing without the token, which such a page does not have. Names of files that a page sends are not
used: a file is stored under its role with one of the suffixes that the readers know.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import re
import secrets
import signal
import socket
import threading
import webbrowser
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, get_args
from urllib.parse import urlsplit

from rich.console import Console

from dsr.app.browser.jobs import Desk, RefusedError, Upload
from dsr.app.browser.work import SHOWN, What
from dsr.app.requests import BrowserRequest
from dsr.io.captures.registry import CAPTURE_FILES
from dsr.io.depth_files import READ_SUFFIXES
from dsr.io.pairs import PHOTO_SUFFIXES
from dsr.report.html_page import asset, block, fill, json_text, policy
from dsr.report.surface_page import VIEWER
from dsr.utils.console import show
from dsr.utils.guards import parse_json, path_within, refusing
from dsr.utils.versions import how_to_install

with refusing(f"`dsr app` needs starlette and uvicorn: {how_to_install('app')}", ImportError):
    import uvicorn
    from starlette.applications import Starlette
    from starlette.exceptions import HTTPException
    from starlette.requests import ClientDisconnect, Request
    from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response
    from starlette.routing import Route

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

ROLES: Mapping[str, tuple[str, ...]] = {
    "photo": PHOTO_SUFFIXES,
    "depth": READ_SUFFIXES,
    "mask": (".png",),
    "camera": (".json", ".txt"),
    "capture": CAPTURE_FILES,
}
"""What a file can be, and the suffixes that it can have."""
_FLAGS = {"photo": "--rgb", "depth": "--depth", "mask": "--mask", "camera": "--camera"}
METHODS = ("facets", "tgv", "guided_filter", "fast_global_smoother", "joint_bilateral", "bicubic", "nearest")
"""Methods on the page: those that need no files of the user, and not minutes."""
_NUMBER = re.compile(r"[0-9]{0,9}\.?[0-9]{0,9}")
_OPTIONS: Mapping[str, tuple[str, re.Pattern[str]]] = {
    "unit": ("--depth-unit", re.compile(r"[a-z0-9./+-]{1,24}")),
    "range": ("--range-type", re.compile(r"[a-z]{1,24}")),
    "baseline": ("--baseline", _NUMBER),
    "fov": ("--fov", _NUMBER),
    "smooth": ("--smooth", _NUMBER),
    "noise": ("--noise", _NUMBER),
    "fill": ("--fill", re.compile(r"[a-z]{1,24}")),
    "min_confidence": ("--min-confidence", _NUMBER),
    "method": ("--method", re.compile("|".join(METHODS))),
}
"""Options of ``dsr upsample`` on the page: their flags, and what their texts can be; the command checks the values."""
_MOST_JSON = 1 << 16
_MOST_FRAMES = 10**9
_TOKEN = "x-dsr-token"  # noqa: S105 - the name of a header
_KEPT_SCRIPT = """\
const token = sessionStorage.getItem("token");
sessionStorage.removeItem("token");
if (token) location.replace(`/?token=${encodeURIComponent(token)}`);"""
"""Loads the page again with the token that the page has left for that, once."""
_CLOSED = f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>dsr app</title></head><body>
<p>This page opens at the address, with a token in it, that <code>dsr app</code> prints in its terminal.</p>
<script>{_KEPT_SCRIPT}</script></body></html>
"""
"""What is shown to those who come without the token."""
_HEADERS = {
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
}


@contextlib.contextmanager
def _ending_by_signal() -> Iterator[None]:
    """Within this context a closed terminal is a SIGTERM, and an interruption says that the files are deleted."""
    hangup = getattr(signal, "SIGHUP", None)  # Windows has none
    before = None if hangup is None else signal.getsignal(hangup)
    if before == signal.SIG_IGN or threading.current_thread() is not threading.main_thread():
        hangup = None  # nohup's command outlives the terminal
    try:
        if hangup is not None:
            signal.signal(hangup, lambda *_: signal.raise_signal(signal.SIGTERM))
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt("ended; the files that were uploaded, and their results, are deleted") from None
    finally:
        if hangup is not None:
            signal.signal(hangup, before or signal.SIG_DFL)


@_ending_by_signal()
def browse(request: BrowserRequest, console: Console) -> list[str]:
    """Serve the page until the process is interrupted.

    Raises:
        ValueError: the port is taken, or the address is not one of this machine.

    """
    listening = _listen(request.host, request.port)
    address = listening.getsockname()
    name = f"[{address[0]}]" if ":" in address[0] else address[0]
    url, token, once = f"http://{name}:{address[1]}/?token=", secrets.token_urlsafe(24), secrets.token_urlsafe(24)
    memory = None if request.max_memory is None else int(1e9 * request.max_memory)
    desk = Desk(int(request.max_upload * 1e6), request.max_seconds, memory)
    try:
        app = make_app(desk, request.host, token, once if request.open_page else "")
        config = uvicorn.Config(
            app, lifespan="off", ws="none", log_level="warning", access_log=False, server_header=False,
            limit_concurrency=64, timeout_graceful_shutdown=1,
        )  # fmt: skip
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, name="server", daemon=True)
        thread.start()  # signals are the main thread's
        show(console, f"dsr app: {url}{token}")
        if not _is_loopback(request.host):
            show(console, f"warning: whoever reads what is sent to {request.host} can use it: it is not encrypted")
        show(console, "  Ctrl-C ends it; nothing that was uploaded is kept then")
        if request.open_page:
            webbrowser.open(f"{url}{once}")  # other accounts see the arguments of the browser's process
        try:
            while thread.is_alive():
                thread.join(0.2)
        finally:
            server.should_exit = True
    finally:
        desk.close()
        listening.close()
    return ["the server ended by itself"]


def _listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens on an address of this machine.

    Raises:
        ValueError: it cannot.

    """
    try:
        family, kind, number, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind, number)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind(address)
            listening.listen()  # from here on no other account can take the port, and a browser waits for the server
        except OSError:
            listening.close()
            raise
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(
            f"--host {host} --port {port}: expected a free address of this machine, got: {reason}"
        ) from error
    return listening


def make_app(desk: Desk, host: str, token: str, once: str = "") -> ASGIApp:
    """Return the application.

    Args:
        desk: what holds uploads and does the jobs.
        host: the address that it is asked at.
        token: what those know who may use it: ``/?token=...`` is its page.
        once: another token that opens the page a single time; empty for none.

    """
    return _Guard(_Answers(desk, *_page(desk, token), token, once).application(), host, token)


def _page(desk: Desk, token: str) -> tuple[str, str]:
    """Return the page and its content security policy."""
    style = asset("view.css", "app.css")
    script = f'"use strict";\n{asset(*VIEWER, "app.js")}'
    settings = {
        "token": token,
        "header": _TOKEN,
        "most": desk.most_bytes,
        "seconds": desk.most_seconds,
        "suffixes": ROLES,
    }
    accept = {f"{role.upper()}_FILES": ",".join(ROLES[role]) for role in ("photo", "mask")}
    methods = "".join(f'<option value="{name}">{name.replace("_", " ")}</option>' for name in METHODS)
    parts = {
        "STYLE": style, "SCRIPT": script, "VIEWER": asset("viewer.html"), "METHODS": methods,
        "SETTINGS": block("settings", json_text(settings)), **accept,
    }  # fmt: skip
    allowed = policy(style, script, "data:")
    return fill("app.html", parts), f"{allowed}; connect-src 'self'; frame-ancestors 'none'"


class _Answers:
    """What is answered to requests that are let through.

    Args:
        desk: what holds uploads and does the jobs.
        page: the page.
        allowed: its content security policy.
        token: what opens it.
        once: what opens it a single time; empty for nothing.

    """

    def __init__(self, desk: Desk, page: str, allowed: str, token: str, once: str) -> None:
        self._desk, self._page, self._allowed, self._token, self._once = desk, page, allowed, token, once

    def application(self) -> Starlette:
        """Return what calls them."""
        one = "/uploads/{id}"
        return Starlette(
            routes=[
                Route("/", self.show_page),
                Route("/uploads", self.open, methods=["POST"]),
                Route(one, self.status),
                Route(one, self.forget, methods=["DELETE"]),
                Route(f"{one}/job", self.submit, methods=["POST"]),
                Route(f"{one}/job", self.cancel, methods=["DELETE"]),
                Route(f"{one}/shown", self.send_shown),
                Route(f"{one}/files/{{number:int}}", self.send_file),
                Route(f"{one}/{{role}}", self.take_file, methods=["PUT"]),
            ],
            exception_handlers={HTTPException: _refuse},
        )

    async def show_page(self, request: Request) -> Response:
        """Answer with the page; without the token with where to find it."""
        given = request.query_params.get("token", "")
        if self._once and _is_same(given, self._once):
            self._once = ""
        elif not _is_same(given, self._token):
            return HTMLResponse(_CLOSED, 403, {"content-security-policy": policy("", _KEPT_SCRIPT, "'none'")})
        return HTMLResponse(self._page, headers={"content-security-policy": self._allowed})

    async def open(self, request: Request) -> Response:
        """Open an upload, perhaps in place of another one."""
        return JSONResponse({"id": self._desk.open(request.query_params.get("replaces", "")).id})

    async def take_file(self, request: Request) -> Response:
        """Store a file of an upload, which is cut off at the limit."""
        upload = self._find(request)
        role, suffix = request.path_params["role"], request.query_params.get("suffix", "").lower()
        if suffix not in ROLES.get(role, ()):
            raise HTTPException(400, f"{role}: expected a file as {', '.join(ROLES.get(role, ()))}")
        path = upload.folder / f"{role}{suffix}"
        try:
            with path.open("xb") as file:
                async for chunk in request.stream():
                    upload.size += len(chunk)
                    if upload.size > self._desk.most_bytes:
                        self._desk.drop(upload.id)
                        problem = f"expected at most {self._desk.most_bytes / 1e6:g} MB (--max-upload), got more"
                        raise HTTPException(413, problem, {"connection": "close"})
                    file.write(chunk)
        except FileExistsError as error:
            raise HTTPException(409, f"{role}: it is there already") from error
        except (ClientDisconnect, OSError) as error:
            with contextlib.suppress(OSError):
                path.unlink()
            raise HTTPException(400, f"{role}: the file could not be stored") from error
        upload.files[role] = path
        return JSONResponse({})

    async def submit(self, request: Request) -> Response:
        """Begin a job."""
        upload, content = self._find(request), bytearray()
        async for chunk in request.stream():
            content += chunk
            if len(content) > _MOST_JSON:
                raise HTTPException(413, f"expected at most {_MOST_JSON} bytes", {"connection": "close"})
        try:
            asked = parse_json(bytes(content))
            if not isinstance(asked, dict) or asked.get("what") not in get_args(What):
                raise ValueError(f"expected what to do: {', '.join(get_args(What))}")
            self._desk.submit(upload, asked["what"], [*_files_of(upload), *_arguments(asked)])
        except ValueError as error:
            raise HTTPException(409 if isinstance(error, RefusedError) else 400, str(error)) from error
        return JSONResponse(self._desk.record(upload))

    async def status(self, request: Request) -> Response:
        """Answer with how far the job is."""
        return JSONResponse(self._desk.record(self._find(request)))

    async def cancel(self, request: Request) -> Response:
        """End the job."""
        upload = self._find(request)
        self._desk.cancel(upload)
        return JSONResponse(self._desk.record(upload))

    async def forget(self, request: Request) -> Response:
        """Delete an upload."""
        self._desk.drop(request.path_params["id"])
        return JSONResponse({})

    async def send_shown(self, request: Request) -> Response:
        """Send what the page shows."""
        path = self._find(request).work / SHOWN
        if not path.is_file():
            raise HTTPException(404, "there is no result")
        return FileResponse(path, media_type="application/json")

    async def send_file(self, request: Request) -> Response:
        """Send a file to keep."""
        upload, number = self._find(request), request.path_params["number"]
        files = self._desk.record(upload).get("files", [])
        if number >= len(files):
            raise HTTPException(404, "there is no such file")
        path = path_within(upload.work, files[number], "result")
        name = path.name if path.suffix != ".zip" else "dsr-result.zip"
        return FileResponse(path, media_type="application/octet-stream", filename=name)

    def _find(self, request: Request) -> Upload:
        """Return the upload that a request is about."""
        upload = self._desk.find(request.path_params["id"])
        if upload is None:
            raise HTTPException(404, "the upload is no longer there; choose the files again")
        return upload


async def _refuse(_: Request, error: Exception) -> Response:
    """Answer with the reason of a refusal."""
    assert isinstance(error, HTTPException)  # noqa: S101
    return JSONResponse({"problem": error.detail}, error.status_code, error.headers)


def _files_of(upload: Upload) -> list[str]:
    """Return the arguments that name the files of an upload.

    Raises:
        ValueError: they are no pair and no capture.

    """
    given = set(upload.files)
    if "capture" in given:
        if given & {"photo", "depth", "mask"}:
            raise ValueError("expected a capture, or a photo and a depth map, got both")
    elif not {"photo", "depth"} <= given:
        raise ValueError("expected a photo and a depth map, or a capture")
    flags = [f"{flag}={upload.files[role]}" for role, flag in _FLAGS.items() if role in given]
    return [*([str(upload.files["capture"])] if "capture" in given else []), *flags]


def _arguments(asked: Mapping[str, Any]) -> list[str]:
    """Return the arguments that the choices of a page stand for.

    Raises:
        ValueError: a choice is not what it can be.

    """
    choices = asked.get("choices", {})
    if not isinstance(choices, dict):
        raise ValueError("expected choices by name")
    found = []
    for name, text in choices.items():
        if name == "register":
            found += ["--register"] if text is True else []
            continue
        flag, form = _OPTIONS.get(name, ("", re.compile("")))
        if not flag or not isinstance(text, str) or not text or not form.fullmatch(text):
            raise ValueError(f"{flag or 'choices'}: expected another value, got {str(text)[:40]!r}")
        found.append(f"{flag}={text}")
    frame, count = asked.get("frame", 1), asked.get("count", 1)
    if not (type(frame) is type(count) is int and 1 <= frame <= count <= _MOST_FRAMES):
        raise ValueError(f"expected a frame of 1 to {count}, got {frame}")
    return found if count == 1 else [*found, f"--shard={frame}/{count}"]


class _Guard:
    """Lets through what comes from the application's own page, and adds headers to what is answered.

    Args:
        app: what answers.
        host: the address that it is asked at.
        token: what the page shows that it is the application's own by.

    """

    def __init__(self, app: ASGIApp, host: str, token: str) -> None:
        self._app, self._host, self._token = app, host.lower(), token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] != "http":
            return
        problem = self._problem(scope)

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                there = {name.lower() for name, _ in message["headers"]}
                more = [
                    (name.encode(), value.encode()) for name, value in _HEADERS.items() if name.encode() not in there
                ]
                message = {**message, "headers": [*message["headers"], *more]}
            await send(message)

        if problem is None:
            await self._app(scope, receive, answer)
            return
        body = json.dumps({"problem": problem[1]}).encode()
        headers = [(b"content-type", b"application/json"), (b"connection", b"close")]
        await answer({"type": "http.response.start", "status": problem[0], "headers": headers})
        await answer({"type": "http.response.body", "body": body})

    def _problem(self, scope: Scope) -> tuple[int, str] | None:
        """Return the status and the reason with which a request is refused; None if it is let through."""
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        host = headers.get("host", "")
        if not self._is_own(host):
            return 421, "this is not the host that was asked for"
        site = headers.get("sec-fetch-site", "none")
        if site not in ("same-origin", "none") and scope["path"] != "/":
            return 403, "asked by another site"
        if scope["method"] in ("GET", "HEAD"):
            return None
        origin = headers.get("origin")
        if origin is not None and not _is_of(origin, host):
            return 403, "asked by another site"
        if not _is_same(headers.get(_TOKEN, ""), self._token):
            return 403, "asked by another page than that of this server; load the page again"
        return None

    def _is_own(self, host: str) -> bool:
        """Return whether a Host header names this server; a number cannot be another's name for it."""
        with contextlib.suppress(ValueError):
            if "@" in host:
                return False
            name = (urlsplit(f"//{host}").hostname or "").lower()
            if name in ("localhost", self._host) or (
                not _is_loopback(self._host) and name == socket.gethostname().lower()
            ):
                return True
            return ipaddress.ip_address(name).is_loopback or not _is_loopback(self._host)
        return False


def _is_of(origin: str, host: str) -> bool:
    """Return whether an Origin header names a host."""
    with contextlib.suppress(ValueError):
        return urlsplit(origin).netloc.lower() == host.lower()
    return False


def _is_same(given: str, token: str) -> bool:
    """Return whether a token is the right one, in constant time."""
    return secrets.compare_digest(given.encode(errors="surrogatepass"), token.encode())


def _is_loopback(host: str) -> bool:
    """Return whether an address is this machine's own, which no other one reaches."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"

"""The server of ``dsr app``: one page, uploads that are cut off at a limit, and what is made of them.

It answers this machine alone unless another address is asked for. A page of another site can make a browser ask it, too:
it therefore refuses names of hosts that are not its own, which a stranger's name server may point here (DNS rebinding),
and takes nothing without the token that only its own page has. Names of files that a page sends are not used: a file is
stored under its role with one of the suffixes that the readers know.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import re
import secrets
import socket
import threading
import webbrowser
from collections.abc import Mapping
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from rich.console import Console

from dsr.app.browser.jobs import Desk, RefusedError, Upload
from dsr.app.browser.work import SHOWN
from dsr.app.requests import BrowserRequest
from dsr.io.depth_files import READ_SUFFIXES
from dsr.io.layouts import CAPTURE_FILES
from dsr.io.pairs import PHOTO_SUFFIXES
from dsr.report.html_page import asset, block, fill, json_text, policy
from dsr.report.surface_page import VIEWER
from dsr.utils.console import show
from dsr.utils.guards import parse_json, path_within

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response
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
_ENDING = 3.0
"""Seconds that the server has to end."""
_HEADERS = {
    "cache-control": "no-store",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
}


class _TooLargeError(Exception):
    """An upload is larger than allowed."""


def browse(request: BrowserRequest, console: Console) -> list[str]:
    """Serve the page until the process is interrupted.

    Raises:
        ValueError: the libraries are missing.
        OSError: the port is taken.

    """
    if find_spec("starlette") is None or find_spec("uvicorn") is None:
        raise ValueError("`dsr app` needs the libraries starlette and uvicorn: pip install dsr[app]")
    import uvicorn  # noqa: PLC0415 - an extra

    listening = _listen(request.host, request.port)
    address = listening.getsockname()
    name = f"[{address[0]}]" if ":" in address[0] else address[0]
    url = f"http://{name}:{address[1]}/"
    desk = Desk(int(request.max_upload * 1e6), request.max_seconds, request.memory)
    try:
        app = make_app(desk, request.host)
        config = uvicorn.Config(
            app, lifespan="off", ws="none", log_level="warning", access_log=False, server_header=False,
            limit_concurrency=64, timeout_graceful_shutdown=1,
        )  # fmt: skip
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, name="server", daemon=True)
        thread.start()  # signals are the main thread's
        show(console, f"dsr app: {url}")
        if not _is_loopback(request.host):
            show(
                console, f"warning: whoever reaches {request.host} can use it: there is neither password nor encryption"
            )
        show(console, "  Ctrl-C ends it; nothing that was uploaded is kept then")
        if request.open_page:
            webbrowser.open(url)
        try:
            while thread.is_alive():
                thread.join(0.2)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("ended; the files that were uploaded, and their results, are deleted") from None
        finally:
            server.should_exit = True
    finally:
        desk.close()
        listening.close()
    return ["the server ended by itself"]


def _listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens on an address of this machine.

    Raises:
        OSError: it cannot; the message has the address.

    """
    try:
        family, kind, number, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind, number)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind(address)
        except OSError:
            listening.close()
            raise
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(
            f"--host {host} --port {port}: expected a free address of this machine, got: {reason}"
        ) from error
    return listening


def make_app(desk: Desk, host: str) -> ASGIApp:
    """Return the application.

    Args:
        desk: what holds uploads and does the jobs.
        host: the address that it is asked at.

    """
    token = secrets.token_urlsafe(24)
    return _Guard(_routes(desk, *_page(desk, token)), host, token)


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
    accept = {f"{role.upper()}_FILES": ",".join(suffixes) for role, suffixes in ROLES.items()}
    methods = "".join(f'<option value="{name}">{name.replace("_", " ")}</option>' for name in METHODS)
    parts = {
        "STYLE": style, "SCRIPT": script, "VIEWER": asset("viewer.html"), "METHODS": methods,
        "SETTINGS": block("settings", json_text(settings)), **accept,
    }  # fmt: skip
    allowed = policy(style, script, "data:")
    return fill("app.html", parts), f"{allowed}; connect-src 'self'; frame-ancestors 'none'"


def _routes(desk: Desk, page: str, allowed: str) -> Starlette:
    """Return what answers the requests that are let through."""
    from starlette.applications import Starlette  # noqa: PLC0415 - an extra
    from starlette.requests import ClientDisconnect  # noqa: PLC0415
    from starlette.responses import FileResponse, HTMLResponse, JSONResponse  # noqa: PLC0415
    from starlette.routing import Route  # noqa: PLC0415

    def refused(status: int, problem: str) -> Response:
        return JSONResponse({"problem": problem}, status)

    gone = "the upload is no longer there; choose the files again"

    async def show_page(_: Request) -> Response:
        return HTMLResponse(page, headers={"content-security-policy": allowed})

    async def open_upload(request: Request) -> Response:
        return JSONResponse({"id": desk.open(request.query_params.get("replaces", "")).id})

    async def take_file(request: Request) -> Response:
        upload = desk.find(request.path_params["id"])
        role, suffix = request.path_params["role"], request.query_params.get("suffix", "").lower()
        if upload is None:
            return refused(404, gone)
        if suffix not in ROLES.get(role, ()):
            return refused(400, f"{role}: expected a file as {', '.join(ROLES.get(role, ()))}")
        path = upload.folder / f"{role}{suffix}"
        try:
            with path.open("xb") as file:
                async for chunk in request.stream():
                    upload.size += len(chunk)
                    if upload.size > desk.most_bytes:
                        raise _TooLargeError
                    file.write(chunk)
        except (_TooLargeError, ClientDisconnect, OSError) as error:
            with contextlib.suppress(OSError):
                path.unlink()
            if isinstance(error, _TooLargeError):
                desk.drop(upload.id)
                problem = f"expected at most {desk.most_bytes / 1e6:g} MB (--max-upload), got more"
                return JSONResponse({"problem": problem}, 413, {"connection": "close"})
            return refused(400, f"{role}: the file could not be stored")
        upload.files[role] = path
        return JSONResponse({})

    async def submit(request: Request) -> Response:
        upload = desk.find(request.path_params["id"])
        if upload is None:
            return refused(404, gone)
        content = bytearray()
        async for chunk in request.stream():
            content += chunk
            if len(content) > _MOST_JSON:
                return refused(413, "expected less")
        try:
            asked = parse_json(bytes(content))
            if not isinstance(asked, dict) or asked.get("what") not in ("look", "result", "files"):
                raise ValueError("expected what to do: look, result or files")
            desk.submit(upload, asked["what"], [*_files_of(upload), *_arguments(asked)])
        except ValueError as error:
            return refused(409 if isinstance(error, RefusedError) else 400, str(error))
        return JSONResponse(desk.record(upload))

    async def tell(request: Request) -> Response:
        upload = desk.find(request.path_params["id"])
        return refused(404, gone) if upload is None else JSONResponse(desk.record(upload))

    async def cancel(request: Request) -> Response:
        upload = desk.find(request.path_params["id"])
        if upload is None:
            return refused(404, gone)
        desk.cancel(upload)
        return JSONResponse(desk.record(upload))

    async def forget(request: Request) -> Response:
        desk.drop(request.path_params["id"])
        return JSONResponse({})

    async def shown(request: Request) -> Response:
        upload = desk.find(request.path_params["id"])
        if upload is None or not (upload.work / SHOWN).is_file():
            return refused(404, "there is no result")
        return FileResponse(upload.work / SHOWN, media_type="application/json")

    async def download(request: Request) -> Response:
        upload, number = desk.find(request.path_params["id"]), request.path_params["number"]
        files = [] if upload is None else desk.record(upload).get("files", [])
        if upload is None or number >= len(files):
            return refused(404, "there is no such file")
        path = path_within(upload.work, files[number], "result")
        name = path.name if path.suffix != ".zip" else "dsr-result.zip"
        return FileResponse(path, media_type="application/octet-stream", filename=name)

    return Starlette(
        routes=[
            Route("/", show_page),
            Route("/uploads", open_upload, methods=["POST"]),
            Route("/uploads/{id}", tell),
            Route("/uploads/{id}", forget, methods=["DELETE"]),
            Route("/uploads/{id}/job", submit, methods=["POST"]),
            Route("/uploads/{id}/job", cancel, methods=["DELETE"]),
            Route("/uploads/{id}/shown", shown),
            Route("/uploads/{id}/files/{number:int}", download),
            Route("/uploads/{id}/{role}", take_file, methods=["PUT"]),
        ]
    )


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
        if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
            return 403, "asked by another site"
        if not secrets.compare_digest(headers.get(_TOKEN, "").encode(), self._token.encode()):
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


def _is_loopback(host: str) -> bool:
    """Return whether an address is this machine's own, which no other one reaches."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"

"""A server of files that breaks off, stalls, lies or has changed."""

import contextlib
import threading
from http.server import BaseHTTPRequestHandler

from dsr.data.download import fetching

PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 1600
DATES = ("Mon, 01 Jan 2024 00:00:00 GMT", "Tue, 02 Jan 2024 00:00:00 GMT")


class Handler(BaseHTTPRequestHandler):
    """Sends ``server.files``.

    One number of ``server.cuts`` per answer is where the connection breaks off. As long as ``server.go_on`` is not set,
    an answer stops after half of the file.
    """

    protocol_version = "HTTP/1.1"

    def do_GET(self):
        server, wanted = self.server, self.headers.get("Range")
        content = server.files.get(self.path)
        status = server.states.pop(0) if server.states else 200
        if content is None or status != 200:
            server.log.append((self.path, wanted, 0))
            self.send_error(404 if content is None else status)
            return
        start = 0
        if wanted and server.ranges and self.headers["If-Range"] in server.marks.values():
            start, status = int(wanted.removeprefix("bytes=").removesuffix("-")), 206
        if start and start >= len(content):
            server.log.append((self.path, wanted, 0))
            self.answer(416, {"Content-Range": f"bytes */{len(content)}"}, b"", None)
            return
        headers = {"Content-Range": f"bytes {start}-{len(content) - 1}/{len(content)}"} if start else {}
        cut = server.cuts.pop(0) if server.cuts else None
        server.log.append((self.path, wanted, len(content) - start if cut is None else cut))
        self.answer(status, {**headers, **server.marks, **server.headers}, content[start:], cut)

    def answer(self, status, headers, content, cut):
        self.send_response(status)
        for key, value in {**headers, "Content-Length": len(content)}.items():
            self.send_header(key, str(value))
        self.end_headers()
        half = len(content) // 2
        self.wfile.write(content[:half][:cut])
        self.wfile.flush()
        self.server.go_on.wait(30)
        with contextlib.suppress(OSError):  # it has gone
            self.wfile.write(content[half:cut])
        if cut is not None:
            self.close_connection = True

    def log_message(self, *_):
        pass


def serving(serve, monkeypatch, files):
    """Start a server of files by path, which is asked again without a pause."""
    monkeypatch.setattr(fetching, "RETRIES", fetching.RETRIES.new(total=2, backoff_factor=0))
    running = serve(Handler)
    running.files, running.states, running.cuts, running.log = files, [], [], []
    running.ranges, running.marks, running.headers = True, {"Last-Modified": DATES[0]}, {}
    running.go_on = threading.Event()
    running.go_on.set()
    return running

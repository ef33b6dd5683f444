"""The server of `dsr app` in a thread of the tests' process, and a client that asks it as its page does."""

import contextlib
import http.client
import json
import socket
import threading
import time
from pathlib import Path

import uvicorn

from dsr.app.browser.jobs import Desk
from dsr.app.browser.server import make_app

HEADER = "x-dsr-token"
TOKEN, ONCE = "the-token", "another-one"


class Client:
    """Asks a server; ``token`` is that of its page, whose address is ``page``."""

    def __init__(self, port, desk, token):
        self.port, self.desk, self.token = port, desk, token
        self.page = f"http://127.0.0.1:{port}/?token={token}"

    def ask(self, method, path, body=None, token="", **headers):
        """Return status, content and headers of the answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        own = {HEADER: self.token} if token == "" else {HEADER: token} if token else {}
        own |= {name.replace("_", "-"): value for name, value in headers.items()}
        with contextlib.closing(connection):
            connection.request(method, path, body=body, headers=own)
            answer = connection.getresponse()
            return answer.status, answer.read(), dict(answer.getheaders())

    def json(self, method, path, body=None, status=200):
        found, content, _ = self.ask(method, path, None if body is None else json.dumps(body))
        assert found == status, content
        return json.loads(content)

    def upload(self, **files):
        """Send files by role, and return the upload's address."""
        place = f"/uploads/{self.json('POST', '/uploads')['id']}"
        for role, path in files.items():
            self.send(place, role, path.suffix, path.read_bytes())
        return place

    def send(self, place, role, suffix, content, status=200):
        found, answer, _ = self.ask("PUT", f"{place}/{role}?suffix={suffix}", content)
        assert found == status, answer
        return json.loads(answer)

    def start(self, place, what="result", **more):
        return self.json("POST", f"{place}/job", {"what": what, **more})

    def finish(self, place, seconds=200):
        """Return an upload's job at its end."""
        end = time.monotonic() + seconds
        while (job := self.json("GET", place))["state"] in ("waiting", "running"):
            assert time.monotonic() < end, job
            time.sleep(0.1)
        return job

    def run(self, place, what="result", **more):
        self.start(place, what, **more)
        return self.finish(place)

    def files(self):
        """Return all that the server holds on the disk."""
        return {path.relative_to(self.desk.folder).name for path in Path(self.desk.folder).rglob("*") if path.is_file()}


@contextlib.contextmanager
def serving(host="127.0.0.1", most_bytes=10**7, most_seconds=200.0, **more):
    """Return a context in which the application answers on a free port, with a client for it."""
    listening = socket.create_server(("127.0.0.1", 0))
    desk = Desk(most_bytes, most_seconds, **more)
    app = make_app(desk, host, TOKEN, ONCE)
    server = uvicorn.Server(uvicorn.Config(app, lifespan="off", ws="none", log_level="warning"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    try:
        yield Client(listening.getsockname()[1], desk, TOKEN)
    finally:
        server.should_exit = True
        desk.close()
        thread.join()
        listening.close()
        assert not desk.folder.exists()

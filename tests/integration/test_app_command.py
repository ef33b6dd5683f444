"""`dsr app`: what its server takes, what it refuses, what it keeps, and that it ends whatever it is given."""

import contextlib
import io
import os
import re
import signal
import socket
import stat
import subprocess
import sys
import time
import zipfile

import bombs
import captures
import cv2
import numpy as np
import pytest
import trimesh
from app_server import ONCE, Client, serving
from small_results import waves

from dsr.app.browser.jobs import Desk
from dsr.app.upsample.stored import read_result
from dsr.cli import main

QUICK = {"method": "bicubic"}


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A photo and a depth map of a quarter of its size, with a hole."""
    folder = tmp_path_factory.mktemp("pair")
    v, u = np.mgrid[:64, :64].astype(np.uint8)
    cv2.imwrite(str(folder / "photo.png"), np.stack((2 * u, 2 * v, 200 - u), -1))
    cv2.imwrite(str(folder / "depth.png"), np.nan_to_num(1000 * waves()[::4, ::4]).astype(np.uint16))
    return {"photo": folder / "photo.png", "depth": folder / "depth.png"}


@pytest.fixture(scope="module")
def client():
    with serving() as made:
        yield made


def is_gone(process):
    return process.poll() is not None


def test_only_its_own_page_is_answered(client):
    local = f"127.0.0.1:{client.port}"
    page = f"/?token={client.token}"
    for host in (f"localhost:{client.port}", f"[::1]:{client.port}", local):
        assert client.ask("GET", page, Host=host)[0] == 200
    for host in (
        "evil.example",
        f"evil.example:{client.port}",
        "127.0.0.1.evil.example",
        "192.168.1.9",
        "",
        "[",
        "@127.0.0.1",
    ):
        assert client.ask("GET", page, Host=host)[0] == 421
    for more in (
        {"Origin": "http://evil.example"}, {"Origin": "null"}, {"Origin": "http://127.0.0.1:1"}, {"Origin": "http://["},
        {"Sec_Fetch_Site": "cross-site"}, {"Sec_Fetch_Site": "same-site"}, {"token": None}, {"token": "guess"},
    ):  # fmt: skip
        assert client.ask("POST", "/uploads", **more)[0] == 403
    place = client.upload()
    assert client.ask("GET", place, Sec_Fetch_Site="cross-site")[0] == 403
    assert client.ask("DELETE", place, token=None)[0] == 403
    assert client.ask("POST", "/uploads", Origin=f"http://{local}", Sec_Fetch_Site="same-origin")[0] == 200


def test_numbers_are_hosts_of_a_server_that_others_reach_and_foreign_names_are_not():
    with serving("0.0.0.0") as open_to_all:
        page = f"/?token={open_to_all.token}"
        assert open_to_all.ask("GET", page, Host="192.168.1.9:80")[0] == 200
        assert open_to_all.ask("GET", page, Host=socket.gethostname())[0] == 200
        assert open_to_all.ask("GET", page, Host="evil.example")[0] == 421


def test_page_is_for_those_who_know_the_token(client):
    for path in ("/", "/?token=", "/?token=guess", f"/?token={client.token}x", "/?token=%ff", "/?token=%ed%a0%80"):
        status, content, headers = client.ask("GET", path, token=None)
        assert (status, client.token in content.decode()) == (403, False)
        assert "unsafe" not in headers["content-security-policy"]
    assert [client.ask("GET", f"/?token={ONCE}", token=None)[0] for _ in range(2)] == [200, 403]
    assert client.token in client.ask("GET", f"/?token={client.token}", token=None)[1].decode()


def test_page_has_everything_in_it_and_may_ask_this_server_alone(client):
    _, content, headers = client.ask("GET", f"/?token={client.token}")
    page = content.decode()
    assert re.findall(r'(?:src|href)="(?!#|data:)([^"]*)"', page) == []
    rules = dict(part.strip().split(" ", 1) for part in headers["content-security-policy"].split(";"))
    assert rules["default-src"] == rules["frame-ancestors"] == rules["form-action"] == rules["base-uri"] == "'none'"
    assert rules["connect-src"] == "'self'"
    assert "unsafe" not in headers["content-security-policy"]
    assert headers["cache-control"] == "no-store"
    assert headers["x-content-type-options"] == "nosniff"


def test_upload_is_cut_off_at_the_limit_while_it_is_sent():
    with serving(most_bytes=100_000) as client:
        place = client.upload()
        client.send(place, "photo", ".jpg", bytes(60_000))
        with socket.create_connection(("127.0.0.1", client.port), timeout=60) as connection:
            head = f"PUT {place}/depth?suffix=.png HTTP/1.1\r\nHost: localhost\r\nx-dsr-token: {client.token}\r\n"
            connection.sendall(f"{head}Content-Length: {10**9}\r\n\r\n".encode())
            answer, sent = b"", 0
            connection.settimeout(0.05)
            with contextlib.suppress(ConnectionError):
                while not answer and sent < 10**8:
                    sent += connection.send(bytes(10_000))
                    with contextlib.suppress(TimeoutError):
                        answer = connection.recv(1000)
        assert b" 413 " in answer.splitlines()[0]
        assert sent < 10**7
        assert client.files() == set()
        assert client.ask("GET", place)[0] == 404


def test_names_of_files_are_no_paths(client, tmp_path):
    place = client.upload()
    for suffix in ("", ".sh", "/../../x.png", "..%2F..%2Fx.png", "%00.png", ".png/../x"):
        assert client.ask("PUT", f"{place}/photo?suffix={suffix}", b"x")[0] == 400
    for role in ("..", "..%2Fx", "job", "script"):
        assert client.ask("PUT", f"{place}/{role}?suffix=.png", b"x")[0] in (400, 404, 405)
    before = client.files()
    client.send(place, "photo", ".PNG", b"x")
    assert client.files() - before == {"photo.png"}
    assert client.ask("PUT", f"{place}/photo?suffix=.png", b"y")[0] == 409
    assert "photo.png" in client.files()
    assert client.ask("GET", f"{place}/files/0")[0] == 404
    assert client.ask("GET", "/uploads/..%2F..%2Fetc/shown")[0] == 404


@pytest.mark.parametrize(
    "asked",
    [
        {"what": "result"}, {"what": "shell"}, [], {"what": "look", "choices": {"output": "/tmp"}},
        {"what": "result", "choices": {"unit": "mm --output=/tmp/x"}},
        {"what": "result", "choices": {"method": "onnx"}},
        {"what": "result", "choices": {"fov": "-1"}}, {"what": "result", "choices": {"fov": 60}},
        {"what": "result", "frame": 4, "count": 3}, {"what": "result", "frame": "1", "count": 3},
        {"what": "result", "frame": True, "count": 10}, {"what": "result", "choices": []},
    ],
)  # fmt: skip
def test_what_the_page_cannot_ask_is_refused(client, pair, asked):
    place = client.upload(**(pair if asked != {"what": "result"} else {"photo": pair["photo"]}))
    assert client.json("POST", f"{place}/job", asked, status=400)["problem"]


def test_pair_becomes_what_the_command_makes_of_it(client, pair, tmp_path):
    place = client.upload(**pair)
    job = client.run(place, choices={**QUICK, "unit": "1/500", "fov": "70"})
    assert (job["state"], job["problem"]) == ("done", "")
    assert all(str(client.desk.folder) not in note["note"] for note in job["notes"])
    shown = client.json("GET", f"{place}/shown")["content"]["results"][0]
    assert shown["facts"]["camera as read"].startswith("70.0 degrees")
    assert shown["facts"]["unit as read"].startswith("2 mm per value")
    assert shown["filled"] > 0

    job = client.run(place, "files")
    assert job["state"] == "done"
    assert [name.rpartition("/")[2] for name in job["files"]][:2] == ["result.zip", "mesh.glb"]
    status, content, headers = client.ask("GET", f"{place}/files/0")
    assert (status, len(content)) == (200, job["sizes"][0])
    assert headers["content-disposition"] == 'attachment; filename="dsr-result.zip"'
    with zipfile.ZipFile(io.BytesIO(content)) as packed:
        assert packed.testzip() is None
        packed.extractall(tmp_path)
    names = {path.name for path in (tmp_path / "dsr-result").iterdir()}
    assert {"view.html", "info.json", "mesh.glb"} <= names
    mesh = trimesh.load(io.BytesIO(client.ask("GET", f"{place}/files/1")[1]), file_type="glb", force="mesh")
    assert len(mesh.faces) > 1000

    command = ["upsample", "--rgb", str(pair["photo"]), "--depth", str(pair["depth"]), "--method", "bicubic"]
    assert main([*command, "--depth-unit", "1/500", "--fov", "70", "-o", str(tmp_path / "out")]) == 0
    here, there = (read_result(tmp_path / name, name) for name in ("dsr-result", "out"))
    assert np.array_equal(here.depth, there.depth, equal_nan=True)
    assert names - {"view.html"} == {path.name for path in (tmp_path / "out").iterdir()}


def test_frame_of_a_capture_is_chosen(client, tmp_path):
    place = client.upload(capture=captures.record3d(tmp_path / "scan.r3d"))
    assert "one frame" in client.run(place, choices=QUICK)["problem"]  # before any is computed
    assert client.json("GET", place)["total"] == 0
    looked = client.run(place, "look")
    assert (looked["count"], len(looked["names"]), len(looked["thumbs"])) == (3, 3, 3)
    job = client.run(place, choices=QUICK, frame=3, count=looked["count"])
    assert job["state"] == "done"
    facts = client.json("GET", f"{place}/shown")["content"]["results"][0]["facts"]
    middle = float(re.search(r"median ([\d.]+) m", facts["depth"])[1])
    assert middle == pytest.approx(np.median(captures.depth(2)), abs=0.02)
    assert f"focal length {captures.INTRINSICS[0] + 2:.0f} pixels" in facts["camera as read"]


def link(path):
    """Write a ZIP file with a link to a file of the system."""
    with zipfile.ZipFile(path, "w") as packed:
        entry = zipfile.ZipInfo("rgb.png")
        entry.external_attr = (stat.S_IFLNK | 0o777) << 16
        packed.writestr(entry, "/etc/passwd")
    return path


def bomb(path):
    """Write a ZIP file of zeros that unpacks to 600 MB."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as packed:
        bombs.zeros(packed, "depth.npy", b"", bombs.LARGE)
    return path


@pytest.mark.parametrize(("write", "reason"), [(link, "refused"), (bomb, "bytes")])
def test_hostile_archive_is_refused_in_one_line_and_leaves_nothing(client, tmp_path, write, reason):
    place = client.upload(capture=write(tmp_path / "hostile.zip"))
    job = client.run(place, "look")
    assert job["state"] == "failed"
    assert reason in job["problem"]
    assert "\n" not in job["problem"]
    client.json("DELETE", place)
    assert client.ask("GET", place)[0] == 404


def test_computation_ends_at_its_limits_of_time_and_memory(pair):
    with serving(most_seconds=0.5) as client:
        assert "--max-seconds" in client.run(client.upload(**pair))["problem"]
    with serving(most_memory=100 << 20) as client:
        job = client.run(client.upload(**pair))
        assert (job["state"], "memory" in job["problem"]) == ("failed", True)


def test_waiting_and_running_computations_are_cancelled_and_replaced_uploads_are_deleted(client, pair):
    first, second = client.upload(**pair), client.upload(**pair)
    client.start(first)
    assert client.start(second)["state"] == "waiting"
    until(lambda: client.json("GET", first)["state"] == "running")
    process = client.desk.find(first.rpartition("/")[2]).job.process
    assert client.json("GET", second)["before"] == 1
    assert client.json("DELETE", f"{second}/job")["state"] == "cancelled"
    assert client.json("DELETE", f"{first}/job")["state"] == "cancelled"
    assert is_gone(process)
    folder = client.desk.find(first.rpartition("/")[2]).folder
    client.json("POST", f"/uploads?replaces={first.rpartition('/')[2]}")
    assert not folder.exists()
    assert client.ask("GET", first)[0] == 404


def test_uploads_are_deleted_after_a_while(pair, monkeypatch):
    monkeypatch.setattr("dsr.app.browser.jobs._BETWEEN_LOOKS", 0.05)
    desk = Desk(10**6, 10.0, kept=0.2)
    upload = desk.open()
    assert upload.folder.is_dir()
    assert stat.S_IMODE(desk.folder.stat().st_mode) == 0o700
    until(lambda: not upload.folder.exists())
    assert desk.find(upload.id) is None
    desk.close()
    assert not desk.folder.exists()


@pytest.mark.skipif(os.name == "nt", reason="needs signals of POSIX")
@pytest.mark.parametrize(
    ("number", "host", "code"),
    [("SIGINT", "127.0.0.1", 130), ("SIGTERM", "0.0.0.0", 143)],
)
def test_command_serves_its_page_and_leaves_nothing_at_its_end(tmp_path, pair, number, host, code):
    command = [sys.executable, "-m", "dsr", "app", "--no-open", "--port", "0", "--host", host]
    process = subprocess.Popen(command, env={**os.environ, "TMPDIR": str(tmp_path)}, stdout=subprocess.PIPE, text=True)
    lines = [process.stdout.readline()]
    port, token = re.search(r":(\d+)/\?token=(\S+)", lines[0]).groups()
    client = Client(int(port), None, token)
    until(lambda: answers(client.port))
    place = client.upload(**pair)
    client.start(place)
    until(lambda: client.json("GET", place)["state"] == "running")
    assert any(tmp_path.iterdir())
    process.send_signal(getattr(signal, number))
    assert process.wait(60) == code
    assert ("warning" in process.stdout.read()) == (host != "127.0.0.1")
    process.stdout.close()
    assert list(tmp_path.iterdir()) == []


def answers(port):
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=5):
        return True
    return False


def until(holds, seconds=60):
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)

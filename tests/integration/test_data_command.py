"""``dsr data`` as it is typed: what it says, fetches and leaves, and how it ends."""

import os
import pty
import select
import signal
import subprocess
import sys
import threading
import time
import types
from http.server import BaseHTTPRequestHandler

import pytest

from dsr import cli
from dsr.data.download import fetching
from dsr.data.download.collections import Collection, Item

PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 1000
NAMES = [f"middlebury2003/{scene}/{name}" for scene in ("cones", "teddy") for name in ("im2.png", "disp2.png")]


class Mirror(BaseHTTPRequestHandler):
    """Has ``server.files``; an answer stops after half of the file for as long as ``server.go_on`` is not set."""

    def do_GET(self):
        content, start = self.server.files.get(self.path), 0
        if content is None:
            self.send_error(404)
            return
        if "Range" in self.headers:
            start = int(self.headers["Range"].removeprefix("bytes=").removesuffix("-"))
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(len(content) - start))
        self.send_header("ETag", '"1"')
        self.end_headers()
        self.server.log.append((self.path, start))
        half = max(len(content) // 2, start)
        self.wfile.write(content[start:half])
        self.wfile.flush()
        self.server.go_on.wait(30)
        with_rest = content[half:]
        try:
            self.wfile.write(with_rest)
        except OSError:  # it has gone
            self.close_connection = True

    def log_message(self, *_):
        pass


@pytest.fixture
def mirror(monkeypatch, serve):
    monkeypatch.setattr(fetching, "RETRIES", fetching.RETRIES.new(total=1, backoff_factor=0))
    server = serve(Mirror)
    server.files = {f"/{name}": PNG + name.encode() for name in NAMES}
    server.log, server.go_on = [], threading.Event()
    server.go_on.set()
    yield server
    server.go_on.set()


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("DSR_DATA", str(tmp_path / "data"))
    return tmp_path / "data"


def command(*arguments):
    return [sys.executable, "-m", "dsr.cli", *arguments]


def run(*arguments):
    return subprocess.run(command(*arguments), capture_output=True, text=True, timeout=60, check=False)


def in_process(capsys, *arguments, catalogue=None):
    """Return the exit code and the lines of both streams."""
    code = cli.main(arguments, catalogue)
    said = capsys.readouterr()
    return code, said.out.splitlines(), said.err.splitlines()


def mine(*items, **fields):
    return {"mine": Collection("mine", "Mine", "https://page", "Free.", "Me, 2020.", ("set",), 3e6, items, **fields)}


def test_dataset_is_fetched_listed_verified_and_not_fetched_twice(mirror, root):
    done = run("data", "get", "middlebury2003", "--mirror", mirror.url)
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert lines[0] == "middlebury2003: Middlebury 2003, cones and teddy, about 1.0 MB"
    before = "\n".join(lines[: lines.index(f"4 of 4 files are missing in {root}")])
    for word in ("https://vision.middlebury.edu/stereo/data/scenes2003/", "licence", "Scharstein", "CVPR 2003"):
        assert word in before
    assert lines[-5:] == [*(f"{name}: 0.3 MB" for name in NAMES), "middlebury2003: complete"]
    for name in NAMES:
        assert (root / name).read_bytes() == PNG + name.encode()
    assert [path for path, _ in mirror.log] == [f"/{name}" for name in NAMES]

    listed = run("data", "list")
    assert (listed.returncode, listed.stderr) == (0, "")
    rows = {line.split()[0]: line for line in listed.stdout.splitlines()}
    assert rows["middlebury2003"].split()[-2:] == ["complete", "noted"]
    assert rows["middlebury2006"].split()[-2:] == ["absent", "unknown"]
    assert rows["tofmark"].split()[-2:] == ["manual", "unknown"]

    checked = run("data", "verify", "middlebury2003")
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, "middlebury2003: complete, as recorded\n", "")

    again = run("data", "get", "middlebury2003", "--mirror", mirror.url)
    assert again.returncode == 0
    assert f"0 of 4 files are missing in {root}" in again.stdout
    assert len(mirror.log) == 4


def test_interrupted_command_resumes(mirror, root):
    mirror.go_on.clear()
    get = ("data", "get", "middlebury2003", "--mirror", mirror.url)
    process = subprocess.Popen(
        command(*get),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # noqa: PLW1509
    )
    part, end = root / f"{NAMES[0]}.part", time.monotonic() + 30
    while time.monotonic() < end and not (part.is_file() and part.stat().st_size):
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors) == (
        130,
        "interrupted; what is finished is kept, the same command continues from there\n",
    )
    had = part.stat().st_size
    assert not (root / NAMES[0]).exists()
    mirror.go_on.set()
    assert run(*get).returncode == 0
    assert mirror.log[:2] == [(f"/{NAMES[0]}", 0), (f"/{NAMES[0]}", had)]
    assert (root / NAMES[0]).read_bytes() == PNG + NAMES[0].encode()
    assert not part.exists()


def test_command_asks_before_the_first_byte_on_a_terminal(mirror, root):
    for answer, code, there in ((b"n\n", 0, False), (b"y\n", 0, True)):
        ours, theirs = pty.openpty()
        process = subprocess.Popen(
            command("data", "get", "middlebury2003", "--mirror", mirror.url),
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env={**os.environ, "TERM": "xterm", "COLUMNS": "100"},
        )
        os.close(theirs)
        said = b""
        while b"[Y/n]" not in said:
            assert select.select([ours], [], [], 30)[0], said
            said += os.read(ours, 1024)
        assert b"Scharstein" in said
        assert not mirror.log
        os.write(ours, answer)
        reader = threading.Thread(target=drain, args=(ours,))
        reader.start()
        assert process.wait(60) == code
        reader.join()
        os.close(ours)
        assert (root / NAMES[-1]).exists() is there


def drain(terminal):
    """Read until the other side is closed."""
    try:
        while os.read(terminal, 1024):
            pass
    except OSError:  # how Linux says so
        pass


def test_file_found_nowhere_is_one_line_and_the_others_come(mirror, root, capsys):
    items = [Item(f"set/{number}.png", (f"{mirror.url}/{name}",)) for number, name in enumerate(("gone", NAMES[0]))]
    code, _, errors = in_process(capsys, "data", "get", "mine", catalogue=mine(*items))
    assert (code, errors) == (2, [f"error: set/0.png: {mirror.url}/gone: HTTP 404 Not Found"])
    assert (root / "set/1.png").exists()
    code, lines, _ = in_process(capsys, "data", "list", catalogue=mine(*items))
    assert code == 0
    assert lines[-1].split() == ["mine", "Mine", "3.0", "MB", "partial", "1", "of", "2", "1", "unknown,", "1", "noted"]


def test_damaged_file_is_found_and_fetched_again(mirror, root, capsys):
    get = ("data", "get", "middlebury2003", "--mirror", mirror.url)
    assert in_process(capsys, *get)[0] == 0
    path = root / NAMES[1]
    path.write_bytes(PNG[:-1] + b"?" + NAMES[1].encode())
    code, lines, errors = in_process(capsys, "data", "verify", "middlebury2003")
    assert (code, len(errors)) == (2, 1)
    assert errors[0].startswith(f"error: {path}: expected sha256 ")
    assert lines == ["middlebury2003: `dsr data get middlebury2003` fetches what is missing or damaged"]
    code, lines, _ = in_process(capsys, *get)
    assert code == 0
    assert any(line.endswith(": fetching it again") for line in lines)
    assert path.read_bytes() == PNG + NAMES[1].encode()


def test_changed_file_is_refused_until_it_is_accepted(mirror, root, capsys):
    catalogue = mine(Item("set/a.png", (f"{mirror.url}/{NAMES[0]}",)))
    assert in_process(capsys, "data", "get", "mine", catalogue=catalogue)[0] == 0
    (root / "set/a.png").unlink()
    mirror.files[f"/{NAMES[0]}"] = PNG
    code, _, errors = in_process(capsys, "data", "get", "mine", catalogue=catalogue)
    assert (code, len(errors)) == (2, 1)
    assert "--accept-changed" in errors[0]
    assert in_process(capsys, "data", "get", "mine", "--accept-changed", catalogue=catalogue)[0] == 0
    assert in_process(capsys, "data", "verify", "mine", catalogue=catalogue)[0] == 0


def test_manual_route_names_the_files_places_and_checks_them(root, capsys):
    for task in ("get", "verify"):
        code, lines, errors = in_process(capsys, "data", task, "tofmark")
        assert (code, len(errors)) == (2, 1)
        assert f"put benchmarking_dataset_*.mat into {root / 'tofmark'}, then `dsr data verify tofmark`" in errors[0]
    (root / "tofmark").mkdir(parents=True)
    (root / "tofmark/benchmarking_dataset_books.mat").write_bytes(b"MATLAB 5.0 MAT-file")
    code, lines, errors = in_process(capsys, "data", "verify", "tofmark")
    assert (code, errors, lines[-1]) == (0, [], "tofmark: complete, as recorded")
    assert "recorded as found: tofmark/benchmarking_dataset_books.mat" in lines[0]
    assert in_process(capsys, "data", "get", "tofmark")[0] == 0
    (root / "tofmark/benchmarking_dataset_books.mat").write_bytes(b"MATLAB 5.0 another")
    assert in_process(capsys, "data", "verify", "tofmark")[0] == 2


def test_manual_route_takes_photos_in_any_folder(root, capsys):
    for name, content in (("20200509112638_RGB.jpg", b"\xff\xd8\xff\xe0"), ("20200509112638_HR_gt.png", PNG)):
        path = root / "rgbdd/portraits/portraits_test/20200509112638" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    code, lines, errors = in_process(capsys, "data", "verify", "rgbdd")
    assert (code, errors, lines[-1]) == (0, [], "rgbdd: complete, as recorded")
    path.with_name("20200509112638_RGB.jpg").write_bytes(b"GIF89a")
    assert "expected a .jpg file" in in_process(capsys, "data", "verify", "rgbdd")[2][0]


def test_locations_of_the_datasets_are_printed(root, capsys):
    code, lines, _ = in_process(capsys, "data", "where")
    assert (code, lines[0]) == (0, str(root))
    assert ["icl", str(root / "icl_nuim")] in [line.split() for line in lines[1:]]
    assert in_process(capsys, "data", "where", "icl") == (0, [str(root / "icl_nuim")], [])


@pytest.mark.parametrize("task", ["get", "verify", "where"])
def test_unknown_name_is_one_line_with_the_known_ones(root, capsys, task):
    code, lines, errors = in_process(capsys, "data", task, "middelbury")
    assert (code, lines, len(errors)) == (2, [], 1)
    assert errors[0].startswith("error: middelbury: unknown data set; expected some of middlebury, middlebury_train, ")
    assert not root.exists()


def test_invalid_mirror_address_is_one_line(root, capsys):
    code, _, errors = in_process(capsys, "data", "get", "nyu", "--mirror", "/mnt/data")
    assert (code, errors) == (
        2,
        ["error: --mirror: expected an address that begins with http:// or https://, got '/mnt/data'"],
    )


@pytest.mark.parametrize("arguments", [("--help",), ("data", "--help"), ("data", "get", "--help")])
def test_help_has_examples(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    assert caught.value.code == 0
    said = capsys.readouterr().out
    assert "dsr data get" in said
    assert all(len(line) <= 120 for line in said.splitlines())


def test_doctor_exit_code_is_that_of_the_command(tmp_path, monkeypatch):
    doctor = types.ModuleType("dsr.doctor.examine")
    seen = []
    doctor.examine_directory = lambda *given: seen.append(given) or 3
    monkeypatch.setitem(sys.modules, "dsr.doctor.examine", doctor)
    assert cli.main(["doctor", str(tmp_path)]) == 3
    assert seen == [(tmp_path, None)]

"""Fetching data sets: from a server of its own that breaks off, lies, has changed or is not there at all."""

import contextlib
import hashlib
import io
import json
import re
import shutil
import socket
import tarfile
import zipfile
from collections import namedtuple
from dataclasses import replace
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest

from dsr.cli import data_tasks, main
from dsr.data.download import fetching
from dsr.data.download.collections import Collection, Item
from dsr.data.download.fetching import Checksums, get, lock_directory, state, verify
from dsr.utils.progress import Progress

PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 1600
OTHER = b"\x89PNG\r\n\x1a\n" + bytes(range(255, -1, -1)) * 1600
PAGE = b"\n<!DOCTYPE html><html><body>Not here any more</body></html>"
DATES = ("Mon, 01 Jan 2024 00:00:00 GMT", "Tue, 02 Jan 2024 00:00:00 GMT")


class Handler(BaseHTTPRequestHandler):
    """Sends ``server.files``; one number of ``server.cuts`` per answer is where the connection breaks off."""

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
        self.wfile.write(content[:cut])
        if cut is not None:
            self.close_connection = True

    def log_message(self, *_):
        pass


@pytest.fixture
def server(monkeypatch, serve):
    monkeypatch.setattr(fetching, "RETRIES", fetching.RETRIES.new(total=2, backoff_factor=0))
    running = serve(Handler)
    running.files, running.states, running.cuts, running.log = {"/a.png": PNG}, [], [], []
    running.ranges, running.marks, running.headers = True, {"Last-Modified": DATES[0]}, {}
    return running


class Watcher(Progress):
    """Keeps what it gets; ``stop_at`` bytes of a transfer are an interruption."""

    def __init__(self, stop_at=None):
        self.lines, self.names, self.stop_at = [], [], stop_at

    def say(self, line):
        self.lines.append(line)

    @contextlib.contextmanager
    def task(self, name, total=None, *, done=0, unit="items"):
        self.names.append(name)
        yield self.moved

    def moved(self, done, total=None, remark=None):
        assert total is None or 0 <= done <= total
        if self.stop_at is not None and done >= self.stop_at:
            raise KeyboardInterrupt


def picture(server, *paths, name="a.png"):
    return Item(f"set/{name}", tuple(f"{server.url}{path}" for path in paths or ("/a.png",)))


def fetched(items, root, **options):
    items = [items] if isinstance(items, Item) else items
    return get(items, root, Watcher(), **options)


def one_line(problems, *parts):
    assert len(problems) == 1
    assert "\n" not in problems[0]
    for part in parts:
        assert str(part) in problems[0], (part, problems[0])


def left_in(root):
    """Return the files in ``root``, without those for the command's own use."""
    own = ("checksums.json", ".dsr-data.lock")
    return sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file() and path.name not in own)


def sha256(content):
    return hashlib.sha256(content).hexdigest()


def test_file_is_fetched_recorded_and_not_requested_again(server, tmp_path):
    item = picture(server)
    assert fetched(item, tmp_path) == []
    assert (tmp_path / "set/a.png").read_bytes() == PNG
    entries = json.loads((tmp_path / "checksums.json").read_text())
    assert entries == {"set/a.png": {"sha256": sha256(PNG), "size": len(PNG)}}
    assert left_in(tmp_path) == ["set/a.png"]
    assert fetched([item, item], tmp_path) == []
    assert len(server.log) == 1


def test_broken_connection_resumes_where_it_stopped(server, tmp_path):
    server.cuts = [200_000, 100_000]
    assert fetched(picture(server), tmp_path) == []
    assert (tmp_path / "set/a.png").read_bytes() == PNG
    first, second, third = (None if wanted is None else int(wanted[6:-1]) for _, wanted, _ in server.log)
    assert first is None
    assert 100_000 < second <= 200_000 < third <= second + 100_000  # at most a piece that was under way is lost
    assert server.log[-1][2] == len(PNG) - third


def test_later_command_resumes_a_partial_file(server, tmp_path):
    server.cuts = [200_000, 0]
    one_line(fetched(picture(server), tmp_path), "set/a.png: ", f"{server.url}/a.png: ", "broke off")
    had = (tmp_path / "set/a.png.part").read_bytes()
    assert PNG.startswith(had)
    assert len(had) > 100_000
    assert not (tmp_path / "set/a.png").exists()
    assert fetched(picture(server), tmp_path) == []
    assert server.log[-1] == ("/a.png", f"bytes={len(had)}-", len(PNG) - len(had))
    assert (tmp_path / "set/a.png").read_bytes() == PNG
    assert left_in(tmp_path) == ["set/a.png"]


def test_interruption_keeps_the_partial_file(server, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        get([picture(server)], tmp_path, Watcher(stop_at=200_000))
    assert left_in(tmp_path) == ["set/a.png.part"]
    had = (tmp_path / "set/a.png.part").stat().st_size
    assert had >= 200_000
    assert fetched(picture(server), tmp_path) == []
    assert server.log[-1][1:] == (f"bytes={had}-", len(PNG) - had)


def test_file_that_changed_in_between_starts_anew(server, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        get([picture(server)], tmp_path, Watcher(stop_at=200_000))
    server.files["/a.png"], server.marks = OTHER, {"Last-Modified": DATES[1]}
    assert fetched(picture(server), tmp_path) == []
    assert server.log[-1][2] == len(OTHER)
    assert (tmp_path / "set/a.png").read_bytes() == OTHER


def test_file_that_came_whole_before_an_interruption_is_not_fetched_again(server, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        get([picture(server)], tmp_path, Watcher(stop_at=len(PNG)))
    assert fetched(picture(server), tmp_path) == []
    assert [sent for _, _, sent in server.log] == [len(PNG), 0]
    assert (tmp_path / "set/a.png").read_bytes() == PNG


@pytest.mark.parametrize("state", [{"ranges": False}, {"marks": {}}])
def test_server_without_ranges_or_dates_sends_the_file_anew(server, tmp_path, state):
    vars(server).update(state)
    server.cuts = [200_000]
    assert fetched(picture(server), tmp_path) == []
    assert [sent for _, _, sent in server.log] == [200_000, len(PNG)]
    assert (tmp_path / "set/a.png").read_bytes() == PNG


def test_busy_server_is_retried(server, tmp_path):
    server.states = [503, 429]
    assert fetched(picture(server), tmp_path) == []
    assert len(server.log) == 3


def test_second_address_is_used_where_the_first_lacks_the_file(server, tmp_path):
    assert fetched(picture(server, "/gone.png", "/a.png"), tmp_path) == []
    assert [path for path, _, _ in server.log] == ["/gone.png", "/a.png"]
    assert (tmp_path / "set/a.png").read_bytes() == PNG


def test_file_found_nowhere_is_one_line_and_the_others_come(server, tmp_path):
    items = [picture(server, "/gone.png", "/lost.png", name="x.png"), picture(server)]
    one_line(
        fetched(items, tmp_path),
        f"set/x.png: {server.url}/gone.png: HTTP 404 Not Found; {server.url}/lost.png: HTTP 404 Not Found",
    )
    assert left_in(tmp_path) == ["set/a.png"]


def test_unreachable_server_is_one_line_per_file(server, tmp_path):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        gone = f"http://127.0.0.1:{closed.getsockname()[1]}"
        items = [Item(f"set/{name}", (f"{gone}/{name}",)) for name in ("x.png", "y.png")]
        problems = fetched([*items, picture(server)], tmp_path)
    assert [problem.split(": ", 1)[0] for problem in problems] == ["set/x.png", "set/y.png"]
    for problem in problems:
        one_line([problem], f"{gone}/", f"no connection to {gone.removeprefix('http://')}")
    assert left_in(tmp_path) == ["set/a.png"]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.png", b"GIF89a nothing"), ("a.zip", PNG), ("a.tar.gz", PNG), ("a.pfm", PNG), ("a.txt", b"\0\1"),
        ("a.mat", PNG), ("a.ppm", PNG), ("a.pgm", PNG), ("a.npy", PNG), ("a.txt", PAGE), ("a.png", b""),
    ],
)  # fmt: skip
def test_file_of_the_wrong_kind_is_refused(server, tmp_path, name, content):
    server.files["/a.png"] = content
    problems = fetched(picture(server, name=name), tmp_path)
    one_line(problems, f"set/{name}: {server.url}/a.png: expected a {Path(name).suffix} file, got one that begins with")
    assert left_in(tmp_path) == []


@pytest.mark.parametrize("pinned", [False, True])
def test_other_checksum_than_recorded_or_pinned_is_refused(server, tmp_path, pinned):
    item = replace(picture(server), sha256=sha256(PNG) if pinned else None)
    fetched(item, tmp_path)
    (tmp_path / "set/a.png").unlink()
    server.files["/a.png"] = OTHER
    known = "which dsr knows" if pinned else f"as recorded in {tmp_path / 'checksums.json'}"
    cure = "" if pinned else "; if the new one is right, delete the entry there"
    expected = f"{server.url}/a.png: expected sha256 {sha256(PNG)}, {known}, got {sha256(OTHER)}{cure}"
    one_line(fetched(item, tmp_path), expected)
    assert left_in(tmp_path) == []
    assert Checksums(tmp_path)["set/a.png"].sha256 == sha256(PNG)


def test_mirror_is_asked_first_under_the_same_path(server, tmp_path):
    server.files["/mirror/set/a.png"] = PNG
    assert fetched(picture(server), tmp_path, mirror=f"{server.url}/mirror/") == []
    assert [path for path, _, _ in server.log] == ["/mirror/set/a.png"]
    assert fetched(picture(server, name="b.png"), tmp_path, mirror=f"{server.url}/mirror") == []
    assert [path for path, _, _ in server.log[1:]] == ["/mirror/set/b.png", "/a.png"]


def test_archive_member_stands_for_a_file(server, tmp_path):
    server.files["/two.zip"] = zipped({"Art/view1.png": PNG, "Art/view5.png": OTHER})
    assert fetched(picture(server, "/gone.png", "/two.zip#Art/view1.png"), tmp_path) == []
    assert (tmp_path / "set/a.png").read_bytes() == PNG
    assert left_in(tmp_path) == ["set/a.png"]
    problems = fetched(picture(server, "/two.zip#Art/view7.png", name="b.png"), tmp_path)
    one_line(problems, "set/b.png: ", "view7.png")
    server.files["/two.zip"] = b"PK no archive"
    one_line(fetched(picture(server, "/two.zip#Art/view1.png", name="c.png"), tmp_path), "expected an archive")


def test_disk_too_small_for_the_file_is_refused_before_a_byte_is_written(server, tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**9, 10**9, 100_000))
    problems = fetched([picture(server), picture(server, name="b.png")], tmp_path)
    one_line(
        problems,
        "set/a.png: ",
        f"{tmp_path / 'set/a.png.part'}: expected 0.4 MB to write the file, got a device with 0.1 MB",
    )
    assert left_in(tmp_path) == []


def zipped(files):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as packed:
        for name, content in files.items():
            packed.writestr(name, content)
    return buffer.getvalue()


def tarred(files, *members):
    """Return a tar.gz of files, and of members with a type of their own, (name, type, target)."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as packed:
        for name, content in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            packed.addfile(member, io.BytesIO(content))
        for name, kind, target in members:
            member = tarfile.TarInfo(name)
            member.type, member.linkname = kind, target
            packed.addfile(member)
    return buffer.getvalue()


def archive(server, name, content, contains=("rgb",)):
    server.files[f"/{name}"] = content
    return Item(f"set/{name}", (f"{server.url}/{name}",), unpack_to="set/room", contains=contains)


FILES = {"rgb/1.png": PNG, "rgb/2.png": OTHER, "list.txt": b"1\n2\n"}
PACKED = {"s.zip": zipped(FILES), "s.tar.gz": tarred({f"./{name}": content for name, content in FILES.items()})}


@pytest.mark.parametrize("name", PACKED)
def test_archive_is_unpacked_recorded_and_removed(server, tmp_path, name):
    item = archive(server, name, PACKED[name])
    assert fetched(item, tmp_path) == []
    assert left_in(tmp_path) == ["set/room/list.txt", "set/room/rgb/1.png", "set/room/rgb/2.png"]
    for path, content in FILES.items():
        assert (tmp_path / "set/room" / path).read_bytes() == content
    entry = json.loads((tmp_path / "checksums.json").read_text())[f"set/{name}"]
    assert entry == {
        "sha256": sha256(PACKED[name]),
        "size": len(PACKED[name]),
        "files": {path: len(content) for path, content in FILES.items()},
    }
    assert fetched(item, tmp_path) == []
    assert len(server.log) == 1


OUTSIDE = {
    "up in a zip": ("s.zip", zipped({"rgb/1.png": PNG, "../evil.txt": b"evil"})),
    "up inside": ("s.zip", zipped({"rgb/../../../evil.txt": b"evil"})),
    "backslashes": ("s.zip", zipped({"rgb\\..\\..\\evil.txt": b"evil"})),
    "a drive": ("s.zip", zipped({"C:/evil.txt": b"evil"})),
    "absolute": ("s.tar.gz", tarred({"rgb/1.png": PNG, "/tmp/dsr_evil.txt": b"evil"})),
    "up in a tar": ("s.tar.gz", tarred({"../evil.txt": b"evil"})),
    "a link up": ("s.tar.gz", tarred({"rgb/1.png": PNG}, ("rgb/evil", tarfile.SYMTYPE, "../../evil.txt"))),
    "an absolute link": ("s.tar.gz", tarred({}, ("evil", tarfile.SYMTYPE, "/etc/passwd"))),
    "a hard link up": ("s.tar.gz", tarred({}, ("rgb/evil", tarfile.LNKTYPE, "../evil.txt"))),
    "a device": ("s.tar.gz", tarred({}, ("evil", tarfile.CHRTYPE, ""))),
    "a pipe": ("s.tar.gz", tarred({}, ("evil", tarfile.FIFOTYPE, ""))),
}


@pytest.mark.parametrize("case", OUTSIDE)
def test_archive_with_paths_outside_is_refused_before_anything_is_unpacked(server, tmp_path, case):
    root = tmp_path / "a" / "b"
    (tmp_path / "a" / "evil.txt").parent.mkdir()
    name, content = OUTSIDE[case]
    one_line(fetched(archive(server, name, content), root), f"{root / 'set' / name}: refused: ", "evil")
    assert left_in(tmp_path / "a") == [f"b/set/{name}"]
    assert not Path("/tmp/dsr_evil.txt").exists()


def test_link_in_a_zip_is_refused(server, tmp_path):
    member = zipfile.ZipInfo("rgb/evil")
    member.external_attr = 0o120777 << 16
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as packed:
        packed.writestr(member, "../../evil.txt")
    one_line(fetched(archive(server, "s.zip", buffer.getvalue()), tmp_path), "'rgb/evil' in it is neither a file nor")


@pytest.mark.parametrize("name", PACKED)
@pytest.mark.parametrize("share", [0.2, 0.7])
def test_truncated_archive_is_refused_and_nothing_of_it_left(server, tmp_path, name, share):
    content = PACKED[name][: int(len(PACKED[name]) * share)]
    one_line(
        fetched(archive(server, name, content), tmp_path), f"{tmp_path / 'set' / name}: expected an archive, got a"
    )
    assert left_in(tmp_path) == [f"set/{name}"]


def test_archive_of_other_files_is_refused(server, tmp_path):
    problems = fetched(archive(server, "s.zip", PACKED["s.zip"], ("rgb", "depth")), tmp_path)
    one_line(problems, "expected depth in it, there is none")
    assert left_in(tmp_path) == ["set/s.zip"]


def test_interrupted_unpacking_leaves_nothing_and_needs_no_second_download(server, tmp_path, monkeypatch):
    item = archive(server, "s.zip", PACKED["s.zip"])

    def interrupted(source, sink, _):
        sink.write(source.read(1000))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "copyfileobj", interrupted)
        with pytest.raises(KeyboardInterrupt):
            fetched(item, tmp_path)
    assert left_in(tmp_path) == ["set/s.zip"]
    assert fetched(item, tmp_path) == []
    assert len(server.log) == 1


def collection(*items, **fields):
    return Collection("mine", "Mine", "https://page", "free", "Me.", ("set",), None, items, **fields)


def verified(of, root):
    watcher = Watcher()
    return verify(of, root, watcher), watcher.lines


def test_damaged_file_is_named_with_both_checksums_and_fetched_again(server, tmp_path):
    item = picture(server)
    fetched(item, tmp_path)
    (tmp_path / "set/a.png").write_bytes(OTHER)
    problems, _ = verified(collection(item), tmp_path)
    one_line(problems, f"{tmp_path / 'set/a.png'}: expected sha256 {sha256(PNG)}, as recorded", f"got {sha256(OTHER)}")
    assert fetched(item, tmp_path) == []
    assert (tmp_path / "set/a.png").read_bytes() == PNG


def test_verification_names_files_of_another_size_and_missing_ones(server, tmp_path):
    items = picture(server), picture(server, name="b.png"), archive(server, "s.zip", PACKED["s.zip"])
    fetched(items, tmp_path)
    assert verified(collection(*items), tmp_path) == ([], [])
    (tmp_path / "set/a.png").write_bytes(PNG[:-1])
    (tmp_path / "set/b.png").unlink()
    (tmp_path / "set/room/rgb/2.png").write_bytes(b"")
    problems, _ = verified(collection(*items), tmp_path)
    assert problems == [
        f"{tmp_path / 'set/a.png'}: expected {len(PNG)} bytes as recorded, got {len(PNG) - 1}",
        f"{tmp_path / 'set/b.png'}: expected a file, there is none",
        f"{tmp_path / 'set/room/rgb/2.png'}: expected {len(OTHER)} bytes as recorded, got 0",
    ]


def test_files_from_elsewhere_are_recorded_as_they_are(server, tmp_path):
    item = picture(server)
    (tmp_path / "set").mkdir()
    (tmp_path / "set/a.png").write_bytes(PNG)
    assert verified(collection(item), tmp_path) == ([], [f"{tmp_path}/checksums.json: recorded as found: set/a.png"])
    (tmp_path / "set/b.png").write_bytes(PNG)
    (tmp_path / "set/c.png").write_bytes(PNG)
    items, watcher = [picture(server, name=f"{name}.png") for name in "bca"], Watcher()
    assert get(items, tmp_path, watcher) == []
    assert watcher.lines == [f"{tmp_path}/checksums.json: recorded as found: set/{name}.png" for name in "bc"]
    assert server.log == []
    assert Checksums(tmp_path)["set/b.png"].sha256 == sha256(PNG)


MANUAL = collection(manual="put *.mat into {folder}", patterns=("*.mat", "*/P*/*.png"))


def test_manual_route_names_what_is_missing_and_its_place(tmp_path):
    problems, _ = verified(MANUAL, tmp_path)
    assert [problem.split(": ")[1] for problem in problems] == [
        "expected *.mat, there is none",
        "expected */P*/*.png, there is none",
    ]
    for problem in problems:
        assert problem.startswith(f"{tmp_path / 'set'}: ")
        assert f"put *.mat into {tmp_path / 'set'}, then `dsr data verify mine`" in problem


def test_manual_route_records_once_and_checks_afterwards(tmp_path):
    for name, content in {"set/a.mat": b"MATLAB 5.0", "set/sea/P000/1.png": PNG}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    recorded = f"{tmp_path}/checksums.json: recorded as found: set/a.mat, set/sea/P000/1.png"
    assert verified(MANUAL, tmp_path) == ([], [recorded])
    assert verified(MANUAL, tmp_path) == ([], [])
    (tmp_path / "set/a.mat").write_bytes(b"MATLAB 7.3")
    (tmp_path / "set/sea/P000/1.png").rename(tmp_path / "set/sea/P000/2.png")
    problems, _ = verified(MANUAL, tmp_path)
    assert len(problems) == 2
    assert "set/sea/P000/1.png: expected a file as recorded, there is none" in problems[0]
    assert f"got {sha256(b'MATLAB 7.3')}" in problems[1]


def test_collection_state_is_reported(server, tmp_path):
    items = picture(server), picture(server, name="b.png"), archive(server, "s.zip", PACKED["s.zip"])
    assert state(collection(*items), tmp_path) == "absent"
    fetched(items[0], tmp_path)
    assert state(collection(*items), tmp_path) == "partial 1 of 3"
    fetched(items, tmp_path)
    assert state(collection(*items), tmp_path) == "complete"
    (tmp_path / "set/room/rgb/2.png").unlink()
    assert state(collection(*items), tmp_path) == "partial 2 of 3"
    assert state(MANUAL, tmp_path) == "manual"
    (tmp_path / "set/sea/P000").mkdir(parents=True)
    (tmp_path / "set/sea/P000/1.png").write_bytes(PNG)
    (tmp_path / "set/a.mat").write_bytes(b"MATLAB")
    assert state(MANUAL, tmp_path) == "complete"


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "3", '{"a": 3}', '{"a": {"size": "3"}}', '{"a": {"size": 3, "sha256": 5}}']
)
def test_damaged_records_are_one_line(server, tmp_path, text):
    (tmp_path / "checksums.json").write_text(text)
    with pytest.raises(ValueError, match="expected the checksums of the data sets") as caught:
        fetched(picture(server), tmp_path)
    one_line([str(caught.value)], tmp_path / "checksums.json")


def test_second_command_is_refused_while_one_writes(server, tmp_path):
    with lock_directory(tmp_path), pytest.raises(ValueError, match="another `dsr data` command"):
        fetched(picture(server), tmp_path)
    assert fetched(picture(server), tmp_path) == []


def test_list_shows_which_checksums_are_pinned_noted_and_unknown(server, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("DSR_DATA", str(tmp_path))
    server.files |= {"/b.png": PNG, "/c.png": PNG}
    items = [replace(picture(server, f"/{name}.png", name=f"{name}.png"), sha256=digest)
             for name, digest in (("a", sha256(PNG)), ("b", None), ("c", None))]  # fmt: skip

    def of(items, name):
        return Collection(name, "A set", "", "", "", ("set",), None, tuple(items))

    catalogue = {name: of(some, name) for name, some in (("all", items), ("one", items[:1]), ("two", items[1:2]))}
    catalogue["mine"] = replace(
        catalogue["one"], items=(), manual="put it there", patterns=("*.png",), folders=("mine",)
    )
    monkeypatch.setattr(data_tasks, "downloads", lambda: catalogue)

    def listed():
        assert main(["data", "list"]) == 0
        return [re.split(r" {2,}", line.strip())[-1] for line in capsys.readouterr().out.splitlines()[1:]]

    assert listed() == ["1 pinned, 2 unknown", "pinned", "unknown", "unknown"]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "x.png").write_bytes(PNG)
    assert main(["data", "get", "two", "mine", "--yes"]) == 0
    capsys.readouterr()
    assert listed() == ["1 pinned, 1 noted, 1 unknown", "pinned", "noted", "noted"]


@pytest.mark.parametrize("given", ["mirror.example/x", "ftp://mirror.example", "https://me:s3cret@mirror.example/x"])
def test_mirror_that_is_no_address_or_has_a_password_is_refused(tmp_path, monkeypatch, capsys, given):
    monkeypatch.setenv("DSR_DATA", str(tmp_path))
    assert main(["data", "get", "nyu", "--mirror", given]) == 2
    captured = capsys.readouterr()
    [line] = captured.err.splitlines()
    assert "--mirror: expected an address that begins with http" in line
    assert "s3cret" not in captured.out + line

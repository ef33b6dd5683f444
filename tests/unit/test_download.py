"""Fetching data sets: from a server of its own that breaks off, lies, has changed or is not there at all."""

import contextlib
import hashlib
import io
import json
import shutil
import socket
import tarfile
import zipfile
from collections import Counter, namedtuple
from dataclasses import replace
from pathlib import Path, PurePosixPath
from urllib.parse import urlsplit

import pytest
from download_server import DATES, PNG, serving
from small_files import written

from dsr.cli import main
from dsr.data.download import CATALOGUE, Collection, Item
from dsr.data.download.fetching import Checksums, get, lock_directory, state, verify
from dsr.utils.progress import Progress

OTHER = b"\x89PNG\r\n\x1a\n" + bytes(range(255, -1, -1)) * 1600
PAGE = b"\n<!DOCTYPE html><html><body>Not here any more</body></html>"


@pytest.fixture
def server(monkeypatch, serve):
    return serving(serve, monkeypatch, {"/a.png": PNG})


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


def test_broken_connection_resumes_where_it_stopped(server, tmp_path):
    server.cuts = [200_000, 100_000]
    assert fetched(picture(server), tmp_path) == []
    assert (tmp_path / "set/a.png").read_bytes() == PNG
    first, second, third = (None if wanted is None else int(wanted[6:-1]) for _, wanted, _ in server.log)
    assert first is None
    assert 100_000 < second <= 200_000 < third <= second + 100_000  # at most a piece that was under way is lost
    assert server.log[-1][2] == len(PNG) - third


@pytest.mark.parametrize(
    ("stop_at", "changes", "sent"),
    [
        (200_000, {}, lambda had: len(PNG) - had),
        (200_000, {"files": {"/a.png": OTHER}, "marks": {"Last-Modified": DATES[1]}}, lambda had: len(OTHER)),
        (len(PNG), {}, lambda had: 0),  # it had come whole
    ],
)
def test_interrupted_transfer_goes_on_unless_the_file_has_changed(server, tmp_path, stop_at, changes, sent):
    with pytest.raises(KeyboardInterrupt):
        get([picture(server)], tmp_path, Watcher(stop_at))
    assert left_in(tmp_path) == ["set/a.png.part"]
    had = (tmp_path / "set/a.png.part").stat().st_size
    assert had >= stop_at
    vars(server).update(changes)
    assert fetched(picture(server), tmp_path) == []
    assert server.log[-1][1:] == (f"bytes={had}-", sent(had))
    assert (tmp_path / "set/a.png").read_bytes() == server.files["/a.png"]


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


def test_file_found_nowhere_is_one_line_and_the_others_come(server, tmp_path):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        gone = f"127.0.0.1:{closed.getsockname()[1]}"
        items = [picture(server, "/gone.png", "/lost.png", name="x.png"), Item("set/y.png", (f"http://{gone}/y.png",))]
        first, second = fetched([*items, picture(server)], tmp_path)
    url = server.url
    assert first == f"set/x.png: {url}/gone.png: HTTP 404 Not Found; {url}/lost.png: HTTP 404 Not Found"
    assert second == f"set/y.png: http://{gone}/y.png: no connection to {gone}"
    assert left_in(tmp_path) == ["set/a.png"]


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.png", b"GIF89a nothing"), ("a.zip", PNG), ("a.tar.gz", PNG), ("a.mat", PNG), ("a.txt", b"\0\1"),
     ("a.txt", PAGE), ("a.png", b"")],
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


def test_mirror_is_asked_first_under_the_same_path_and_addresses_in_turn(server, tmp_path):
    server.files["/mirror/set/a.png"] = PNG
    assert fetched(picture(server), tmp_path, mirror=f"{server.url}/mirror/") == []
    item = picture(server, "/gone.png", "/a.png", name="b.png")
    assert fetched(item, tmp_path, mirror=f"{server.url}/mirror") == []
    assert [path for path, *_ in server.log] == ["/mirror/set/a.png", "/mirror/set/b.png", "/gone.png", "/a.png"]
    assert (tmp_path / "set/b.png").read_bytes() == PNG


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


LINK = zipfile.ZipInfo("rgb/evil")
LINK.external_attr = 0o120777 << 16


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
    "a link in a zip": ("s.zip", zipped({LINK: "../../evil.txt"})),
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


@pytest.mark.parametrize("name", PACKED)
@pytest.mark.parametrize(
    ("share", "message"), [(0.2, "an archive, got a"), (0.7, "an archive, got a"), (1, "depth in it")]
)
def test_archive_that_is_truncated_or_lacks_a_folder_is_refused_and_nothing_of_it_left(
    server, tmp_path, name, share, message
):
    content = PACKED[name][: int(len(PACKED[name]) * share)]
    problems = fetched(archive(server, name, content, ("rgb", "depth")), tmp_path)
    one_line(problems, f"{tmp_path / 'set' / name}: expected {message}")
    assert left_in(tmp_path) == [f"set/{name}"]


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
    for name in "abc":
        written(tmp_path / f"set/{name}.png", PNG)
    assert verified(collection(item), tmp_path) == ([], [f"{tmp_path}/checksums.json: recorded as found: set/a.png"])
    items, watcher = [picture(server, name=f"{name}.png") for name in "bca"], Watcher()
    assert get(items, tmp_path, watcher) == []
    assert watcher.lines == [f"{tmp_path}/checksums.json: recorded as found: set/{name}.png" for name in "bc"]
    assert server.log == []
    assert Checksums(tmp_path)["set/b.png"].sha256 == sha256(PNG)


MANUAL = collection(manual="put *.mat into {folder}", patterns=("*.mat", "*/P*/*.png"))


def test_manual_route_names_what_is_missing_records_once_and_checks_afterwards(tmp_path):
    folder = tmp_path / "set"
    problems, _ = verified(MANUAL, tmp_path)
    for problem, pattern in zip(problems, MANUAL.patterns, strict=True):
        assert problem.startswith(f"{folder}: expected {pattern}, there is none: put *.mat into {folder}, then")
        assert "`dsr data verify mine`" in problem
    assert state(MANUAL, tmp_path) == "manual"
    for name, content in {"set/a.mat": b"MATLAB 5.0", "set/sea/P000/1.png": PNG}.items():
        written(tmp_path / name, content)
    assert state(MANUAL, tmp_path) == "complete"
    recorded = f"{tmp_path}/checksums.json: recorded as found: set/a.mat, set/sea/P000/1.png"
    assert verified(MANUAL, tmp_path) == ([], [recorded])
    assert verified(MANUAL, tmp_path) == ([], [])
    (tmp_path / "set/a.mat").write_bytes(b"MATLAB 7.3")
    (tmp_path / "set/sea/P000/1.png").rename(tmp_path / "set/sea/P000/2.png")
    missing, other = verified(MANUAL, tmp_path)[0]
    assert "set/sea/P000/1.png: expected a file as recorded, there is none" in missing
    assert f"got {sha256(b'MATLAB 7.3')}" in other


def test_collection_state_is_reported(server, tmp_path):
    items = picture(server), picture(server, name="b.png"), archive(server, "s.zip", PACKED["s.zip"])
    assert state(collection(*items), tmp_path) == "absent"
    fetched(items[0], tmp_path)
    assert state(collection(*items), tmp_path) == "partial 1 of 3"
    fetched(items, tmp_path)
    assert state(collection(*items), tmp_path) == "complete"
    (tmp_path / "set/room/rgb/2.png").unlink()
    assert state(collection(*items), tmp_path) == "partial 2 of 3"


@pytest.mark.parametrize("text", ["", "[]", '{"a": 3}', '{"a": {"size": "3"}}', '{"a": {"size": 3, "sha256": 5}}'])
def test_damaged_records_are_one_line(server, tmp_path, text):
    path = written(tmp_path / "checksums.json", text.encode())
    with pytest.raises(ValueError, match=f"^{path}: expected the checksums of the data sets.*$"):
        fetched(picture(server), tmp_path)


def test_second_command_is_refused_while_one_writes(server, tmp_path):
    with lock_directory(tmp_path), pytest.raises(ValueError, match="another `dsr data` command"):
        fetched(picture(server), tmp_path)
    assert fetched(picture(server), tmp_path) == []


@pytest.mark.parametrize("given", ["mirror.example/x", "ftp://mirror.example", "https://me:s3cret@mirror.example/x"])
def test_mirror_that_is_no_address_or_has_a_password_is_refused(tmp_path, monkeypatch, capsys, given):
    monkeypatch.setenv("DSR_DATA", str(tmp_path))
    assert main(["data", "get", "nyu", "--mirror", given]) == 2
    captured = capsys.readouterr()
    [line] = captured.err.splitlines()
    assert "--mirror: expected an address that begins with http" in line
    assert "s3cret" not in captured.out + line


# The catalogue


ITEMS = [item for collection in CATALOGUE.values() for item in collection.items]


def test_collection_has_terms_and_files_in_its_folders_or_says_how_to_get_them():
    for name, collection in CATALOGUE.items():
        assert collection.name == name
        assert all((collection.homepage, collection.title, collection.licence, collection.citation))
        assert bool(collection.items) != bool(collection.manual and collection.patterns)
        paths = [item.path for item in collection.items]
        assert {path.split("/")[0] for path in paths} == (set(collection.folders) if paths else set())
        assert len(set(paths)) == len(paths)


def test_items_have_addresses_of_their_names_and_paths_below_the_root():
    assert len(ITEMS) > 200
    for item in ITEMS:
        assert not PurePosixPath(item.path).is_absolute()
        assert ".." not in item.path
        assert item.urls
        for url in item.urls:
            address = urlsplit(url)
            assert address.scheme in ("http", "https")
            assert " " not in url
            name = (address.fragment or address.path).rpartition("/")[2]
            assert name == PurePosixPath(item.path).name or item.unpack_to is not None
        assert (item.unpack_to is None) == (not item.path.endswith((".zip", ".tar.gz")))
        assert bool(item.contains) == (item.unpack_to is not None)


def test_files_of_a_commit_are_pinned_and_the_shared_ones_are_these(shared):
    pinned = {item.path: item.sha256 for item in ITEMS if item.sha256 is not None}
    counts = Counter(path.split("/")[0] for path in pinned)
    assert counts == {
        "lu": 2 * 6, "middlebury8": 2 * 30, "ddrnet": 3 * 22, "stereo_board": 2 * 5, "cleargrasp": 4 * 4 + 1,
        "cleargrasp_synthetic": 3 * 3,
    }  # fmt: skip
    for item in ITEMS:
        assert (item.sha256 is not None) == ("raw.githubusercontent.com" in item.urls[0])
    folders = (("lu", "modern/Lu"), ("middlebury8", "modern/Middlebury"), ("stereo_board", "real/stereo_board"))
    for ours, theirs in folders:
        for path, digest in pinned.items():
            folder, _, name = path.partition("/")
            if folder == ours:
                assert hashlib.sha256((shared / theirs / name).read_bytes()).hexdigest() == digest

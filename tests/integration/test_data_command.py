"""``dsr data`` as it is typed: what it says, fetches and leaves, and how it ends."""

import contextlib
import os
import pty
import signal
import subprocess
import sys
import time

import cv2
import pytest
from download_server import PNG, serving
from upsampling import refused_line

from dsr import cli
from dsr.cli import main

NAMES = [f"middlebury2003/{scene}/{name}" for scene in ("cones", "teddy") for name in ("im2.png", "disp2.png")]


@pytest.fixture
def mirror(monkeypatch, serve):
    server = serving(serve, monkeypatch, {f"/{name}": PNG + name.encode() for name in NAMES})
    yield server
    server.go_on.set()


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("DSR_DATA", str(tmp_path / "data"))
    return tmp_path / "data"


def command(*arguments):
    return [sys.executable, "-m", "dsr", *arguments]


def run(*arguments):
    return subprocess.run(command(*arguments), capture_output=True, text=True, timeout=60, check=False)


def test_dataset_is_fetched_listed_verified_and_not_fetched_twice(mirror, root, capsys):
    done = run("data", "get", "middlebury2003", "--mirror", mirror.url)
    assert (done.returncode, done.stderr) == (0, "")
    before = done.stdout.partition(f"4 of 4 files are missing in {root}")[0]
    assert all(word in before for word in ("https://vision.middlebury.edu/stereo/data/scenes2003/", "licence"))
    assert done.stdout.endswith("middlebury2003: complete\n")
    for name in NAMES:
        assert (root / name).read_bytes() == PNG + name.encode()
    assert [path for path, *_ in mirror.log] == [f"/{name}" for name in NAMES]

    assert cli.main(["data", "list"]) == 0
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert rows["middlebury2003"].split()[-2:] == ["complete", "noted"]
    assert rows["middlebury2006"].split()[-2:] == ["absent", "unknown"]
    assert rows["tofmark"].split()[-2:] == ["manual", "unknown"]
    assert rows["lu"].split()[-2:] == ["absent", "pinned"]

    assert cli.main(["data", "verify", "middlebury2003"]) == 0
    assert capsys.readouterr() == ("middlebury2003: complete, as recorded\n", "")

    assert cli.main(["data", "get", "middlebury2003", "--mirror", mirror.url]) == 0
    assert f"0 of 4 files are missing in {root}" in capsys.readouterr().out
    assert len(mirror.log) == 4


def test_interrupted_command_resumes(mirror, root):
    mirror.go_on.clear()
    get = ("data", "get", "middlebury2003", "--mirror", mirror.url)
    process = subprocess.Popen(command(*get), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    part, end = root / f"{NAMES[0]}.part", time.monotonic() + 30
    while time.monotonic() < end and not (part.is_file() and part.stat().st_size):
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert (process.returncode, errors.count("\n")) == (130, 1)
    had = part.stat().st_size
    assert not (root / NAMES[0]).exists()
    mirror.go_on.set()
    assert run(*get).returncode == 0
    assert [each[:2] for each in mirror.log[:2]] == [(f"/{NAMES[0]}", None), (f"/{NAMES[0]}", f"bytes={had}-")]
    assert (root / NAMES[0]).read_bytes() == PNG + NAMES[0].encode()
    assert not part.exists()


def test_command_asks_before_the_first_byte_on_a_terminal(mirror, root):
    for answer, there in ((b"n\n", False), (b"y\n", True)):
        ours, theirs = pty.openpty()
        get = command("data", "get", "middlebury2003", "--mirror", mirror.url)
        process = subprocess.Popen(get, stdin=theirs, stdout=theirs, stderr=theirs)
        os.close(theirs)
        said = b""
        while b"fetch them?" not in said:
            said += os.read(ours, 1024)
        assert not mirror.log
        os.write(ours, answer)
        with contextlib.suppress(OSError):  # when the other side is closed
            while os.read(ours, 1024):
                pass
        assert process.wait(60) == 0
        os.close(ours)
        assert (root / NAMES[-1]).exists() is there


def test_locations_of_the_datasets_are_printed(root, capsys):
    assert cli.main(["data", "where"]) == 0
    first, *lines = capsys.readouterr().out.splitlines()
    assert first == str(root)
    assert ["icl", str(root / "icl_nuim")] in [line.split() for line in lines]
    assert cli.main(["data", "where", "icl"]) == 0
    assert capsys.readouterr() == (f"{root / 'icl_nuim'}\n", "")


def test_unknown_name_is_one_line_with_the_known_ones(root, capsys):
    for task in ("get", "verify", "where"):
        line = refused_line(capsys, cli.main(["data", task, "middelbury"]))
        assert line.startswith("middelbury: unknown data set; expected some of middlebury, ")
    assert not root.exists()


def test_prepare_draws_a_contact_sheet_and_errors_are_one_line(tmp_path, monkeypatch, capsys, shared, dsr_cache):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DSR_DATA", str(shared / "real"))
    assert main(["data", "prepare", "icl", "dataset.scenes=found", "dataset.size=64"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "contact sheet: outputs/data/icl/sheet.png"
    assert cv2.imread("outputs/data/icl/sheet.png").shape[1] > 1000
    monkeypatch.setenv("DSR_DATA", "nowhere")
    wrong = {
        ("icl",): "dataset=icl: expected its files in nowhere/icl_nuim",
        ("icl", "dataset.sizes=3"): "dataset.sizes: unknown key; expected one of ",
        ("paper_train",): "dataset=paper_train: several data sets",
    }
    for arguments, message in wrong.items():
        assert refused_line(capsys, main(["data", "prepare", *arguments])).startswith(message)
    assert [path.name for path in tmp_path.iterdir()] == ["outputs"]

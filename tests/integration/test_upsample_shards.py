"""``dsr upsample --shard`` and ``--manifest``: shards together give what one command gives, and each knows its own."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import captures
import pytest
from commands import run_python
from small_frames import FRAMES, results, write_frames

from dsr.cli import main
from dsr.io.layouts import find_pairs_of_folder
from dsr.io.manifest import Manifest, write_manifest
from dsr.io.shards import Shard

FAST = ("--method", "bicubic", "--only", "depth,normals,input", "--fov", "60")


def upsample(*arguments):
    return main(["upsample", *map(str, arguments)])


@pytest.fixture
def folder(tmp_path):
    return write_frames(tmp_path / "frames")


def poses(path, count=FRAMES):
    """Write poses of a camera that moves to the right, in the frames' order and without times."""
    rows = [f"1 0 0 {0.01 * number} 0 1 0 0 0 0 1 0" for number in range(count)]
    path.write_text("\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize(("case", "listed"), [("alone", False), ("alone", True), ("neighbours", True)])
def test_shards_together_give_what_one_command_gives(folder, tmp_path, capsys, case, listed):
    options = [*FAST]
    if case == "neighbours":
        options += ["--poses", poses(tmp_path / "poses.txt"), "--neighbours", "2"]
    code = upsample(folder, "-o", tmp_path / "whole", *options)
    source = [folder]
    if listed:
        source = ["--manifest", tmp_path / "frames.jsonl"]
        assert upsample(folder, *source, "--shards", "3", "-o", tmp_path / "parts") == 0
    codes = {upsample(*source, "--shard", f"{number}/3", "-o", tmp_path / "parts", *options) for number in (3, 1, 2)}
    assert max(codes) == code
    whole, parts = results(tmp_path / "whole"), results(tmp_path / "parts")
    assert whole.keys() == parts.keys()
    assert len(whole) > 4 * FRAMES // 2
    assert whole == parts
    capsys.readouterr()
    assert upsample(*source, "-o", tmp_path / "parts", *options) == code
    done = len({Path(name).parts[0] for name in whole})
    assert f"{done} complete already" in capsys.readouterr().out
    assert results(tmp_path / "parts") == whole


def test_shard_alone_works_on_its_block_and_says_how_it_went(folder, tmp_path, capsys):
    (folder / "depth" / "003.png").write_bytes(b"\x89PNG nothing")
    for number in (1, 2):
        assert upsample(folder, "--shard", f"{number}/9", "-o", tmp_path / "out", *FAST) == (2 if number == 2 else 0)
    said = capsys.readouterr().out
    assert "shard 1/9: no frame of 7" in said
    assert "shard 2/9: frames 1 to 1 of 7" in said
    assert upsample(folder, "--shard", "2/3", "-o", tmp_path / "out", *FAST) == 2
    summary = json.loads((tmp_path / "out" / "shard-2-of-3.json").read_text())
    assert (summary["shard"], summary["outcomes"]) == ("2/3", {"done": 1})
    assert [each["frames"] for each in summary["failed"]] == [["003"]]
    assert "003.png" in summary["failed"][0]["problem"]


def test_exports_of_all_frames_are_left_to_the_command_without_shard(folder, tmp_path, capsys):
    options = ("--method", "bicubic", "--only", "nerfstudio", "--poses", poses(tmp_path / "poses.txt"), "--fov", "60")
    for kind in ("rgb", "depth"):  # those that are holes alone fail
        for name in ("000.png", "001.png"):
            (folder / kind / name).unlink()
    poses(tmp_path / "poses.txt", FRAMES - 2)
    for number in (1, 2):
        assert upsample(folder, "--shard", f"{number}/2", "-o", tmp_path / "out", *options) == 0
    assert "nerfstudio: of all frames, by the same command without --shard" in capsys.readouterr().out
    assert not (tmp_path / "out" / "transforms.json").exists()
    assert upsample(folder, "-o", tmp_path / "out", *options) == 0
    assert "5 complete already" in capsys.readouterr().out
    assert len(json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]) == FRAMES - 2


BOTH = """
import os
import sys

from dsr.cli import main

running = []
for shard in ("1/2", "2/2"):
    process = os.fork()
    if not process:
        os._exit(main([*sys.argv[1:], "--shard", shard]))
    running.append(process)
print(*(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]) for process in running))
"""


def test_two_shards_at_once_with_a_manifest_give_one_folder(folder, tmp_path):
    assert upsample(folder, "--manifest", tmp_path / "m", "--shards", "2", "-o", tmp_path / "out") == 0
    (tmp_path / "both.py").write_text(BOTH)
    options = ["upsample", "--manifest", str(tmp_path / "m"), "-o", str(tmp_path / "out"), *FAST]
    ended = run_python(str(tmp_path / "both.py"), *options, cwd=tmp_path)
    assert ended.stdout.splitlines()[-1] == "2 0"  # the first two maps are holes alone
    assert upsample(folder, "-o", tmp_path / "whole", *FAST) == 2
    assert results(tmp_path / "out") == results(tmp_path / "whole")


def error_of(capsys, *arguments):
    """Return the only line of a command's error."""
    assert upsample(*arguments) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_bad_shards_are_refused_in_one_line(folder, tmp_path, capsys):
    out = ("-o", tmp_path / "out")
    for shard in ("17/16", "0/16", "-1/2", "3", "1/0", "1/2/3", "a/b", "²/3"):
        told = error_of(capsys, folder, f"--shard={shard}", *out)
        assert told == f"error: --shard: expected K/N with K from 1 to N, such as 3/16, got {shard!r}"
    assert "--shards: expected 1 or more, got 0" in error_of(capsys, folder, "--shards", "0", "--manifest", "m", *out)
    assert "--shards: expected --manifest FILE" in error_of(capsys, folder, "--shards", "2", *out)
    assert "--manifest: expected --shards N" in error_of(capsys, folder, "--manifest", "m", *out)
    missing = error_of(capsys, "--manifest", tmp_path / "none", *out)
    assert str(tmp_path / "none") in missing
    assert not (tmp_path / "out").exists()


def test_manifest_is_kept_and_of_its_number_of_shards(folder, tmp_path, capsys):
    listed = ("--manifest", tmp_path / "m", "-o", tmp_path / "out")
    assert upsample(folder, *listed, "--shards", "2") == 0
    before = (tmp_path / "m").read_bytes()
    capsys.readouterr()
    assert "is there already" in error_of(capsys, folder, *listed, "--shards", "3")
    assert (tmp_path / "m").read_bytes() == before
    told = error_of(capsys, *listed, "--shard", "1/3")
    assert told == f"error: --shard: expected K/2, for which {tmp_path / 'm'} was written, got 1/3"
    assert upsample(folder, *listed, "--shards", "3", "--overwrite") == 0
    assert Manifest(tmp_path / "m").shards == 3
    assert not (tmp_path / "out").exists()


def test_manifest_of_files_added_later_is_the_same(folder, tmp_path):
    write_manifest(tmp_path / "m", find_pairs_of_folder(folder), 3)
    before = list(Manifest(tmp_path / "m"))
    assert [pair.name for pair in before] == [f"{number:03}" for number in range(FRAMES)]
    for kind in ("rgb", "depth"):
        shutil.copy(folder / kind / "005.png", folder / kind / "0005b.png")
    assert list(Manifest(tmp_path / "m")) == before


def test_manifest_of_a_folder_beside_it_is_read_again(folder, tmp_path, monkeypatch, capsys):
    (tmp_path / "run").mkdir()
    monkeypatch.chdir(tmp_path / "run")
    upsample(f"../{folder.name}", "--manifest", "list.jsonl", "--shards", "1", "-o", "out", *FAST)
    capsys.readouterr()
    upsample("--manifest", "list.jsonl", "--shard", "1/1", "-o", "again", *FAST)
    assert "5 done, 2 failed -> again" in capsys.readouterr().out


def test_shard_is_read_without_the_others(folder, tmp_path):
    write_manifest(tmp_path / "m", find_pairs_of_folder(folder), 3)
    lines = (tmp_path / "m").read_bytes().splitlines(keepends=True)
    spoilt = [
        line if i in (0, *range(4, 7)) else b"x" * (len(line) - 1) + b"\n" for i, line in enumerate(lines)
    ]  # the head, and the second shard with its two frames
    (tmp_path / "m").write_bytes(b"".join(spoilt))
    pairs, firsts = Manifest(tmp_path / "m").read(Shard(2, 3))
    assert [pair.name for pair in pairs] == ["002", "003"]
    assert [pair.name for pair in firsts] == ["000"]
    with pytest.raises(ValueError, match="the file is damaged"):
        Manifest(tmp_path / "m").read(Shard(3, 3))


@pytest.mark.parametrize("name", ["../../x", "/etc/x", "a/../../b", "", ".", "a\\b"])
def test_manifest_that_names_folders_elsewhere_is_refused(folder, tmp_path, capsys, name):
    write_manifest(tmp_path / "m", find_pairs_of_folder(folder), 1)
    head, first, *rest = (tmp_path / "m").read_text().splitlines()
    frame = json.loads(rest[0])
    rest[0] = json.dumps({**frame, "name": name}, separators=(",", ":"))
    head = json.loads(head)
    head["shards"][0]["bytes"] = len("\n".join((first, *rest))) + 1
    (tmp_path / "m").write_text("\n".join((json.dumps(head), first, *rest)) + "\n")
    told = error_of(capsys, "--manifest", tmp_path / "m", "-o", tmp_path / "out", *FAST)
    assert "expected the lines of a manifest" in told


@pytest.mark.parametrize("cut", [0, 1, 40, 300, -1])
def test_damaged_manifest_is_refused(folder, tmp_path, capsys, cut):
    write_manifest(tmp_path / "m", find_pairs_of_folder(folder), 2)
    content = (tmp_path / "m").read_bytes()
    (tmp_path / "m").write_bytes(content[:cut])
    told = error_of(capsys, "--manifest", tmp_path / "m", "--shard", "2/2", "-o", tmp_path / "out", *FAST)
    assert f"{tmp_path / 'm'}: expected" in told


MAKERS = {
    "stray": lambda folder: captures.stray(folder, video=False),
    "stray video": captures.stray,
    "polycam": captures.polycam,
    "arkitscenes": captures.arkitscenes,
    "open3d": captures.open3d,
    "ros": lambda folder: captures.ros(folder / "scan.bag", 1),
}


@pytest.mark.parametrize("maker", MAKERS)
def test_frames_of_captures_come_back_from_a_manifest(tmp_path, maker):
    pytest.importorskip("rosbags", reason="pip install dsr[captures]")
    (tmp_path / "captures" / "scan").mkdir(parents=True)
    MAKERS[maker](tmp_path / "captures" / "scan")
    place = tmp_path / "captures" / "scan" / "scan.bag" if maker == "ros" else tmp_path / "captures"
    found = find_pairs_of_folder(place)
    write_manifest(tmp_path / "m", found, 2)
    again = list(Manifest(tmp_path / "m"))
    assert again == list(found.pairs)
    assert [pair.name for pair in again] == [pair.name for pair in found.pairs]
    assert [pair.confidence for pair in again] == [pair.confidence for pair in found.pairs]
    for pair, other in zip(again, found.pairs, strict=True):
        assert pair.capture is not None
        assert pair.capture.record() == other.capture.record()
        mine, theirs = (each.capture.geometry((48, 64)).pose for each in (pair, other))
        assert (mine is None) == (theirs is None)
        assert mine is None or (mine == theirs).all()

"""``dsr upsample`` in several processes: ``--workers`` and ``--shard`` give what one command alone gives."""

import json
from pathlib import Path

import pytest
from small_frames import FRAMES, results, write_frames
from upsampling import refused_line, upsample

FAST = ("--method", "bicubic", "--only", "depth,normals,input", "--fov", "60")


@pytest.fixture
def folder(tmp_path):
    return write_frames(tmp_path / "frames")


def test_several_workers_write_what_one_writes(folder, tmp_path, capsys):
    (folder / "depth" / "004.png").write_bytes(b"\x89PNG nothing")
    reported = []
    for workers in ("1", "2"):
        assert upsample(folder, "-o", tmp_path / workers, *FAST, "--workers", workers) == 2
        said = capsys.readouterr()
        assert "7 pictures: 4 done, 3 failed" in said.out
        reported.append(sorted(said.err.splitlines()))
    assert reported[0] == reported[1]
    assert results(tmp_path / "1") == results(tmp_path / "2")


@pytest.mark.parametrize("case", ["alone", "neighbours"])
def test_shards_together_give_what_one_command_gives(folder, tmp_path, capsys, case):
    options = [*FAST]
    if case == "neighbours":
        rows = [f"1 0 0 {0.01 * number} 0 1 0 0 0 0 1 0\n" for number in range(FRAMES)]
        (tmp_path / "poses.txt").write_text("".join(rows))
        options += ["--poses", tmp_path / "poses.txt", "--neighbours", "2"]
    code = upsample(folder, "-o", tmp_path / "whole", *options)
    codes = {upsample(folder, "--shard", f"{number}/3", "-o", tmp_path / "parts", *options) for number in (3, 1, 2)}
    assert max(codes) == code
    whole = results(tmp_path / "whole")
    assert len(whole) > 4 * FRAMES // 2
    assert results(tmp_path / "parts") == whole
    capsys.readouterr()
    assert upsample(folder, "-o", tmp_path / "parts", *options) == code
    done = len({Path(name).parts[0] for name in whole})
    assert f"{done} complete already" in capsys.readouterr().out


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


def test_bad_shards_are_refused_in_one_line(folder, tmp_path, capsys):
    for shard in ("17/16", "0/16", "-1/2", "3", "1/2/3", "a/b"):
        line = refused_line(capsys, upsample(folder, f"--shard={shard}", "-o", tmp_path / "out"))
        assert line.startswith("--shard: ")
    assert not (tmp_path / "out").exists()


def test_warnings_of_a_shard_are_in_its_summary_and_reported_again_once_it_is_complete(folder, tmp_path, capsys):
    options = (*FAST[:-2], "--fov", "4", "-o", tmp_path / "out")
    for _ in range(2):
        assert upsample(folder, "--shard", "2/2", *options) == 0
        assert capsys.readouterr().out.count("warning: ") == 1
        [warning] = json.loads((tmp_path / "out" / "shard-2-of-2.json").read_text())["warnings"]
        assert (warning["code"], warning["pictures"], warning["threshold"]) == ("view-narrow", 4, 5)
        assert warning["value"] == pytest.approx(4, abs=0.1)
    assert "view" in refused_line(capsys, upsample(folder, "--shard", "2/2", "--strict", *options))

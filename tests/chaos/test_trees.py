"""The comparison of directories: what has to be the same, and what need not."""

import json

import numpy as np
import pytest
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

from chaos.trees import damaged, differences


@pytest.fixture
def two(tmp_path):
    """Two directories with the results of two runs that differ in their times."""
    for number, name in enumerate(("one", "two")):
        folder = tmp_path / name
        folder.mkdir()
        np.savez(folder / "a.npz", depth=np.eye(3), seconds=number + 0.5)
        scenes = {"predicted": ["a", "b"], "reused": []} if number else {"predicted": ["b"], "reused": ["a"]}
        (folder / "summary.json").write_text(json.dumps({"mean": 1.0, "seconds": {"a": number}, **scenes}))
        (folder / "figure.pdf").write_text(f"%PDF /CreationDate (D:{number}) x\n%%EOF\n")
        Image.new("RGB", (4, 4)).save(folder / "picture.png")
        (folder / "table.csv").write_text("a,b\n1,22222\n")
        write_log(folder / "log", {step: step for step in range(4)}, number)
    return tmp_path / "one", tmp_path / "two"


def write_log(folder, values, speed=0):
    with SummaryWriter(folder) as writer:
        for step, value in values.items():
            writer.add_scalar("loss", value, step)
            writer.add_scalar("train/patches_per_second", speed, step)


def test_times_may_differ(two):
    assert differences(*two) == []
    assert damaged(two[0]) == []


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda folder: np.savez(folder / "a.npz", depth=np.eye(3) + 1e-16, seconds=1), "a.npz: /depth.npy differs"),
        (
            lambda folder: (folder / "table.csv").write_text("a,b\n1,3\n"),
            "table.csv: [1][1]: expected '22222', got '3'",
        ),
        (lambda folder: (folder / "table.csv").unlink(), "table.csv: missing"),
        (lambda folder: (folder / "a-3f.npz").touch(), "a-3f.npz: not in the reference"),
        (lambda folder: write_log(folder / "log", {2: 9}), "log/events.out.tfevents.: /('loss', 2) differs"),
        (lambda folder: (folder / "figure.pdf").write_text("%PDF /CreationDate (D:1) y\n%%EOF\n"), "figure.pdf: "),
        (
            lambda folder: (folder / "summary.json").write_text(
                json.dumps({"mean": 1.0, "seconds": {}, "predicted": ["a"], "reused": []})
            ),
            "summary.json: ",
        ),
    ],
)
def test_every_other_difference_is_found(two, change, line):
    change(two[1])
    [found] = differences(*two)
    assert found.startswith(line)


@pytest.mark.parametrize("name", ["a.npz", "summary.json", "figure.pdf", "picture.png", "table.csv"])
@pytest.mark.parametrize("fraction", [0, 0.6])
def test_a_truncated_file_is_found(two, name, fraction):
    content = (two[0] / name).read_bytes()
    (two[0] / name).write_bytes(content[: int(fraction * len(content))])
    [line] = damaged(two[0])
    assert line.startswith(f"{name}: damaged")

"""The fuzzer itself: it sees what a reader must not do, and a case is the same each time."""

import os
import pickle
import subprocess
import sys
import warnings
from random import Random

import numpy as np
import pytest

from fuzz import judging, values
from fuzz.judging import RefusedError, judge
from fuzz.place import MARK, Place


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    place = Place(tmp_path / "case")
    place.input.mkdir(parents=True)
    place.out.mkdir()
    (place.input / "scan.json").write_text("{}")
    return place


def refuse(text):
    def read(_):
        raise ValueError(text)

    return read


def execute(place):
    path = place.input / "weights.pth"
    path.write_bytes(values.pickled(Random(0), place.canary))
    with path.open("rb") as file:
        pickle.load(file)


def compute(_):
    while True:
        sum(range(1000))


def wait(place):
    os.mkfifo(place.input / "pipe")
    (place.input / "pipe").read_bytes()


BAD = {
    "executes": (execute, "pickle.find_class"),
    "leaves": (lambda place: place.canary.mkdir(), f"leaves '{MARK}' beside its folders"),
    "starts": (lambda _: subprocess.run([sys.executable, "--version"], check=True), "subprocess.Popen"),
    "imports": (lambda _: __import__("importlib").import_module(MARK), f"imports {MARK}"),
    "runs": (lambda _: exec(f"{MARK} = 1"), "executes code of a file"),
    "reads": (lambda place: (place.input / "../../x").read_bytes(), "reads '"),
    "removes": (lambda place: (place.root.parent / "y").unlink(missing_ok=True), "os.remove of"),
    "prints": (lambda _: os.write(2, b"libpng error"), "prints libpng error"),
    "warns": (lambda _: warnings.warn("overflow", RuntimeWarning, stacklevel=1), "warns: overflow"),
    "computes": (compute, "takes longer than"),
    "waits": (wait, "takes longer than"),
    "takes memory": (lambda _: np.ones(20 << 20).sum(), "takes 1"),
    "fails": (lambda _: {}["key"], "KeyError: 'key'"),
    "claims": (lambda _: np.ones(1 << 45), "MemoryError"),
    "names no file": (refuse("expected a number"), "names no file: expected a number"),
    "says nothing": (lambda _: (_ for _ in ()).throw(RefusedError([])), "without a line"),
    "obeys": (lambda _: (_ for _ in ()).throw(RefusedError(["scan.json: \x1b[2J"])), "do not print"),
    "talks": (lambda _: (_ for _ in ()).throw(RefusedError(["scan.json: " + "x" * 2000])), "a line of 2011 characters"),
}


@pytest.mark.parametrize("what", BAD)
def test_case_in_which_a_reader_does_what_it_must_not_is_unclean(place, monkeypatch, what):
    monkeypatch.setattr(judging, "SECONDS", 0.2)
    monkeypatch.setattr(judging, "_WAITING", 0.5)
    monkeypatch.setattr(judging, "MEGABYTES", 100)
    read, text = BAD[what]
    outcome = judge(read, place, (ValueError, OSError))
    assert outcome.kind == "unclean"
    assert text in outcome.text

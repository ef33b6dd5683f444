"""The fuzzer sees what a reader must not do, asks all readers, and its first round of cases ends as it must."""

import dataclasses
import os
import pickle
from pathlib import Path
from random import Random

import numpy as np
import pytest
import torch

from dsr.io.captures import CAPTURES
from dsr.io.captures.contract import Capture
from fuzz import judging, readers
from fuzz.cases import READERS, Cases
from fuzz.guard import MARK
from fuzz.judging import Place, RefusedError, judge
from fuzz.mutations import pickled


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    place = Place(tmp_path / "case")
    place.input.mkdir(parents=True)
    place.out.mkdir()
    (place.input / "scan.json").write_text("{}")
    return place


def refuse(error):
    def read(_):
        raise error

    return read


def execute(place):
    path = place.input / "weights.pth"
    path.write_bytes(pickled(Random(0), place.canary))
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
    "runs": (lambda _: exec(f"{MARK} = 1"), "executes code of a file"),
    "reads": (lambda place: (place.input / "../../x").read_bytes(), "reads '"),
    "removes": (lambda place: (place.root.parent / "y").unlink(missing_ok=True), "os.remove of"),
    "computes": (compute, "takes longer than"),
    "waits": (wait, "takes longer than"),
    "names no file": (refuse(ValueError("expected a number")), "names no file: expected a number"),
    "obeys": (refuse(RefusedError(["scan.json: \x1b[2J"])), "do not print"),
}


@pytest.mark.parametrize("what", BAD)
def test_case_in_which_a_reader_does_what_it_must_not_is_unclean(place, monkeypatch, what):
    monkeypatch.setattr(judging, "SECONDS", 0.2)
    monkeypatch.setattr(judging, "_WAITING", 0.5)
    read, text = BAD[what]
    outcome = judge(read, place)
    assert outcome.kind == "unclean"
    assert text in outcome.text


def test_case_that_takes_more_than_the_limit_of_memory_ends_in_a_line(place, monkeypatch):
    monkeypatch.setattr(judging, "MEMORY", 100 << 20)
    assert judge(lambda _: np.ones(20 << 20).sum(), place).kind == "refusal"


def test_every_capture_of_the_registry_that_recognises_its_files_is_asked(tmp_path):
    recognised = set()
    for name, write in readers.CAPTURES.items():
        folder = tmp_path / name
        folder.mkdir()
        write(folder)
        recognised |= {each.name for each in CAPTURES for place in (folder, folder / "iphone", folder / "recording")
                       if place.is_dir() and each.frames(place) is not None}  # fmt: skip
    own = {field.name: field.default for field in dataclasses.fields(Capture)}
    expected = {each.name for each in CAPTURES if each.of_file or each.of_folder is not own["of_folder"]}
    assert recognised == expected


@pytest.fixture(scope="module")
def cases(request, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DSR_CACHE", "")  # what it was comes back
        patch.chdir(tmp_path_factory.mktemp("fuzz"))
        torch.set_num_threads(1)
        yield Cases(request.config.getoption("--seed", 2), Path.cwd())


@pytest.mark.parametrize("reader", READERS, ids=[reader.name.replace(" ", "_") for reader in READERS])
def test_reader_ends_with_a_value_or_lines_that_name_the_file(cases, reader, request):
    rounds, case, keep = (request.config.getoption(name, None) for name in ("--rounds", "--case", "--keep"))
    numbers = range(reader.weight * (rounds or 1)) if case is None else [case]
    folders = [None if keep is None else request.config.invocation_params.dir / keep / reader.name / f"{number}"
               for number in numbers]  # fmt: skip
    unclean = [cases.run(reader, number, folder) for number, folder in zip(numbers, folders, strict=True)]
    assert cases.of_valid_files[reader.name].kind == "value", cases.of_valid_files[reader.name].text
    assert list(filter(None, unclean)) == []

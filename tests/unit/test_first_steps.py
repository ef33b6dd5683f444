"""``dsr --version``, ``dsr doctor`` without a directory, ``dsr completion``, and what is said of misspelt words."""

import shutil
import subprocess
import sys

import pytest
import torch
from packaging.requirements import Requirement

import dsr
from dsr.cli import main, make_parser
from dsr.cli.completion import words_at_end
from dsr.doctor import machine
from dsr.methods import weights

MISSPELT = {
    "upsmaple": "upsample", "study biuld": "build", "fuse out --outptu mesh.ply": "--output",
    "upsample --rgb a --depth b -o out --mehtod tgv": "--method", "--verison": "--version",
    "upsample --rgb a --depth b -o out --fill al": "all", "upsample --rgb a --depth b -o out --method facts": "facets",
    "export --onnx f.onnx --method msgv": "msg_v",
    "data get midlebury": "middlebury", "eval method=facts": "facets", "eval dataset=simgoe": "simgeo",
    "eval -m method=bicubic,facts": "facets", "eval +experimnt=facets_x4": "experiment", "completion fihs": "fish",
    "upsample --rgb a --depth b -o out --unit mm": "--depth-unit",
    "upsample --rgb a --depth b -o out --depth-units mm": "--depth-unit",
}  # fmt: skip


@pytest.mark.parametrize("line", MISSPELT)
def test_misspelt_words_are_reported_with_the_one_that_is_meant(line, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["dsr", *line.split()])
    try:
        code = main(line.split())
    except SystemExit as ended:
        code = ended.code
    last = capsys.readouterr().err.splitlines()[-1]
    assert (code, last.rpartition("did you mean ")[2]) == (2, f"{MISSPELT[line]}?")


def test_version_names_what_a_result_depends_on(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    output = capsys.readouterr().out
    assert ended.value.code == 0
    for each in (f"dsr {dsr.__version__}", torch.__version__, weights.version(), sys.version.split()[0]):
        assert each in output


def test_doctor_says_that_all_is_here(capsys):
    assert main(["doctor"]) == 0
    output = capsys.readouterr().out
    assert output.endswith("everything that dsr upsample needs is here\n")
    assert weights.version() in output


def test_doctor_says_what_to_install(capsys, monkeypatch):
    monkeypatch.setattr(machine, "requirements", lambda *_: [Requirement("dsr-no-such>=2"), Requirement("torch>=999")])
    assert main(["doctor"]) == 2
    assert capsys.readouterr().out.splitlines()[-1].endswith("pip install 'dsr-no-such>=2' 'torch>=999'")


def test_doctor_finds_damaged_weights_and_names_those_to_fetch(monkeypatch, tmp_path):
    monkeypatch.setattr(weights, "_HERE", tmp_path)
    monkeypatch.setenv("DSR_DATA", str(tmp_path))
    assert machine.check_weights()[0].level == "problem"
    (tmp_path / "msg_x4.safetensors").write_bytes(b"damaged")
    found = machine.check_weights()[0]
    assert (found.level, "msg_x4" in found.message) == ("problem", True)


def test_doctor_finds_a_card_that_torch_cannot_use_and_a_wrong_device(monkeypatch):
    monkeypatch.setattr(machine, "graphics_cards", lambda: ["Card 9"])
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.delenv("DSR_DEVICE", raising=False)
    assert machine.check_device()[0].level == "warning"
    monkeypatch.setenv("DSR_DEVICE", "cdua")
    assert machine.check_device()[0].level == "problem"


COMPLETED = {
    "dsr ups": "upsample", "dsr upsample --me": "--method", "dsr upsample --method fac": "facets",
    "dsr upsample a b --fill ": "small", "dsr eval method=bicubic data": "dataset=", "dsr train mo": "model=",
    "dsr eval method=fa": "method=facets", "dsr eval +exp": "+experiment=", "dsr data get midd": "middlebury8",
    "dsr study col": "collect", "dsr report runs --light ": "e1", "dsr completion ": "zsh", "dsr upsample 'a b": None,
}  # fmt: skip


@pytest.mark.parametrize("line", COMPLETED)
def test_completion_offers_what_may_stand_there(line):
    found = words_at_end(make_parser(), line)
    assert found == [] if COMPLETED[line] is None else COMPLETED[line] in found


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(("line", "expected"), [("dsr up", "upsample"), ("dsr eval method=facets_", "facets_box")])
def test_completion_in_bash(tmp_path, line, expected):
    (tmp_path / "dsr").write_text(f'#!/bin/sh\nexec {sys.executable} -m dsr "$@"\n')
    (tmp_path / "dsr").chmod(0o755)
    program = f"""
PATH={tmp_path}:$PATH; eval "$(dsr completion bash)"; complete -p dsr >/dev/null || exit 1
compopt() {{ :; }}; COMP_LINE='{line}'; COMP_POINT=${{#COMP_LINE}}; _dsr; echo "${{COMPREPLY[@]}}" """
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=False, timeout=120)
    assert (done.returncode, done.stdout.strip()) == (0, expected), done.stderr

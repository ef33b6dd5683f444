"""``dsr --version``, ``dsr doctor`` without a directory, ``dsr completion``, and what is said of misspelt words."""

import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path

import pytest
import torch
from packaging.requirements import Requirement

import dsr
from dsr.cli import main, make_parser
from dsr.cli.completion import words_at_end
from dsr.doctor import about, machine
from dsr.methods import weights
from dsr.utils.versions import DISTRIBUTION, file_hash

REPOSITORY = Path(__file__).resolve().parents[2]
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


def test_words_like_none_are_reported_without_a_guess(capsys):
    with pytest.raises(SystemExit):
        main(["zzz"])
    assert "did you mean" not in capsys.readouterr().err


def test_version_names_what_a_result_depends_on(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    output = capsys.readouterr().out
    assert ended.value.code == 0
    for each in (f"dsr {dsr.__version__}", torch.__version__, weights.version(), sys.version.split()[0]):
        assert each in output


def test_the_version_of_the_weights_changes_with_each_file():
    assert {name: file_hash(weights.packaged_weights(name)) for name in weights.packaged_names()} == weights.known()


def test_every_extra_for_users_has_a_purpose():
    declared = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert declared.keys() - {"dev", "docs"} <= about.EXTRAS.keys()


def test_requirements_are_those_of_the_metadata():
    without = {Requirement(each).name for each in requires(DISTRIBUTION) if "extra ==" not in each}
    assert {each.name for each in about.requirements()} == without
    assert {each.name for each in about.requirements("onnx")} == {"onnx", "onnxruntime"}


def test_lack_compares_versions():
    assert about.lack(Requirement("numpy")) is None
    assert (
        about.lack(Requirement(f"numpy<{version('numpy')}")) == f"numpy is {version('numpy')}, not <{version('numpy')}"
    )
    assert about.lack(Requirement("dsr-no-such")) == "dsr-no-such is missing"


def test_doctor_says_that_all_is_here(capsys):
    assert main(["doctor"]) == 0
    output = capsys.readouterr().out
    assert output.endswith("everything that dsr upsample needs is here\n")
    assert weights.version() in output


def test_doctor_says_what_to_install(capsys, monkeypatch):
    monkeypatch.setattr(machine, "requirements", lambda: [Requirement("dsr-no-such>=2"), Requirement("torch>=999")])
    assert main(["doctor"]) == 2
    assert capsys.readouterr().out.splitlines()[-1].endswith("pip install 'dsr-no-such>=2' 'torch>=999'")


def test_doctor_finds_damaged_weights_and_names_those_to_fetch(monkeypatch, tmp_path):
    monkeypatch.setattr(weights, "_HERE", tmp_path)
    monkeypatch.setenv("DSR_DATA", str(tmp_path))
    assert machine.check_weights()[0].level == "problem"
    (tmp_path / "msg_x4.safetensors").write_bytes(b"damaged")
    found = machine.check_weights()[0]
    assert (found.level, "msg_x4" in found.message) == ("problem", True)


def test_doctor_finds_two_variants_of_opencv(monkeypatch):
    class Installed:
        def __init__(self, name):
            self.metadata = {"Name": name}

    names = ("opencv-python", "opencv-python-headless", "numpy")
    monkeypatch.setattr(machine, "distributions", lambda: map(Installed, names))
    [found] = machine.check_opencv()
    assert found.level == "warning"
    assert found.advice.startswith("pip uninstall opencv-python opencv-python-headless; pip install ")


def test_doctor_finds_a_card_that_torch_cannot_use_and_a_wrong_device(monkeypatch):
    monkeypatch.setattr(machine, "graphics_cards", lambda: ["Card 9"])
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.delenv("DSR_DEVICE", raising=False)
    assert machine.check_device()[0].level == "warning"
    monkeypatch.setenv("DSR_DEVICE", "cdua")
    assert machine.check_device()[0].level == "problem"


def test_doctor_finds_a_cache_that_cannot_be_written(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("DSR_CACHE", str(tmp_path / "file" / "cache"))
    found = {each.check: each for each in machine.check_folders()}
    assert (found["cache"].level, found["results"].level) == ("problem", "ok")


def test_doctor_and_version_work_without_metadata(monkeypatch):
    def absent(_):
        raise PackageNotFoundError

    for module in (about, machine):
        monkeypatch.setattr(module, "distribution", absent)
    assert [each.level for each in machine.check_python()] == ["warning"]
    assert machine.check_packages() == machine.check_extras() == []


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

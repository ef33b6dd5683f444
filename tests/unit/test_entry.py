"""The command line: whatever is wrong ends as one clear line on stderr and exit code 2, before anything is written."""

import re
import sys

import pytest

from dsr.app.entry import run_command
from dsr.app.schema import plain_config
from dsr.utils.configuration import ConfigError


@pytest.fixture
def command(monkeypatch, tmp_path, capfd):
    """Return a runner of a command line: the exit code, standard error, and the configurations that the job got."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.setenv("DSR_DATA", "data")

    def run(*arguments, job=None, name="eval"):
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
        seen = []

        def remember(config):
            seen.append(config)
            return None if job is None else job(config)

        code = 0
        try:
            run_command(name, remember)
        except SystemExit as ended:
            code = ended.code
        return code, capfd.readouterr().err, seen

    return run


USAGE_ERRORS = {
    "dataset=fodler": r"dataset=fodler: unknown; expected one of arkitscenes, .*; did you mean folder\?",
    "datset=folder": r"datset: unknown key; expected .*; did you mean dataset\?",
    "scal=8": r"scal: unknown key; expected .*; did you mean scale\?",
    "dataset.rot=x": r"dataset.rot: unknown key; expected .* root, .*; \+dataset.rot=.*; did you mean root\?",
    "seed=four": "seed: ",
    "overwrite=maybe": "overwrite: ",
    "method=null": "method=null: ",
    "method=": "method=: ",
    "scale": "scale: expected KEY=VALUE",
    "output_dir=a=b": "output_dir=a=b: expected KEY=VALUE",
    "dataset.size=[1,2": r"dataset.size=\[1,2: expected KEY=VALUE",
    "=3": "=3: ",
    "method=msg,msg_v": "method: expected one value, got several; ",
    "--config-name=other": ".*'other'",
    "--config-dir=nowhere": "--config-dir: expected a directory, got nowhere",
    "+experiment=papers": "experiment=papers: unknown; expected one of all_methods, ",
    "experiment=paper_tables": r"experiment: expected .* \+experiment=",
    "trainer=smoke": "trainer: expected ",
    "hydra.run.dir=/dev/null/x": ".*/dev/null/x",
    "hydra/launcher=slurmy": "hydra/launcher=slurmy: unknown; expected one of basic, ",
}


@pytest.mark.parametrize("argument", USAGE_ERRORS)
def test_usage_error_is_one_line_with_the_key_and_the_choices(command, tmp_path, argument):
    code, error, seen = command(argument)
    assert (code, error.count("\n")) == (2, 1)
    assert re.match(f"error: {USAGE_ERRORS[argument]}", error)
    assert seen == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("argument", "key"),
    [("seed=${nope}", "seed"), ("seed=${oc.env:NO_SUCH_VARIABLE}", "seed"), ("dataset=[simgeo,icl]", "dataset")],
)
@pytest.mark.parametrize("multirun", [(), ("-m",)])
def test_value_that_cannot_be_resolved_is_one_line_that_names_its_key(command, argument, key, multirun):
    code, error, seen = command(*multirun, argument, job=plain_config)
    assert (code, len(seen)) == (2, 0 if multirun else 1)
    assert re.search(f": {key}: expected ", error.splitlines()[-1])
    assert error.count("\n") == 1 + len(multirun)


def test_job_gets_the_composed_configuration_and_no_directory_is_made(command, tmp_path):
    code, error, [config] = command("scale=8", "dataset=folder", "dataset.root=here", "output_dir='a=b'")
    assert (code, error) == (0, "")
    assert (config.scale, config.dataset.root, config.method.model) == (8, "here", "msg_v")
    assert config.output_dir == "a=b"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("raised", "ends", "message"),
    [
        (ConfigError("dataset.root: first\n   second"), 2, "dataset.root: first second\n"),
        (PermissionError(13, "Permission denied", "x"), 2, "x"),
        (MemoryError(), 2, "memory"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_errors_of_the_job_and_an_interruption_are_one_line_with_their_exit_code(command, raised, ends, message):
    def job(config):
        raise raised

    code, error, _ = command(job=job)
    assert (code, error.count("\n")) == (ends, 1)
    assert message in error


@pytest.mark.parametrize("kind", [ZeroDivisionError, ValueError])
def test_program_defect_is_not_reported_as_a_usage_error(command, kind):
    def job(config):
        raise kind("our fault")

    with pytest.raises(kind, match="our fault"):
        command(job=job)


def test_multirun_runs_every_combination_and_a_failing_job_keeps_the_others(command):
    def job(config):
        if config.scale == 4:
            raise ConfigError("scale: not this one")

    code, error, seen = command("-m", "scale=2,4", "method=nearest,bicubic", job=job)
    assert code == 2
    assert [line for line in error.splitlines() if line.startswith("error")] == [
        "error: scale=4 method=nearest: scale: not this one",
        "error: scale=4 method=bicubic: scale: not this one",
        "error: a job failed, scale=4 method=nearest: scale: not this one",
    ]
    assert [(config.scale, config.label) for config in seen] == [
        (2, "Nearest"), (2, "Bicubic"), (4, "Nearest"), (4, "Bicubic"),
    ]  # fmt: skip


def test_config_dir_adds_choices(command, tmp_path):
    (tmp_path / "own" / "method").mkdir(parents=True)
    (tmp_path / "own" / "method" / "mine.yaml").write_text("_target_: dsr.methods.base.mine\nstrength: 1\n")
    code, error, [config] = command("--config-dir", "own", "method=mine", "method.strength=2")
    assert (code, error, config.method.strength) == (0, "", 2)
    code, error, _ = command("method=mein", "--config-dir=own")
    assert code == 2
    assert "mine, monocular" in error
    (tmp_path / "own" / "method" / "mine.yaml").write_text("[")
    code, error, _ = command("--config-dir", "own", "method=mine")
    assert (code, error.count("\n")) == (2, 1)
    assert "mine.yaml" in error

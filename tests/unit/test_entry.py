"""The command line: whatever is wrong ends as one clear line on stderr and exit code 2, before anything is written."""

import math
import sys

import pytest
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins

from dsr.app.entry import run_command
from dsr.app.schema import plain_config
from dsr.utils.configuration import ConfigError


@pytest.fixture
def command(monkeypatch, tmp_path, capfd):
    """Return a runner of a command line: the exit code, standard error, and the configurations that the job got."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")

    def run(*arguments, job=None, check=None, name="eval"):
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *arguments])
        seen = []

        def remember(config):
            seen.append(config)
            return None if job is None else job(config)

        code = 0
        try:
            run_command(name, remember, check=check)
        except SystemExit as ended:
            code = ended.code
        return code, capfd.readouterr().err, seen

    return run


USAGE_ERRORS = {
    "dataset=fodler": "dataset=fodler: unknown; expected one of arkitscenes, ",
    "datset=folder": "datset: unknown key; expected dataset=folder",
    "scal=8": "scal: unknown key; expected scale=8",
    "lpips=false": "lpips: unknown key; expected metrics.lpips=false",
    "colour=8": "colour: unknown key; expected dataset, ",
    "dataset.rot=x": "dataset.rot: unknown key; expected dataset.root=x",
    "dataset.photo=x": "dataset.photo: unknown key; ",
    "dataset.name=mine": "dataset.name: unknown key; expected names.dataset=mine",
    "seed=four": "seed: ",
    "overwrite=maybe": "overwrite: ",
    "method=null": "method=null: ",
    "method=": "method=: ",
    "scale": "scale: expected KEY=VALUE",
    "output_dir=a=b": "output_dir: ",
    "method=msg,msg_v": "method: got several values; ",
    "metrics.protocols=paper,field": "metrics.protocols: got several values; ",
    "downsampling=[box,nearest]": "downsampling=[box,nearest]: ",
    "dataset=[ simgeo , icl ]": "dataset=[ simgeo , icl ]: ",
    "method=[]": "method=[]: ",
    "hydra/launcher=[joblib,basic]": "hydra/launcher=[joblib,basic]: ",
    "--config-name=other": "--config-name other: ",
    "--config-dir=nowhere": "--config-dir: ",
    "+experiment=papers": "experiment=papers: unknown; expected one of all_methods, ",
    "experiment=paper_tables": "experiment: write +experiment=NAME",
    "model=msg": "model: unknown key; expected method=msg",
    "trainer=smoke": "trainer: unknown key; expected trainer=smoke of train.py",
    "w=2": "w: unknown key; expected method.w=2 with method=dip, dip_v",
    "--resolve": "--resolve: ",
    "=3": "'=3': ",
    "": "'': ",
    f"--config-dir={'x' * 300}": "--config-dir: ",
    "hydra.run.dir=/dev/null/x": "[Errno 20] ",
}


@pytest.mark.parametrize("argument", USAGE_ERRORS)
def test_usage_error_is_one_line_with_the_key_and_the_choices(command, tmp_path, argument):
    code, error, seen = command(argument)
    assert (code, error.count("\n")) == (2, 1)
    assert error.startswith(f"error: {USAGE_ERRORS[argument]}")
    assert seen == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "arguments", "meant"),
    [
        ("eval", ("method=dip_v", "loss.w=2"), "method.w=2"),
        ("eval", ("method=dip_v", "steps=100"), "method.steps=100"),
        ("eval", ("loss.visual=dssim",), "method.visual=dssim with method=dip, dip_v"),
        ("train", ("w=2",), "model.objective.w=2 or loss.w=2"),
        ("train", ("method.w=2",), "model.objective.w=2 or loss.w=2"),
        ("train", ("method=msg_v",), "model=msg_v"),
        ("train", ("method=tgv",), "method=tgv of eval.py"),
        ("train", ("steps=100",), "trainer.max_steps=100"),
        ("train", ("lr=1e-3",), "model.optimizer.lr=1e-3"),
        ("train", ("logger.mode=offline",), "logger.wandb.mode=offline with logger=wandb"),
        ("train", ("logger=[csv,wandb]", "logger.mode=offline"), "logger.wandb.mode=offline"),
    ],
)
def test_key_that_is_elsewhere_is_named_with_its_place(command, name, arguments, meant):
    code, error, seen = command(*arguments, name=name)
    key = arguments[-1].partition("=")[0]
    assert (code, error, seen) == (2, f"error: {key}: unknown key; expected {meant}\n", [])


def test_method_that_is_no_network_to_train_is_one_of_the_other_command(command):
    code, error, _ = command("model=dip_v", name="train")
    assert (code, error) == (
        2, "error: model=dip_v: expected a network to train, dip_v is none; eval.py has method=dip_v\n"
    )  # fmt: skip


@pytest.mark.parametrize("quoted", ['output_dir="a=b"', "output_dir='a=b'"])
def test_quoted_value_of_the_message_is_accepted(command, quoted):
    code, error, [config] = command(quoted)
    assert (code, error, config.output_dir) == (0, "", "a=b")


def test_job_gets_the_composed_configuration_and_no_directory_is_made(command, tmp_path):
    code, error, [config] = command("scale=8", "dataset=folder", "dataset.root=here")
    assert (code, error) == (0, "")
    assert (config.scale, config.dataset.root, config.method.model) == (8, "here", "msg_v")
    assert list(tmp_path.iterdir()) == []


def test_configuration_error_of_the_job_is_one_line_and_exit_code_2(command):
    def job(config):
        raise ConfigError("dataset.root: first\n   second")

    assert command(job=job)[:2] == (2, "error: dataset.root: first second\n")


@pytest.mark.parametrize(
    ("argument", "key"),
    [
        ("seed=${nope}", "seed"), ("seed=${oc.env:NO_SUCH_VARIABLE}", "seed"), ("seed=${nope:1}", "seed"),
        ('seed=${oc.decode:"[1"}', "seed"), ("dataset.size=${..nope}", "dataset.size"), ("seed=${seed}", "seed"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("multirun", [(), ("-m",)])
def test_interpolation_that_cannot_be_resolved_is_one_line_that_names_its_key(command, argument, key, multirun):
    code, error, _ = command(*multirun, argument, job=plain_config)
    lines = error.splitlines()
    assert code == 2
    assert multirun or len(lines) == 1
    assert all(line.startswith("error: ") for line in lines)
    assert key in lines[0]


@pytest.mark.parametrize(
    "raised", [MemoryError(), RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried")]
)
def test_want_of_memory_is_one_line_and_exit_code_2(command, raised):
    def job(config):
        raise raised

    code, error, _ = command(job=job)
    assert (code, error.count("\n")) == (2, 1)
    assert "memory" in error


def test_interruption_is_one_line_and_exit_code_130(command):
    def job(config):
        raise KeyboardInterrupt

    code, error, _ = command(job=job)
    assert code == 130
    assert error.count("\n") == 1
    assert error.startswith("interrupted; ")


def test_program_defect_is_not_reported_as_a_usage_error(command):
    def job(config):
        raise ZeroDivisionError("our fault")

    with pytest.raises(ZeroDivisionError, match="our fault"):
        command(job=job)


@pytest.mark.slow
def test_multirun_calls_the_job_for_every_combination(command):
    code, error, seen = command("-m", "scale=4,8", "method=nearest,bicubic")
    assert (code, error) == (0, "")
    assert [(config.scale, config.label) for config in seen] == [
        (4, "Nearest"), (4, "Bicubic"), (8, "Nearest"), (8, "Bicubic"),
    ]  # fmt: skip


def test_failing_job_of_a_multirun_keeps_the_others_and_sets_the_exit_code(command):
    def job(config):
        if config.scale == 4:
            raise ConfigError("scale: not this one")

    code, error, seen = command("-m", "scale=2,4,8", job=job)
    assert code == 2
    assert error.splitlines() == [
        "error: scale=4: scale: not this one",
        "error: 1 of 3 jobs failed",
        "error: scale=4: scale: not this one",
    ]
    assert [config.scale for config in seen] == [2, 4, 8]


def test_job_that_cannot_be_run_keeps_the_jobs_launched_with_it_from_beginning(command, tmp_path):
    def check(config):
        if config.scale == 8:
            raise ConfigError("scale: not this one")
        return []

    code, error, seen = command("-m", "scale=2,4,8", check=check)
    assert (code, seen) == (2, [])
    lines = ["error: 1 of 3 jobs cannot be run, so none is begun", "error: scale=8: scale: not this one"]
    assert error.splitlines() == lines
    assert list(tmp_path.iterdir()) == []
    code, error, seen = command("-m", "scale=2,4,8,16", "hydra.sweeper.max_batch_size=2", check=check)
    assert (code, [config.scale for config in seen]) == (2, [2, 4])
    assert error.splitlines()[0] == "error: 1 of 2 jobs cannot be run, so none is begun"


def test_check_of_a_job_sees_its_configuration_as_the_job_does(command):
    checked = []

    def check(config):
        checked.append((config, list(HydraConfig.get().overrides.task), HydraConfig.get().job.num))
        return []

    code, _, seen = command("-m", "scale=2,4", check=check)
    assert code == 0
    assert [config for config, _, _ in checked] == seen
    assert [given for _, given, _ in checked] == [["scale=2"], ["scale=4"]]
    assert [number for _, _, number in checked] == [0, 1]


@pytest.mark.slow
def test_jobs_that_fail_in_processes_of_a_launcher_are_reported(command):
    def job(config):
        if config.scale == 4:
            raise ConfigError("scale: not this one")
        return 1.0

    code, error, _ = command("-m", "scale=2,4", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", job=job)
    assert code == 2
    assert error.splitlines()[-2:] == ["error: 1 of 2 jobs failed", "error: scale=4: scale: not this one"]


def test_broken_launcher_is_one_line(command, monkeypatch):
    class Broken:
        def launch(self, *_, **__):
            raise RuntimeError("a worker was killed")

    monkeypatch.setattr(Plugins, "instantiate_launcher", lambda *_, **__: Broken())
    code, error, _ = command("-m", "scale=2,4")
    assert code == 2
    assert error == (
        "error: hydra/launcher: Broken ended before its jobs did (RuntimeError: a worker was killed); "
        "what is finished is kept, the same command continues from there\n"
    )


def test_sweepers_get_the_number_that_a_job_returns(command, monkeypatch):
    seen = []
    monkeypatch.setattr("dsr.app.entry.failure_summary", lambda jobs: seen.extend(jobs) or [])

    def job(config):
        if config.scale == 8:
            raise ConfigError("scale: not this one")
        return config.scale / 100

    command("-m", "scale=2,4,8", job=job)
    assert [float(each.return_value) for each in seen] == pytest.approx([0.02, 0.04, math.nan], nan_ok=True)


def test_multirun_with_an_unknown_choice_starts_no_job(command):
    code, error, seen = command("-m", "method=bicubic,neerest")
    assert (code, seen) == (2, [])
    assert error.startswith("error: method=neerest: unknown; ")


def test_config_dir_adds_choices(command, tmp_path):
    (tmp_path / "own" / "method").mkdir(parents=True)
    (tmp_path / "own" / "method" / "mine.yaml").write_text("_target_: dsr.methods.base.mine\nstrength: 1\n")
    code, error, [config] = command("--config-dir", "own", "method=mine", "method.strength=2")
    assert (code, error, config.method.strength) == (0, "", 2)
    code, error, _ = command("method=mein", "--config-dir=own")
    assert code == 2
    assert "mine, monocular" in error
    code, error, _ = command("-cd", "own", "method=mine", "method.strenth=2")
    assert (code, error) == (2, "error: method.strenth: unknown key; expected method.strength=2\n")


def test_run_command_takes_arguments_and_the_process_keeps_its_own(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["dsr", "eval", "scale=8"])
    seen = []
    run_command("eval", lambda config: seen.append((config.scale, list(sys.argv))), ["scale=8"])
    assert seen == [(8, ["dsr", "eval", "scale=8"])]
    assert sys.argv == ["dsr", "eval", "scale=8"]


@pytest.mark.parametrize(
    ("argument", "trust"),
    [("--trust", True), ("trust=mine.Net", "mine.Net"), ("trust=[mine.Net,mine.Data]", ["mine.Net", "mine.Data"])],
)
def test_trust_is_an_option_and_a_key(command, argument, trust):
    code, error, [config] = command("run=x", argument)
    assert (code, error, config.trust) == (0, "", trust)

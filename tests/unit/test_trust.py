"""A configuration in a run's directory runs no code but dsr's own, unless the person at the keyboard allows it."""

import copy
import sys

import pytest
import yaml

from dsr.app.training_runs import expect_trusted, read_config, studies_of_run
from dsr.utils.configuration import ConfigError

CONFIG = {
    "names": {"model": "msg_v", "dataset": "procedural", "downsampling": "box", "noise": "none"},
    "model": {"net": {"_target_": "dsr.methods.networks.msg_net.MSGNet"}},
    "dataset": {"_target_": "dsr.data.rendered.Procedural", "count": 6, "size": 64},
    "downsampling": {"_target_": "dsr.degradation.downsampling.Downsampling", "kernel": "box"},
    "noise": {"_target_": "dsr.degradation.noise.no_noise"},
    "trainer": {"max_steps": 1},
    "scale": 4,
    "seed": 0,
}


def write(folder, text=None, **changes):
    """Make the directory of a training with some keys changed, by their dotted paths."""
    config = copy.deepcopy(CONFIG)
    for path, value in changes.items():
        *above, last = path.split("__")
        node = config
        for each in above:
            node = node.setdefault(each, {})
        node[last] = value
    folder.mkdir(exist_ok=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(config) if text is None else text)
    (folder / "weights.safetensors").write_bytes(b"")
    return folder


@pytest.fixture
def evil(tmp_path, monkeypatch):
    """A module that notes its import."""
    (tmp_path / "evil_targets.py").write_text("from pathlib import Path\nPath('imported').touch()\nclass Net: pass\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    sys.modules.pop("evil_targets", None)
    yield tmp_path
    assert not (tmp_path / "imported").exists()


@pytest.mark.parametrize(
    ("key", "target"),
    [
        ("model__net___target_", "evil_targets.Net"), ("dataset___target_", "dsr.app.entry.os.system"),
        ("dataset__parts__mine___target_", "evil_targets.Net"), ("validation__own___target_", "evil_targets.Net"),
        ("model__network", "evil_targets.Net"), ("model__inner___target_", ["evil_targets.Net"]),
        ("callbacks__mine___target_", "evil_targets.Net"), ("logger__mine___target_", "evil_targets.Net"),
        ("model__net___target_", "dsr.data.rendered.Procedural"), ("metrics__extra__0", "evil_targets.METRIC"),
        ("dataset__parts__logger___target_", "lightning.pytorch.loggers.WandbLogger"),
        ("trainer__profiler___target_", "evil_targets.Net"), ("metrics__extra__0", "dsr.cli.main.x"),
    ],
)  # fmt: skip
def test_target_that_is_not_dsrs_is_refused_before_it_is_imported(evil, key, target):
    changes = {"metrics__extra": [target]} if key.startswith("metrics") else {key: target}
    folder = write(evil / "run", **changes)
    with pytest.raises(ConfigError) as caught:
        read_config(folder)
    message = str(caught.value)
    dotted = key.replace("___target_", "._target_").replace("__", ".")
    assert message.startswith(f"{folder / 'config.yaml'}: {dotted}: expected a target of dsr's own")
    assert f"trust={target} allows it" in message
    assert "\n" not in message


def test_trust_in_the_file_itself_counts_for_nothing(evil):
    folder = write(evil / "run", trust=True, model__net___target_="evil_targets.Net")
    with pytest.raises(ConfigError, match=r"model\.net\._target_"):
        [*studies_of_run({"run": str(folder), "output_dir": None, "trust": None}, [])]


@pytest.mark.parametrize(
    ("trust", "allowed"),
    [(True, True), ("mine.Net", True), (["other.Net", "mine.Net"], True),
     (False, False), (None, False), ([], False), ("mine.Other", False), (5, False), ({"a": 1}, False), ([3], False)],
)  # fmt: skip
def test_person_at_the_keyboard_decides(tmp_path, trust, allowed):
    folder = write(tmp_path / "run", model__net___target_="mine.Net")
    if allowed:
        assert read_config(folder, trust)["model"]["net"]["_target_"] == "mine.Net"
    else:
        wrong = trust in (5, {"a": 1}, [3])
        message = "trust: expected true, false, or targets" if wrong else r"trust=mine\.Net allows it"
        with pytest.raises(ConfigError, match=message):
            read_config(folder, trust)


def test_target_in_the_persons_own_configuration_directory_is_allowed(tmp_path):
    own = tmp_path / "conf" / "model"
    own.mkdir(parents=True)
    (own / "mine.yaml").write_text("net:\n  _target_: mine.Net\n")
    path, places = tmp_path / "config.yaml", [tmp_path / "conf"]
    expect_trusted(path, {"model": {"net": {"_target_": "mine.Net"}}}, None, places)
    with pytest.raises(ConfigError, match=r"mine\.Other"):
        expect_trusted(path, {"model": {"net": {"_target_": "mine.Other"}}}, None, places)


@pytest.mark.parametrize(
    "text",
    ["a: &x [1]\nb: *x\n", "model: !!python/object/apply:os.system [touch imported]\n",
     "model:\n  name: ${oc.env:HOME}\n", "[" * 5000, "model: [\n", "a: 1\n" * 70000, "[1]", "\x00"],
)  # fmt: skip
def test_configuration_of_anything_but_plain_values_is_refused(evil, text):
    with pytest.raises(ConfigError) as caught:
        read_config(write(evil / "run", text))
    assert str(caught.value).startswith(f"{evil / 'run' / 'config.yaml'}: ")
    assert "expected" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value"),
    [("seed", "abc"), ("scale", None), ("trainer", 5), ("model", "msg_v"), ("start", 5), ("names", {"model": "msg_v"})],
)
def test_value_of_another_type_is_refused_by_its_key(tmp_path, key, value):
    with pytest.raises(ConfigError, match=rf"config\.yaml: {key}"):
        read_config(write(tmp_path / "run", **{key: value}))


@pytest.mark.parametrize("name", ["../../up", "/etc/x", "a\\b", "..", "", "a\nb", "x" * 200])
def test_name_that_leads_out_of_a_folder_is_refused(tmp_path, name):
    for changes in ({"names__model": name}, {"names__dataset": name}, {"validation": {name: CONFIG["dataset"]}}):
        with pytest.raises(ConfigError, match="expected a name without folders"):
            read_config(write(tmp_path / "run", **changes))


@pytest.mark.parametrize(
    ("key", "value"),
    [("logger__csv__save_dir", "/tmp/elsewhere"), ("logger__csv__save_dir", "stolen"),
     ("callbacks__best__dirpath", "$HOME/x"), ("callbacks__best__dirpath", "~/x"),
     ("logger__tensorboard__version", "../../up"), ("logger__mlflow__tracking_uri", "http://elsewhere")],
)  # fmt: skip
def test_log_outside_of_the_run_needs_trust(tmp_path, key, value):
    folder = write(tmp_path / "run", **{key: value})
    with pytest.raises(ConfigError, match="expected nothing outside of the run"):
        read_config(folder)
    assert read_config(folder, True)["seed"] == 0

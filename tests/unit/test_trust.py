"""A configuration in a run's directory runs no code but dsr's own, unless the person at the keyboard allows it."""

from __future__ import annotations

import copy
import sys

import pytest
import yaml

from dsr.app.training_runs import read_config, studies_of_run
from dsr.app.trust import Trust, _targets_in, expect_trusted
from dsr.utils.configuration import ConfigError, config_directories, load_target

CONFIG = {
    "names": {"model": "msg_v", "dataset": "procedural", "downsampling": "box", "noise": "none"},
    "model": {"net": {"_target_": "dsr.methods.networks.msg_net.MSGNet"}},
    "dataset": {"_target_": "dsr.data.rendered.Procedural", "count": 6, "size": 64},
    "downsampling": {"_target_": "dsr.degradation.downsampling.Downsampling", "kernel": "box"},
    "noise": {"_target_": "dsr.degradation.noise.no_noise"},
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
        ("model__net___target_", "os.system"),
        ("model__net___target_", "evil_targets.Net"),
        ("model__net___target_", "dsr.data.folder.Folder"),  # dsr's, of another group
        ("dataset___target_", "evil_targets.Net"),
        ("dataset___target_", "dsr.app.entry.os.system"),
        ("dataset___target_", "dsr.utils.files.os.remove"),
        ("dataset___target_", "dsr.cli.main"),
        ("dataset__parts__mine___target_", "evil_targets.Net"),
        ("validation__own___target_", "evil_targets.Net"),
        ("noise___target_", "shutil.rmtree"),
        ("downsampling___target_", "subprocess.run"),
        ("degradation___target_", "evil_targets.Net"),
        ("model___target_", "os.system"),
        ("model__network", "evil_targets.Net"),
        ("model__inner___target_", ["evil_targets.Net"]),
        ("model__optimizer___target_", "dsr.methods.networks.msg_net.MSGNet"),
        ("callbacks__mine___target_", "evil_targets.Net"),
        ("trainer___target_", "os.system"),
    ],
)
def test_target_that_is_not_dsrs_for_its_group_is_refused_before_it_is_imported(evil, key, target):
    folder = write(evil / "run", **{key: target})
    with pytest.raises(ConfigError) as caught:
        read_config(folder)
    message = str(caught.value)
    dotted = key.replace("___target_", "._target_").replace("__", ".")
    assert message.startswith(f"{folder / 'config.yaml'}: {dotted}: expected a target of dsr's own ")
    assert f"trust={target} allows it" in message
    assert "\n" not in message


@pytest.mark.parametrize("value", [["evil_targets.METRIC"], "evil_targets.METRIC", ["dsr.metrics.x", "dsr.cli.main.x"]])
def test_metrics_from_outside_are_refused(evil, value):
    with pytest.raises(ConfigError, match=r"config\.yaml: metrics\.extra(\.\d)?: expected a (target of|list)"):
        read_config(write(evil / "run", metrics__extra=value))


def test_trust_in_the_file_itself_counts_for_nothing(evil):
    folder = write(evil / "run", trust=True, model__net___target_="evil_targets.Net")
    with pytest.raises(ConfigError, match=r"model\.net\._target_"):
        read_config(folder)
    with pytest.raises(ConfigError, match=r"model\.net\._target_"):
        [*studies_of_run({"run": str(folder), "output_dir": None, "trust": None}, [])]


def test_several_targets_are_named_at_once(tmp_path):
    folder = write(tmp_path / "run", model__net___target_="mine.Net", noise___target_="mine.noise")
    with pytest.raises(ConfigError, match=r"'trust=\[mine\.Net,mine\.noise\]' allows it$"):
        read_config(folder)


@pytest.mark.parametrize("trust", [True, "mine.Net", ["other.Net", "mine.Net"]])
def test_person_at_the_keyboard_allows_a_target_and_gets_a_line(tmp_path, capsys, trust):
    folder = write(tmp_path / "run", model__net___target_="mine.Net")
    assert read_config(folder, trust)["model"]["net"]["_target_"] == "mine.Net"
    note = f"note: {folder / 'config.yaml'}: model.net._target_ mine.Net is not dsr's; it is run, as you allow\n"
    assert capsys.readouterr().out == note


@pytest.mark.parametrize("trust", [False, None, [], "mine.Other"])
def test_other_values_of_trust_do_not_allow_it(tmp_path, trust):
    with pytest.raises(ConfigError, match=r"trust=mine\.Net allows it"):
        read_config(write(tmp_path / "run", model__net___target_="mine.Net"), trust)


@pytest.mark.parametrize("value", [5, 1.5, {"a": 1}, [3]])
def test_trust_of_another_type_is_refused(value):
    with pytest.raises(ConfigError, match="trust: expected true, false, or targets"):
        Trust.of(value)


def test_target_in_the_persons_own_configuration_directory_is_allowed(tmp_path):
    own = tmp_path / "conf" / "model"
    own.mkdir(parents=True)
    (own / "mine.yaml").write_text("net:\n  _target_: mine.Net\n")
    trust = Trust.of(None, [tmp_path / "conf"])
    assert trust.allows("mine.Net")
    assert not trust.allows("mine.Other")
    expect_trusted(tmp_path / "config.yaml", {"model": {"net": {"_target_": "mine.Net"}}}, trust)


def test_every_target_that_dsr_names_itself_is_one_of_its_own():
    targets = _targets_in(config_directories()[0])
    assert {"dataset", "downsampling", "noise", "holes", "degradation", "method", "model"} <= targets.keys()
    for group, names in targets.items():
        for name in names:
            home = load_target(group, {"_target_": name}).__module__.partition(".")[0]
            assert home in ("dsr", "torch", "lightning"), name


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: &x [1]\nmodel: {name: m, target: t}\n", "line 1: expected plain values, got an alias"),
        ("model: !!python/object/apply:os.system [touch imported]\n", "line 1: expected plain values, got the tag"),
        ("model: !!python/object/apply:pathlib.PosixPath [x]\n", "line 1: expected plain values, got the tag"),
        ("model:\n  name: ${oc.env:HOME}\n", "line 2: expected plain values, got the interpolation ${oc.env:HOME}"),
        ("'${oc.env:HOME}': 1\n", "line 1: expected plain values, got the interpolation"),
        ("[" * 5000, "line 1: expected plain values, got nested ones"),
        ("[" * 20, "expected YAML of keys and plain values"),
        ("model: [\n", "expected YAML of keys and plain values"),
        ("a: 1\n" * 70000, "config.yaml: expected at most 262144 bytes, got 350000"),
        ("\x00", "expected YAML of keys and plain values"),
    ],
)
def test_configuration_of_anything_but_plain_values_is_refused(evil, text, message):
    with pytest.raises(ConfigError) as caught:
        read_config(write(evil / "run", text))
    assert str(caught.value).startswith(f"{evil / 'run' / 'config.yaml'}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["../../up", "/etc/x", "a\\b", "..", "", "a\nb", "x" * 200])
@pytest.mark.parametrize(
    "key", ["names__model", "names__dataset", "logger__tensorboard__version", "logger__tensorboard__name"]
)
def test_name_that_leads_out_of_a_folder_is_refused(tmp_path, key, name):
    with pytest.raises(ConfigError, match="expected a name without folders"):
        read_config(write(tmp_path / "run", **{key: name}))


def test_validation_set_that_leads_out_of_a_folder_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="expected a name without folders"):
        read_config(write(tmp_path / "run", validation={"../up": CONFIG["dataset"]}))


def test_log_outside_of_the_run_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"logger\.csv\.save_dir: expected no directory"):
        read_config(write(tmp_path / "run", logger__csv__save_dir="/tmp/elsewhere"))


def test_address_to_send_the_log_to_needs_trust(tmp_path, monkeypatch):
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    folder = write(tmp_path / "run", logger__mlflow__tracking_uri="http://elsewhere")
    with pytest.raises(ConfigError, match=r"logger\.mlflow\.tracking_uri: expected no address"):
        read_config(folder)
    assert read_config(folder, True)["logger"]["mlflow"]["tracking_uri"] == "http://elsewhere"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://elsewhere")
    assert read_config(folder)["seed"] == 0

"""A setting has one default: the value in ``conf`` is the one that the class or function has."""

import inspect
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from dsr.app.schema import EvalConfig, MetricsConfig, TrainConfig
from dsr.methods.networks.peers.peer import PEERS
from dsr.training.module import SuperResolution
from dsr.training.settings import PatchSettings
from dsr.utils.configuration import load_object, load_target

CONF = Path(__file__).resolve().parents[2] / "conf"
GROUPS = ("method", "model", "noise", "holes", "downsampling", "dataset")
DIFFERENT = {
    "method/dip": {"data_loss", "w"},  # the class's are those of dip_v, which shares it
    "method/bilinear": {"order"},  # one function, three orders; its default is bicubic
    "method/nearest": {"order"},
    "method/monocular": {"fit", "multiple", "output"},  # one class, of any network's file
    "method/msg": {"variant"},  # three networks of one function
    "method/msg_v": {"variant"},
    "method/msg_v_noisy": {"variant"},
    "model/msg": {"variant"},  # trained by the project; the class's is the published MSG-V
    "model/msg_v": {"variant"},
    **{f"dataset/{name}": {"frames"} for name in ("icl", "sunrgbd")},  # the paper's; the class's are all
    "dataset/simgeo": {"root"},  # on the command line the folder of data is looked at for Lucy
    **{f"method/{peer}": {"weights", "weights_files"} for peer in PEERS},  # none where a network is given
}  # Files whose keys are what tells one choice from another of the same class, by the keys
PRESET = OmegaConf.to_container(OmegaConf.load(CONF / "trainer" / "default.yaml"))


def read_file(group, name):
    """Return a file's keys, those that it takes from others included; interpolations stay as they are."""
    node = OmegaConf.load(CONF / group / f"{name}.yaml")
    above = [each for each in node.pop("defaults", []) if each != "_self_" and "@" not in each]
    return OmegaConf.to_container(OmegaConf.merge(*(read_file(group, each) for each in above), node))


FILES = {f"{path.parent.name}/{path.stem}" for group in GROUPS for path in (CONF / group).glob("*.yaml")}
MIXTURES = {"dataset/mixture", "dataset/paper_train"}  # parts, each a data set's file


def defaults_of(target):
    parameters = inspect.signature(target).parameters.values()
    found = {each.name: each.default for each in parameters if each.default is not each.empty}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in found.items()}


def differences(values, defaults):
    return {key for key in values.keys() & defaults.keys() if values[key] != defaults[key]}


@pytest.mark.parametrize("name", sorted(FILES - MIXTURES))
def test_value_in_conf_is_the_default_of_the_target(name):
    node = read_file(*name.split("/"))
    node = node.get("method", node.get("net", node))  # what a file of the group makes
    node.pop("scale", None)  # the run's
    assert differences(node, defaults_of(load_target(name, node))) == DIFFERENT.get(name, set())


def test_patches_in_conf_have_the_defaults_of_their_class():
    defaults = defaults_of(PatchSettings)
    assert defaults.keys() == PRESET["patches"].keys() - {"_target_"}
    assert differences(PRESET["patches"], defaults) == set()
    assert PRESET["model"]["average"] == defaults_of(SuperResolution)["average"]


def test_metrics_in_conf_have_the_defaults_of_the_schema():
    node = read_file("metrics", "paper")
    assert node.pop("lpips_trunk") == "${oc.env:DSR_LPIPS_TRUNK,null}"
    assert {**node, "lpips_trunk": None} == vars(MetricsConfig())


@pytest.mark.parametrize(("command", "schema"), [("eval", EvalConfig), ("train", TrainConfig)])
def test_command_in_conf_has_the_defaults_of_the_schema(command, schema):
    node = OmegaConf.to_container(OmegaConf.load(CONF / f"{command}.yaml"))
    own = {key: value for key, value in node.items() if key not in ("defaults", "hydra")}
    if command == "eval":
        assert own.pop("weights") == "${oc.env:DSR_WEIGHTS,null}"
        own["weights"] = None
    settings = schema()
    values = {key: getattr(settings, key) for key in own}
    own.pop("model", None)  # which a choice completes
    assert {
        key: vars(value) if key in ("loss", "start") else value for key, value in values.items() if key in own
    } == own


@pytest.mark.parametrize(
    ("earlier", "today"),
    [
        ("dsr.app.sweeps.CheckJobs", "dsr.app.entry.CheckJobs"),
        ("dsr.metrics.visual_loss.make_visual_loss", "dsr.metrics.losses.make_visual_loss"),
    ],
)
def test_targets_of_earlier_configurations_are_found(earlier, today):
    assert load_object("key", earlier, "a target") is load_object("key", today, "a target")

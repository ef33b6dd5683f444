"""From a configuration group to its object: the target's signature is the schema, and what does not fit is refused."""

import re
import sys
import types
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal

import pytest
import torch
from hydra.utils import instantiate

from dsr.app.schema import EvalConfig
from dsr.utils.compute_device import pick_device
from dsr.utils.configuration import ConfigError, build

Order = Literal["near", "far"]


class Toy:
    """Takes one argument of each annotated kind."""

    def __init__(
        self,
        root: str,
        names: Sequence[str] | None = None,
        share: float = 0.5,
        count: int = 1,
        order: Order = "near",
        scale: int = 0,
        *,
        flag: bool = False,
        file: Path | None = None,
        parts: Collection[str] | None = None,
    ) -> None:
        self.parts = parts
        self.values = (root, names, share, count, order, flag, file)
        self.scale = scale
        if root == "missing":
            raise ValueError("root: no such directory")
        if root == "unreadable":
            raise OSError(13, "Permission denied", "unreadable")


def no_arguments():
    return "built"


@pytest.fixture(autouse=True)
def module(monkeypatch):
    home = types.ModuleType("toy_home")
    home.Toy, home.no_arguments = Toy, no_arguments
    monkeypatch.setitem(sys.modules, "toy_home", home)


def node(**keys):
    return {"_target_": "toy_home.Toy", **keys}


def refusal(keys, group="dataset", given=None):
    with pytest.raises(ConfigError) as caught:
        build(group, keys, given)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_group_keys_are_the_arguments_of_the_target():
    toy = build("dataset", node(root="r", names=["a"], share=0.25, count=3, order="far", flag=True, file="f"))
    assert toy.values == ("r", ["a"], 0.25, 3, "far", True, "f")


def test_name_is_passed_to_a_target_that_takes_one(tmp_path):
    (tmp_path / "scene").mkdir()
    node = {"_target_": "dsr.data.folder.Folder", "root": str(tmp_path)}
    assert build("dataset", node, {"name": "mine"}).name == "mine"


def test_nodes_among_the_arguments_are_built_first_and_a_partial_is_called_later():
    made = build("dataset", node(root="r", file={"_target_": "toy_home.no_arguments"}))
    assert made.values[-1] == "built"
    made = build("dataset", node(root="r", file=node(_partial_=True, root="r"))).values[-1](count=7)
    assert (made.values[0], made.values[3]) == ("r", 7)
    with pytest.raises(ConfigError, match=r"^dataset\.file\.x: unknown key; dataset\.file takes none"):
        build("dataset", node(root="r", file={"_target_": "toy_home.no_arguments", "x": 1}))
    assert instantiate(node(root="r", file={"_target_": "toy_home.no_arguments"})).values[-1] == "built"


def test_target_gets_the_run_values_that_it_names():
    assert build("method", node(root="r"), {"scale": 8, "device": "cpu"}).scale == 8


def test_unknown_key_is_refused_with_the_known_keys():
    message = refusal(node(root="r", rot="x"))
    assert message.startswith("dataset.rot: unknown key; ")


def test_group_may_not_set_a_value_of_the_run():
    message = refusal(node(root="r", scale=2), given={"scale": 4})
    assert message.startswith("dataset.scale: unknown key")
    assert "scale" not in message.split("takes")[1]


def test_missing_key_is_refused_with_how_to_set_it():
    assert refusal(node(root="???")) == "dataset.root: dataset needs it: dataset.root=..."


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("root", 3, "string, got 3"), ("root", None, "string, got None"), ("root", "", ""),
        ("names", "a", ".*, got 'a'"), ("names", [1], ".*, got \\[1\\]"),
        ("share", "x", "number, got 'x'"), ("share", True, "number, got True"),
        ("count", 1.5, "integer, got 1.5"), ("count", True, "integer, got True"),
        ("order", "mid", ".*, got 'mid'"), ("flag", "yes", "true or false, got 'yes'"),
        ("flag", 1, "true or false, got 1"), ("file", 1, ".*, got 1"),
    ],
)  # fmt: skip
def test_value_of_the_wrong_type_is_refused_with_the_expected_type(key, value, expected):
    assert re.match(rf"dataset\.{key}: expected {expected}", refusal(node(**{"root": "r", key: value})))


def test_text_in_place_of_a_node_is_refused():
    objective = {"_target_": "dsr.training.objective.DepthObjective", "visual": "mse_v"}
    with pytest.raises(ConfigError, match=r"^model\.objective\.visual: expected a node with _target_, got 'mse_v'"):
        build("model.objective", objective)


@pytest.mark.parametrize(
    ("key", "value"), [("share", 1), ("names", None), ("names", []), ("file", None), ("parts", ["a"])]
)
def test_value_of_a_compatible_type_is_accepted(key, value):
    build("dataset", node(**{"root": "r", key: value}))


@pytest.mark.parametrize("root", ["missing", "unreadable"])
def test_value_error_of_the_target_becomes_a_configuration_error(root):
    expected = {
        "missing": "dataset.root: no such directory",
        "unreadable": "dataset: [Errno 13] Permission denied: 'unreadable'",
    }
    assert refusal(node(root=root)) == expected[root]


@pytest.mark.parametrize(
    "target", [None, 3, "toy", "no_such_module.Toy", "toy_home.Tay", "", "..x", "toy_home.__name__"]
)
def test_missing_target_is_refused(target):
    assert refusal({"_target_": target}, "method").startswith("method._target_: ")


def test_device_auto_is_the_gpu_where_there_is_one():
    assert pick_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    assert pick_device("cpu") == torch.device("cpu")


@pytest.mark.parametrize("name", ["gpu", "cuda:99", "meta", "", "cpu:x"])
def test_device_that_this_machine_lacks_is_refused(name):
    with pytest.raises(ConfigError, match=r"^device: expected auto, cpu or a device of this machine, got "):
        pick_device(name)


@pytest.mark.parametrize("group", [5, "simgeo", ["a"], None])
def test_group_without_keys_is_refused(group):
    with pytest.raises(ConfigError, match=r"^validation.x: expected keys, _target_ among them, got "):
        build("validation.x", group)


def settings(**changes):
    groups = {
        "dataset": {},
        "downsampling": {},
        "noise": {},
        "holes": {},
        "method": {},
        "metrics": {"lpips": True, "lpips_trunk": None},
    }
    return {**groups, "metrics": {"lpips": True}, "scale": 4, "precision": "float32", "seed": 0, **changes}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scale": 3}, "scale: expected one of 2, 4, 8, 16"), ({"precision": "float16"}, "precision: expected one of "),
        ({"seed": -1}, "seed: "), ({"seed": True}, "seed: "),
        ({"dataset": 5}, "dataset: "), ({"method": "???"}, "method: missing"), ({"dataset": None}, "dataset: "),
        ({"scal": 4}, r"scal: unknown key; .*did you mean scale\?"),
        ({"metrics": {"lpips": False, "lpip": 1}}, "metrics.lpip: unknown key; "),
        ({"workers": 0}, "workers: expected auto or "),
    ],
)  # fmt: skip
def test_value_outside_its_choices_is_refused(changes, message):
    EvalConfig.of(settings(scale=8))
    with pytest.raises(ConfigError, match=f"^{message}"):
        EvalConfig.of(settings(**changes))

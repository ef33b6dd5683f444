"""From a configuration group to its object: the target's signature is the schema, and what does not fit is refused."""

import re
import sys
import types
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Literal

import pytest

from dsr.app.schema import EvalConfig
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


def test_group_keys_are_the_arguments_of_the_target_which_gets_the_run_values_that_it_names():
    keys = node(root="r", names=["a"], share=0.25, count=3, order="far", flag=True, file="f")
    toy = build("dataset", keys, {"scale": 8, "device": "cpu"})
    assert (toy.values, toy.scale) == (("r", ["a"], 0.25, 3, "far", True, "f"), 8)


def test_nodes_among_the_arguments_are_built_first_and_a_partial_is_called_later():
    made = build("dataset", node(root="r", file={"_target_": "toy_home.no_arguments"}))
    assert made.values[-1] == "built"
    made = build("dataset", node(root="r", file=node(_partial_=True, root="r"))).values[-1](count=7)
    assert (made.values[0], made.values[3]) == ("r", 7)
    with pytest.raises(ConfigError, match=r"^dataset\.file\.x: unknown key; dataset\.file takes none"):
        build("dataset", node(root="r", file={"_target_": "toy_home.no_arguments", "x": 1}))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"rot": "x"}, r"dataset\.rot: unknown key; dataset takes root, names, .*parts; did you mean root\?$"),
        ({"scale": 2}, r"dataset\.scale: unknown key; (?!.*takes.*scale)"),  # which is the run's
        ({"root": "???"}, r"dataset\.root: dataset needs it: dataset\.root=\.\.\.$"),
        ({"root": "missing"}, r"dataset\.root: no such directory$"),
        ({"root": "unreadable"}, r"dataset: \[Errno 13\] Permission denied: 'unreadable'$"),
        ({"root": 3}, "dataset.root: expected string, got 3"),
        ({"root": None}, "dataset.root: expected string, got None"),
        ({"root": ""}, "dataset.root: expected "), ({"names": "a"}, "dataset.names: expected .*, got 'a'"),
        ({"names": [1]}, r"dataset\.names: expected .*, got \[1\]"),
        ({"share": "x"}, "dataset.share: expected number, got 'x'"),
        ({"share": True}, "dataset.share: expected number, got True"),
        ({"count": 1.5}, "dataset.count: expected integer, got 1.5"),
        ({"count": True}, "dataset.count: expected integer, got True"),
        ({"order": "mid"}, "dataset.order: expected .*, got 'mid'"),
        ({"flag": "yes"}, "dataset.flag: expected true or false, got 'yes'"),
        ({"flag": 1}, "dataset.flag: expected true or false, got 1"), ({"file": 1}, "dataset.file: expected .*, got 1"),
    ],
)  # fmt: skip
def test_key_or_value_that_the_target_does_not_take_is_refused_in_one_line(keys, message):
    assert re.match(message, refusal(node(**{"root": "r", **keys}), given={"scale": 4}))


@pytest.mark.parametrize(
    ("key", "value"), [("share", 1), ("names", None), ("names", []), ("file", None), ("parts", ["a"])]
)
def test_value_of_a_compatible_type_is_accepted(key, value):
    build("dataset", node(**{"root": "r", key: value}))


@pytest.mark.parametrize(
    ("keys", "place"),
    [*(({"_target_": target}, "._target_: ") for target in (None, 3, "toy", "no_such_module.Toy", "toy_home.Tay", "",
                                                            "..x", "toy_home.__name__")),
     *((keys, ": expected keys, _target_ among them, got ") for keys in (5, "simgeo", ["a"], None))],
)  # fmt: skip
def test_missing_target_is_refused(keys, place):
    assert refusal(keys, "validation.x").startswith(f"validation.x{place}")
    objective = {"_target_": "dsr.training.objective.DepthObjective", "visual": "mse_v"}
    assert refusal(objective, "model").startswith("model.visual: expected a node with _target_, got 'mse_v'")


def settings(**changes):
    groups = {group: {} for group in ("dataset", "downsampling", "noise", "holes", "method")}
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

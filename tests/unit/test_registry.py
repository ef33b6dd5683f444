"""The methods of the configuration, read without Hydra."""

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from dsr.app.schema import plain_config, register
from dsr.methods.classical.tgv import TotalGeneralisedVariation
from dsr.methods.networks.network import NetworkUpsampler
from dsr.methods.recipe import list_methods, read_recipe
from dsr.utils.configuration import ConfigError, config_directories


@pytest.mark.parametrize("scale", [4, 8])
@pytest.mark.parametrize("name", list_methods())
def test_recipe_reads_what_hydra_composes(name: str, scale: int) -> None:
    register()
    with initialize_config_dir(str(config_directories()[0]), version_base="1.3"):
        config = plain_config(compose("eval", [f"method={name}", f"scale={scale}"]))
    composed, recipe = config["method"], read_recipe(name)
    node = {**recipe.at(scale), **{key: composed[key] for key in ("downsampling",) if key in composed}}
    assert (node, recipe.label) == (composed, config["label"])
    assert list(node) == list(composed)


def test_recipe_builds_a_method_by_name() -> None:
    method = read_recipe("tgv", {"data_weight": 30}).build(4)
    assert isinstance(method, TotalGeneralisedVariation)
    assert method.data_weight == 30
    network = read_recipe("dg").build(8)
    assert isinstance(network, NetworkUpsampler)
    assert (network.net.scale, network.ensemble) == (8, 4)


def test_unknown_method_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"method: expected one of bicubic, .*tgv, .*got 'tvg'"):
        read_recipe("tvg")
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "mine.yaml").write_text("defaults: [tgv]\niterations: 7\n")
    assert "mine" in list_methods([tmp_path])
    node = read_recipe("mine", directories=[tmp_path]).at(4)
    assert (node["iterations"], node["_target_"]) == (7, read_recipe("tgv").at(4)["_target_"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1, 2", r"bad.yaml: expected a readable YAML file, got ParserError"),
        ("- 1", r"bad.yaml: expected keys and values"),
        ("defaults: [nowhere]", "expected a readable file nowhere.yaml"),
        ("defaults: [bad]", "expected a readable file bad.yaml"),
        ("defaults: 5", "bad.yaml: expected keys and values, with a list of names as defaults"),
        ("name: ${nowhere}", "method=bad: Interpolation key 'nowhere' not found"),
        ("_target_: dsr.geometry.camera.Camera", r"method\._target_: expected a class that derives from .*Method"),
    ],
)
def test_damaged_file_of_a_method_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "bad.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_recipe("bad", directories=[tmp_path]).build(4)
    assert "\n" not in str(caught.value)


def test_weights_are_those_given_or_named_or_packaged(tmp_path: Path) -> None:
    file = tmp_path / "mine.safetensors"
    file.write_bytes(b"")
    recipe = read_recipe("msg_v")
    assert recipe.weights(4).name == "msg_v_x4.safetensors"
    assert recipe.with_weights(file).weights(4) == file
    (tmp_path / "msg_v_x4_clean.pth").write_bytes(b"")
    assert recipe.with_weights(tmp_path).weights(4) == tmp_path / "msg_v_x4_clean.pth"
    with pytest.raises(ConfigError, match=r"weights: method=msg_v: dsr comes with .*; scale 2 needs weights=FILE"):
        recipe.weights(2)
    with pytest.raises(ConfigError, match=r"weights: method=msg_v: expected a file of weights, got .*no such file"):
        recipe.with_weights(tmp_path / "nowhere").weights(4)
    with pytest.raises(ConfigError, match=r"weights\.pack: unknown key; expected file, files, packaged"):
        read_recipe("msg_v", {"weights": {"pack": "x"}}).weights(4)

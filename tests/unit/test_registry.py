"""The methods of the configuration, read without Hydra."""

from __future__ import annotations

from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from dsr.app.schema import plain_config, register
from dsr.methods.classical.tgv import TotalGeneralisedVariation
from dsr.methods.networks.network import NetworkUpsampler
from dsr.methods.networks.weight_choice import find_weights
from dsr.methods.recipe import list_methods, read_recipe
from dsr.utils.configuration import ConfigError, config_directories


@pytest.mark.parametrize("scale", [4, 8])
@pytest.mark.parametrize("name", list_methods())
def test_recipe_reads_what_hydra_composes(name: str, scale: int) -> None:
    register()
    with initialize_config_dir(str(config_directories()[0]), version_base="1.3"):
        composed = plain_config(compose("eval", [f"method={name}", f"scale={scale}"]))["method"]
    node = read_recipe(name).at(scale)
    assert node == composed
    assert list(node) == list(composed)


def test_recipe_builds_a_method_by_name() -> None:
    method = read_recipe("tgv", {"data_weight": 30}).build(4)
    assert isinstance(method, TotalGeneralisedVariation)
    assert method.data_weight == 30
    network = read_recipe("dg").build(8)
    assert isinstance(network, NetworkUpsampler)
    assert (network.net.scale, network.ensemble) == (8, 4)


def test_unknown_method_is_refused_with_those_that_there_are(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"method: expected one of anisotropic_diffusion, .*tgv, got 'tvg'"):
        read_recipe("tvg")
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "mine.yaml").write_text("defaults: [tgv]\nname: mine\niterations: 7\n")
    assert "mine" in list_methods([tmp_path])
    node = read_recipe("mine", directories=[tmp_path]).at(4)
    assert (node["name"], node["iterations"], node["target"]) == ("mine", 7, read_recipe("tgv").at(4)["target"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1, 2", r"bad.yaml: expected a readable YAML file, got ParserError"),
        ("- 1", r"bad.yaml: expected keys and values"),
        ("defaults: [nowhere]", "expected a file nowhere.yaml that bad.yaml begins with"),
        ("defaults: [bad]", "expected a file bad.yaml that bad.yaml begins with"),
        ("defaults: 5", "defaults: expected a list of names, got 5"),
        ("name: ${nowhere}", "method=bad: Interpolation key 'nowhere' not found"),
    ],
)
def test_damaged_file_of_a_method_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "bad.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_recipe("bad", directories=[tmp_path])
    assert "\n" not in str(caught.value)


def test_weights_are_those_given_or_named_or_packaged(tmp_path: Path) -> None:
    file = tmp_path / "mine.safetensors"
    file.write_bytes(b"")
    node = read_recipe("msg_v").at(4)
    assert find_weights(node, 4).name == "msg_v_x4.safetensors"
    assert find_weights({**node, "weights": str(file)}, 4) == file
    (tmp_path / "msg_v_x4_clean.pth").write_bytes(b"")
    assert find_weights({**node, "weights": str(tmp_path)}, 4) == tmp_path / "msg_v_x4_clean.pth"
    with pytest.raises(ConfigError, match=r"weights: dsr comes with .*; method=msg_v at scale 2 needs weights=FILE"):
        find_weights(read_recipe("msg_v").at(2), 2)
    with pytest.raises(ConfigError, match=r"expected a file of weights for method=msg_v, got .*no such file"):
        find_weights({**node, "weights": str(tmp_path / "nowhere")}, 4)

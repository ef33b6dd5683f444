"""Weights that an installation does not come with: what says so, what fetches them, and what is taken for them."""

import functools
import http.server
import shutil

import pytest
from urllib3 import Retry

from dsr.cli import main
from dsr.data.download import fetching
from dsr.methods import weights
from dsr.methods.recipe import read_recipe
from dsr.utils.configuration import ConfigError

NAME = "dg_x4"


@pytest.fixture
def stripped(tmp_path, monkeypatch):
    """An installation without one file of weights, and a folder with what a server has, which has it."""
    source = weights.packaged_weights(NAME)
    weights.known()  # is read once
    (tmp_path / "package").mkdir()
    for name in weights.packaged_names():
        if name != NAME:
            (tmp_path / "package" / f"{name}.safetensors").symlink_to(weights.packaged_weights(name))
    (tmp_path / "server" / "weights").mkdir(parents=True)
    shutil.copy(source, tmp_path / "server" / "weights")
    monkeypatch.setattr(weights, "_HERE", tmp_path / "package")
    monkeypatch.setenv("DSR_DATA", str(tmp_path / "data"))
    monkeypatch.setattr(fetching, "RETRIES", Retry(0))
    return tmp_path


@pytest.fixture
def mirror(serve, stripped):
    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    return serve(functools.partial(Handler, directory=str(stripped / "server"))).url


@pytest.mark.usefixtures("stripped")
def test_a_method_without_its_weights_says_how_to_get_them():
    with pytest.raises(ConfigError, match=r"^weights: method=dg: dg_x4 does not come with .* `dsr data get weights`"):
        read_recipe("dg").weights(4)


def test_weights_are_fetched_and_used(mirror, stripped):
    assert main(["data", "get", "weights", "--mirror", mirror]) == 0
    assert read_recipe("dg").weights(4) == stripped / "data" / "weights" / f"{NAME}.safetensors"
    assert main(["data", "verify", "weights"]) == 0


def test_other_files_are_refused(mirror, stripped, capsys):
    (stripped / "server" / "weights" / f"{NAME}.safetensors").write_bytes(bytes(8) + b"{}")
    assert main(["data", "get", "weights", "--mirror", mirror]) == 2
    assert f"expected sha256 {weights.known()[NAME]}, which dsr knows" in capsys.readouterr().err
    place = stripped / "data" / "weights" / f"{NAME}.safetensors"
    place.parent.mkdir(exist_ok=True, parents=True)
    place.write_bytes(b"others")
    assert weights.packaged_weights(NAME) is None


@pytest.mark.usefixtures("stripped")
@pytest.mark.parametrize(
    ("more", "said"),
    [([], "no address of it is known"), (["--mirror", "http://127.0.0.1:9"], "no connection to 127.0.0.1:9")],
)
def test_offline_is_reported_in_one_line(more, said, capsys):
    assert main(["data", "get", "weights", *more]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: weights/{NAME}.safetensors: ")
    assert said in line

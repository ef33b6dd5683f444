"""Where the configuration files are found."""

from pathlib import Path

import pytest

from dsr.utils import configuration
from dsr.utils.configuration import config_directories

CHECKOUT = Path(__file__).resolve().parents[2] / "conf"


def test_configuration_of_an_installed_package_goes_before_that_of_a_checkout(tmp_path, monkeypatch):
    assert config_directories() == (CHECKOUT,)
    monkeypatch.setattr(configuration, "_PLACES", (tmp_path / "conf", CHECKOUT))
    assert config_directories() == (CHECKOUT,)
    (tmp_path / "conf").mkdir()
    (tmp_path / "conf" / "eval.yaml").touch()
    assert config_directories() == (tmp_path / "conf",)
    monkeypatch.setattr(configuration, "_PLACES", (tmp_path,))
    with pytest.raises(ValueError, match="the installation is incomplete"):
        config_directories()

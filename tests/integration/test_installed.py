"""From a wheel in an empty folder: ``dsr eval``, ``train`` and ``upsample``; and ``make dist``, what it refuses."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SMALL = ["metrics.lpips=false", "device=cpu"]


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Return a folder with the package as its wheel installs it; what it needs is taken from here."""
    folder = tmp_path_factory.mktemp("installed")
    source = folder / "source"
    names = ("src", "conf", "setup.py", "pyproject.toml", "MANIFEST.in", "README.md", "LICENSE")
    for name in names:
        if (REPOSITORY / name).is_dir():
            shutil.copytree(
                REPOSITORY / name, source / name, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
            )
        else:
            shutil.copy(REPOSITORY / name, source / name)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(source)]
    subprocess.run(build, check=True, capture_output=True, text=True)
    [wheel] = folder.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(folder / "site"), str(wheel)], check=True)
    shutil.rmtree(source)
    return folder / "site"


@pytest.fixture
def dsr(installed, tmp_path):
    """Return a runner of the installed command in an empty folder."""

    def run(*arguments):
        environment = {**os.environ, "PYTHONPATH": str(installed), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [sys.executable, str(installed / "bin" / "dsr"), *arguments],
            cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_the_wheel_holds_every_configuration_file(installed):
    def files(folder):
        return {path.relative_to(folder).as_posix() for path in folder.rglob("*.yaml")}

    assert files(installed / "dsr" / "conf") == files(REPOSITORY / "conf")


def test_installed_eval_writes_scores(dsr, tmp_path):
    dsr("eval", "dataset.size=64", "dataset.scenes=[statue]", "method=facets", "output_dir=out", *SMALL)
    assert (tmp_path / "out" / "scores.csv").is_file()


@pytest.mark.nightly
def test_installed_train_writes_weights(dsr, tmp_path):
    dsr("train", "trainer=smoke", "dataset.size=64", "dataset.count=6", "output_dir=out", *SMALL)
    assert (tmp_path / "out" / "weights.safetensors").is_file()


def test_installed_upsample_writes_depth(dsr, tmp_path):
    rng = np.random.default_rng(0)
    cv2.imwrite(str(tmp_path / "photo.png"), rng.integers(0, 256, (64, 64, 3), dtype=np.uint8))
    cv2.imwrite(str(tmp_path / "depth.png"), rng.integers(1000, 1100, (16, 16), dtype=np.uint16))
    dsr("upsample", "--rgb", "photo.png", "--depth", "depth.png", "--only", "depth", "--device", "cpu", "-o", "out")
    assert cv2.imread(str(tmp_path / "out" / "depth.png"), cv2.IMREAD_UNCHANGED).shape == (64, 64)


SCRIPT = REPOSITORY / "scripts" / "dist.py"


@pytest.fixture
def dist():
    specification = importlib.util.spec_from_file_location("dist", SCRIPT)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_a_folder_of_something_else_is_not_emptied(dist, tmp_path):
    (tmp_path / "depthsr-0.0.1.tar.gz").write_bytes(b"")
    (tmp_path / "photo.jpg").write_bytes(b"mine")
    with pytest.raises(dist.ReleaseError, match=r"expected an empty folder.*photo\.jpg"):
        dist.clear(tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    (tmp_path / "photo.jpg").unlink()
    dist.clear(tmp_path)
    assert not list(tmp_path.iterdir())

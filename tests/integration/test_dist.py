"""``make dist``: what it builds, and what it refuses."""

import importlib.util
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SCRIPT = REPOSITORY / "scripts" / "dist.py"


@pytest.fixture
def dist():
    specification = importlib.util.spec_from_file_location("dist", SCRIPT)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.mark.nightly  # test_installed.py builds a wheel and runs it
@pytest.mark.skipif(importlib.util.find_spec("build") is None, reason="needs the package build")
def test_release_is_built_and_runs_alone(tmp_path):
    command = [sys.executable, str(SCRIPT), "--offline", "--draft", "--output", str(tmp_path / "dist")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    files = {path.name: path for path in (tmp_path / "dist").iterdir()}
    [wheel], [source] = ([name for name in files if name.endswith(end)] for end in (".whl", ".tar.gz"))
    assert max(files[wheel].stat().st_size, files[source].stat().st_size) <= 60e6
    others = {
        "SHA256SUMS",
        *(f"{name}_x{scale}.safetensors" for name in ("facets_box", "sparse_to_dense") for scale in (4, 8)),
    }
    assert files.keys() == {wheel, source, *others}
    check = subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=tmp_path / "dist", check=False)
    assert check.returncode == 0
    assert "everything that dsr upsample needs is here" in done.stdout


def test_wheels_that_are_too_large_or_lack_weights_are_refused(dist, tmp_path):
    wheel = tmp_path / "dsr.whl"
    with zipfile.ZipFile(wheel, "w") as packed:
        packed.writestr("dsr/methods/weights/msg_x4.safetensors", b"x")
    with pytest.raises(dist.ReleaseError, match="expected the weights"):
        dist.check_wheel(wheel)
    with wheel.open("ab") as file:
        file.truncate(61_000_000)
    with pytest.raises(dist.ReleaseError, match="expected at most 60 MB, got 61"):
        dist.check_wheel(wheel)


def test_a_folder_of_something_else_is_not_emptied(dist, tmp_path):
    (tmp_path / "depthsr-0.0.1.tar.gz").write_bytes(b"")
    (tmp_path / "photo.jpg").write_bytes(b"mine")
    with pytest.raises(dist.ReleaseError, match=r"expected an empty folder.*photo\.jpg"):
        dist.clear(tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    (tmp_path / "photo.jpg").unlink()
    dist.clear(tmp_path)
    assert not list(tmp_path.iterdir())

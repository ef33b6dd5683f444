"""Files of the directory that a command is run in have no say in it: no code of theirs runs."""

import os
import subprocess
import sys
from pathlib import Path

import captures
import pytest

pytestmark = pytest.mark.slow
SCRIPT = "from dsr.__main__ import main\nif __name__ == '__main__':\n    main()\n"
MODULES = ("cv2", "json", "matplotlib", "multiprocessing", "numpy", "pickle", "pydantic", "rich", "sitecustomize",
           "torch", "usercustomize", "yaml", "zlib")  # fmt: skip


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A directory full of files that leave a mark when they are run."""
    folder = tmp_path / "work"
    folder.mkdir()
    mark = f"open({str(tmp_path / 'mark')!r}, 'a').write(__name__)\n"
    for name in MODULES:
        (folder / f"{name}.py").write_text(mark)
    (folder / "hydra_plugins").mkdir()
    (folder / "hydra_plugins" / "mine.py").write_text(mark)
    (folder / "conf" / "method").mkdir(parents=True)
    (folder / "conf" / "method" / "nearest.yaml").write_text("_target_: os.getcwd\n")
    (tmp_path / "dsr.script").write_text(SCRIPT)
    for number in range(2):
        captures.save(tmp_path / "in" / "rgb" / f"{number}.png", captures.photo(number))
        captures.save(tmp_path / "in" / "depth" / f"{number}.png", captures.millimetres(number))
    return folder


def run(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command in a directory as the installed script does."""
    modules = [path for path in sys.path if path and Path(path).resolve() != folder]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(modules), "OMP_NUM_THREADS": "1"}
    environment.pop("LD_LIBRARY_PATH", None)
    return subprocess.run(
        [sys.executable, str(folder.parent / "dsr.script"), *map(str, arguments)],
        check=False, cwd=folder, env=environment, capture_output=True, text=True, timeout=300,
    )  # fmt: skip


def upsampling(folder: Path, workers: int) -> tuple[object, ...]:
    root = folder.parent
    return ("upsample", "--rgb", root / "in" / "rgb", "--depth", root / "in" / "depth", "-o", root / "out", "--method",
            "nearest", "--only", "depth,before_after", "--workers", workers)  # fmt: skip


def test_no_code_of_the_working_directory_counts_for_a_command_and_its_workers(hostile, tmp_path):
    done = run(hostile, *upsampling(hostile, 2))
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "1" / "before_after.png").is_file()
    arguments = ["dataset=procedural", "dataset.count=1", "dataset.size=32", "scale=2", "method=nearest",
                 "metrics.lpips=false", "device=cpu", f"output_dir={tmp_path / 'runs' / 'a'}"]  # fmt: skip
    done = run(hostile, "eval", *arguments)
    assert (done.returncode, done.stderr) == (0, "")
    assert not (tmp_path / "mark").exists()

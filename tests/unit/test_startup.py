"""Commands answer at once: what takes seconds to import is imported when a request has proved valid."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
HEAVY = (
    "cv2", "h5py", "lightning", "matplotlib", "pandas", "scipy", "skimage", "tensorboard", "torch", "torchmetrics",
    "trimesh",
)  # fmt: skip
PROGRAM = """
import atexit, runpy, sys
heavy = set({heavy!r})
atexit.register(lambda: print("HEAVY", *sorted(heavy & sys.modules.keys()), file=sys.stderr))
sys.argv = {argv!r}
{start}
"""
SCRIPT = "runpy.run_path(sys.argv[0], run_name='__main__')"
MODULE = "runpy.run_module('dsr', run_name='__main__')"
COMMANDS = {
    "dsr --help": 0, "dsr --version": 0, "dsr completion bash": 0, "dsr fuse out --outptu mesh.ply": 2,
    "dsr upsample --help": 0, "dsr upsample --rgb a --depth b -o out --mehtod x": 2,
    "dsr upsample --rgb a --depth b -o out --fov 270": 2, "dsr upsample --rgb a --depth b -o out --method nosuch": 2,
    "dsr upsample --rgb a --depth b -o out --only nosuch": 2, "dsr upsample --rgb a --depth b -o out --shard 4/3": 2,
    "dsr upsample --rgb a -o out": 2, "dsr report runs -o out --only nosuch": 2,
    "dsr fuse out -o mesh.ply --voxel 0": 2, "dsr view out --most 0": 2,
    "dsr export --onnx file.onnx --method nosuch": 2, "dsr data where": 0, "dsr eval --help": 0,
    "dsr eval -m method=bicubic,nosuch": 2, "dsr train trainer=nosuch": 2, "eval.py --cfg job": 0,
    "eval.py method.nosuch=1": 2, "eval.py scale=3": 2, "eval.py --config-dir=nowhere": 2,
    "train.py trainer.max_steps=many": 2, "train.py loss.w=-1": 2,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_startup_imports_nothing_heavy(command, tmp_path):
    program, *arguments = command.split()
    script = "dsr" if program == "dsr" else str(REPOSITORY / program)
    code = PROGRAM.format(heavy=HEAVY, argv=[script, *arguments], start=MODULE if program == "dsr" else SCRIPT)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=dict(os.environ), capture_output=True, text=True, check=False
    )
    assert done.returncode == COMMANDS[command], done.stderr
    assert done.stderr.splitlines()[-1].strip() == "HEAVY"

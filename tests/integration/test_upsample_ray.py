"""``dsr upsample`` with Ray Data: an actor dies half-way, and nothing is lost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from small_frames import results, write_frames

from dsr.cli import main

pytest.importorskip("ray", reason="pip install dsr[ray]")

REPOSITORY = Path(__file__).resolve().parents[2]
METHOD = '''
import os
import signal
from pathlib import Path

from dsr.methods.classical.interpolation import Interpolation

calls = 0


class Mortal(Interpolation):
    """Kills its process at the third frame, if no other process did before."""

    def interpolate(self, *arguments):
        global calls
        calls += 1
        if calls == 3:
            try:
                os.close(os.open(Path(__file__).with_name("died"), os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                pass
            else:
                os.kill(os.getpid(), signal.SIGKILL)
        return super().interpolate(*arguments)
'''
PROGRAM = """
import json
import sys
from pathlib import Path

import ray

from dsr.app.upsample.ray_data import upsample_frames
from dsr.app.upsample.request import UpsampleRequest
from dsr.io.reading import CameraChoice, Reading

ray.init("local", num_cpus=2, include_dashboard=False)
request = UpsampleRequest(
    output=Path("by_ray"),
    folders=(Path("frames"),),
    reading=Reading(CameraChoice(fov=60)),
    method="mortal",
    directories=(Path("conf"),),
    parts=("depth", "normals"),
)
rows = [dict(row) for row in upsample_frames(request, actors=2)]
Path("rows.json").write_text(json.dumps(rows))
"""


def test_actor_that_is_killed_loses_no_frame(tmp_path, monkeypatch):
    count, damaged = 22, "007"
    write_frames(tmp_path / "frames", count, holes=0)
    (tmp_path / "frames" / "depth" / f"{damaged}.png").write_bytes(b"\x89PNG nothing")
    (tmp_path / "conf" / "method").mkdir(parents=True)
    (tmp_path / "conf" / "method" / "mortal.yaml").write_text("name: mortal\nlabel: Mortal\ntarget: mortal.Mortal\n")
    (tmp_path / "mortal.py").write_text(METHOD)
    (tmp_path / "program.py").write_text(PROGRAM)
    paths = os.pathsep.join([str(REPOSITORY / "src"), str(tmp_path)])
    environment = {**os.environ, "PYTHONPATH": paths, "RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1"}
    run = subprocess.run(  # noqa: PLW1510 - its code is compared below
        [sys.executable, "program.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=280
    )
    assert run.returncode == 0, run.stderr[-2000:]
    assert (tmp_path / "died").is_file()
    rows = {row["name"]: row for row in json.loads((tmp_path / "rows.json").read_text())}
    assert rows.keys() == {f"{number:03}" for number in range(count)}
    assert [name for name, row in rows.items() if row["problem"]] == [damaged]
    assert "007.png" in rows[damaged]["problem"]
    assert {row["outcome"] for name, row in rows.items() if name != damaged} <= {"done", "complete already"}

    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    options = ("--method", "mortal", "--config-dir", "conf", "--fov", "60", "--only", "depth,normals")
    assert main(["upsample", "frames", "-o", "alone", *options]) == 2
    alone = results(tmp_path / "alone")
    assert len(alone) == 4 * (count - 1)
    assert results(tmp_path / "by_ray") == alone

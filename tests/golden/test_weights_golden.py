"""The weights that come with dsr, on scenes that they were neither trained on nor chosen with."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
VISUAL = ("RMSE_v", "DSSIM_v", "BadPix_v_5", "Bumpiness_d", "LPIPS_v")


@pytest.fixture(scope="module")
def ratios(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> pd.DataFrame:
    """Ours / published MSG-V on Lucy and Plant, as the benchmark prints them."""
    file = tmp_path_factory.mktemp("ratios") / "ratios.csv"
    command = [sys.executable, str(REPOSITORY / "benchmarks" / "against_published.py")]
    done = subprocess.run(
        [*command, "--shared", str(shared), "--csv", str(file)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "average" in done.stdout
    return pd.read_csv(file)


def test_facets_beat_the_published_network_in_every_visual_metric_of_every_case(ratios: pd.DataFrame) -> None:
    facets = ratios[ratios["method"] == "facets"]
    assert len(facets) >= 2
    assert float(facets[[*VISUAL]].max().max()) < 1.0
    assert float(facets["RMSE_v"].mean()) < 0.80

"""``python eval.py`` and ``python train.py`` on data sets in their owners' formats."""

from pathlib import Path

import cv2
import pandas as pd
from commands import run_python
from upsampling import refused_line

from dsr.cli import main

REPOSITORY = Path(__file__).resolve().parents[2]
QUICK = ("metrics.lpips=false", "device=cpu")


def test_real_scenes_of_several_datasets_are_evaluated_by_one_command(monkeypatch, tmp_path, shared):
    monkeypatch.setenv("DSR_DATA", str(shared / "real"))
    done = run_python(
        str(REPOSITORY / "eval.py"), "-m", "dataset=icl,sunrgbd", "dataset.scenes=found", "dataset.size=64",
        "method=bicubic", *QUICK, cwd=tmp_path,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    scores = pd.concat(pd.read_csv(path) for path in tmp_path.glob("outputs/eval/*/scores.csv"))
    assert scores.groupby("dataset")["scene"].nunique().to_dict() == {"icl": 2, "sunrgbd": 2}
    assert scores["value"].notna().all()
    assert scores[scores["metric"] == "RMSE_d"]["valid_share"].between(0.6, 1).all()
    pictures = sorted(path.stem for path in tmp_path.glob("outputs/eval/*_icl*/pictures/*.png"))
    assert pictures == ["living", "office_0000"]


def test_prepare_draws_a_contact_sheet_and_errors_are_one_line(tmp_path, monkeypatch, capsys, shared, dsr_cache):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DSR_DATA", str(shared / "real"))
    assert main(["data", "prepare", "icl", "dataset.scenes=found", "dataset.size=64"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "contact sheet: outputs/data/icl/sheet.png"
    assert cv2.imread("outputs/data/icl/sheet.png").shape[1] > 1000
    monkeypatch.setenv("DSR_DATA", "nowhere")
    wrong = {
        ("icl",): "dataset=icl: expected its files in nowhere/icl_nuim",
        ("icl", "dataset.sizes=3"): "dataset.sizes: unknown key; expected one of ",
        ("paper_train",): "dataset=paper_train: several data sets",
    }
    for arguments, message in wrong.items():
        assert refused_line(capsys, main(["data", "prepare", *arguments])).startswith(message)
    assert [path.name for path in tmp_path.iterdir()] == ["outputs"]

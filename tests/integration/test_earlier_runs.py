"""Runs of an earlier version, whose modules and files had other names: evaluated, reported and shown in a study."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import torch

from dsr.app.moved_targets import MOVED_TARGETS
from dsr.app.run_directory import claim
from dsr.app.schema import TrainConfig
from dsr.app.training_runs import read_config, studies_of_run, training_data
from dsr.cli import main
from dsr.data.procedural import Procedural
from dsr.evaluation.run_files import load_results
from dsr.methods.networks.msg_net import MSGNet
from dsr.utils.builder import build, load_object

EARLIER = Path(__file__).resolve().parents[1] / "golden" / "earlier_runs"
"""A training and its evaluation: a smoke training on small random scenes, four steps."""


def test_moved_targets_are_where_the_table_says():
    for before, now in MOVED_TARGETS.items():
        assert callable(load_object("target", now, "a class or function")), now
        assert now not in MOVED_TARGETS, before


def test_configuration_of_an_earlier_training_describes_its_network_and_data():
    config = read_config(EARLIER / "train")
    assert isinstance(build("model", config["model"], {"scale": config["scale"]}), MSGNet)
    data = training_data(TrainConfig.of(config))
    assert [type(source) for source, _ in data.validation_scenes().values()] == [Procedural]


def test_configuration_that_lacks_later_keys_has_their_defaults():
    config = read_config(EARLIER / "train")
    trainer = {key: value for key, value in config["trainer"].items() if key not in ("photo", "init", "accumulate")}
    settings = TrainConfig.of({**config, "trainer": trainer}).trainer
    assert (settings.photo, settings.init, settings.accumulate) == (0.5, None, 1)


def test_earlier_training_is_evaluated_on_its_validation_scenes(tmp_path):
    shutil.copytree(EARLIER / "train", tmp_path / "train")
    (tmp_path / "train" / "weights.safetensors").write_bytes(b"")
    plain = {"run": str(tmp_path / "train"), "output_dir": None}
    [(config, source)] = studies_of_run(plain, [])
    assert source.scenes() == ["00005"]
    assert config["downsampling"]["target"] == "dsr.degradation.downsampling.Downsampling"


def test_identity_of_an_earlier_run_does_not_change_with_the_names_of_modules(tmp_path):
    config = read_config(EARLIER / "train")
    earlier = {"dataset": {"target": "dsr.data.procedural.source.Procedural"}}
    (tmp_path / "versions.json").write_text(json.dumps({"identity": earlier}))
    assert claim(tmp_path, config, {"dataset": {"target": "dsr.data.procedural.Procedural"}}) == []


def test_earlier_evaluation_is_read_with_its_sample_prediction_and_scores():
    [run] = load_results([EARLIER / "eval"]).runs
    assert (run.label, run.scale, run.scenes) == ("msg_v", 4, ("00005",))
    sample = run.sample("00005")
    assert (sample.depth_lr.shape, sample.depth_lr.dtype) == ((1, 16, 16), torch.float32)
    assert run.prediction("00005").shape == sample.depth.shape == (1, 64, 64)
    assert len(run.scores) == 39


def test_report_and_study_are_made_of_earlier_runs(tmp_path):
    for label in ("MSG-V", "Other"):
        copy = tmp_path / "runs" / label
        shutil.copytree(EARLIER / "eval", copy)
        summary = json.loads((copy / "summary.json").read_text())
        (copy / "summary.json").write_text(json.dumps({**summary, "label": label}))
    assert main(["report", str(tmp_path / "runs"), "-o", str(tmp_path / "report"), "--only", "tables,page"]) == 0
    table = (tmp_path / "report" / "tables" / "procedural_x4_box.md").read_text()
    assert "228.1" in table
    assert "MSG-V" in (tmp_path / "report" / "index.html").read_text()
    assert main(["study", "build", str(tmp_path / "runs"), "-o", str(tmp_path / "study")]) == 0
    assert (tmp_path / "study" / "key.json").is_file()


def test_data_set_whose_module_was_renamed_keeps_its_name_in_a_report(make_run, tmp_path):
    for name, target in (("a", "dsr.data.procedural.source.Procedural"), ("b", "dsr.data.procedural.Procedural")):
        make_run(tmp_path / name, label=name, dataset="procedural", scenes=("s",))
        versions = json.loads((tmp_path / name / "versions.json").read_text())
        versions["identity"]["dataset"] = {"name": "procedural", "target": target}
        (tmp_path / name / "versions.json").write_text(json.dumps(versions))
    assert [run.dataset for run in load_results([tmp_path]).runs] == ["procedural", "procedural"]

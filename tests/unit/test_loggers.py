"""The loggers of trainings: what they keep, and what they show first."""

import csv
import importlib.util
import re

import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2

from dsr.training import loggers
from dsr.training.loggers import log_layout, log_picture, log_settings
from dsr.utils.configuration import ConfigError
from dsr.utils.lightning import ValidationTable


@pytest.fixture(autouse=True)
def _first_process(monkeypatch):
    monkeypatch.setattr(rank_zero_only, "rank", 0)


def rows_of(folder):
    with (folder / "csv" / "metrics.csv").open(newline="") as file:
        return [{name: value for name, value in row.items() if value} for row in csv.DictReader(file)]


@pytest.mark.filterwarnings("ignore:.*exists and is not empty.*")
def test_table_has_a_row_for_each_step_and_goes_on_after_an_interruption(tmp_path):
    first = loggers.CsvLog(tmp_path)
    first.log_metrics({"train/loss": 0.5, "epoch": 0.0}, 9)
    first.log_metrics({"val/RMSE_v": 0.25}, 9)
    first.log_metrics({"train/loss": 0.75}, 19)
    first.finalize("failed")
    assert rows_of(tmp_path)[0] == {"step": "9", "train/loss": "0.5", "val/RMSE_v": "0.25"}
    again = loggers.CsvLog(tmp_path)
    again.log_metrics({"train/loss": 0.125}, 19)  # done again
    again.finalize("success")
    both = [{"step": "9", "train/loss": "0.5", "val/RMSE_v": "0.25"}, {"step": "19", "train/loss": "0.125"}]
    assert rows_of(tmp_path) == both
    last = loggers.CsvLog(tmp_path)
    last.log_metrics({"val/RMSE_v": 0.5}, 19)  # of a training that was interrupted during a validation
    last.finalize("success")
    assert rows_of(tmp_path) == [both[0], {**both[1], "val/RMSE_v": "0.5"}]


def test_layout_of_tensorboard_begins_with_looks(tmp_path):
    logger = TensorBoardLogger(tmp_path, name=None, version="tensorboard")
    names = ("BadPix_v_5", "RMSE_d", "LPIPS_v", "RMSE_v1", "DSSIM_v", "RMSE_v")
    log_layout(logger, {name: f"{name}, title" for name in names})
    logger.finalize("success")
    events = EventAccumulator(str(tmp_path / "tensorboard"), size_guidance={"tensors": 0}).Reload()
    layout = layout_pb2.Layout.FromString(events.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0])
    charts = {category.title: [chart.title for chart in category.chart] for category in layout.category}
    assert list(charts) == ["Looks", "Depth and normals", "Training"]
    assert charts["Looks"] == [f"{name}, title" for name in ("RMSE_v", "RMSE_v1", "DSSIM_v", "LPIPS_v", "BadPix_v_5")]
    assert charts["Depth and normals"] == ["RMSE_d, title"]
    [tag] = layout.category[0].chart[0].multiline.tag
    shown = ("val/RMSE_v", "bicubic/RMSE_v", "val_a/RMSE_v", "bicubic_a/RMSE_v")
    assert all(re.match(tag, name) for name in shown)
    assert not any(re.match(tag, name) for name in ("val/RMSE_v1", "bicubic/RMSE_d"))


def test_run_of_mlflow_has_values_settings_and_pictures_and_goes_on(tmp_path, monkeypatch):
    if importlib.util.find_spec("mlflow") is None:
        pytest.skip("pip install -e '.[mlflow]'")
    from mlflow.tracking import MlflowClient  # noqa: PLC0415

    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    for value, step in ((0.5, 9), (0.25, 19)):
        logger = loggers.mlflow(tmp_path)
        logger.log_metrics({"train/loss": value}, step)
    log_settings(logger, {}, {"scale": 4, "model": {"name": "msg_v"}})
    log_picture(logger, "renderings/a_0", torch.zeros(3, 8, 8, dtype=torch.uint8), 20)
    client = MlflowClient((tmp_path / "mlruns").as_uri())
    number = (tmp_path / "mlflow_run.txt").read_text().strip()
    assert [(each.step, each.value) for each in client.get_metric_history(number, "train/loss")] == [
        (9, 0.5), (19, 0.25)
    ]  # fmt: skip
    assert client.get_run(number).data.params == {"scale": "4", "model/name": "msg_v"}
    assert [each.path for each in client.list_artifacts(number, "renderings/a_0")] == ["renderings/a_0/000020.png"]


def test_run_of_wandb_without_the_service_is_in_files_of_the_run(tmp_path, monkeypatch):
    if importlib.util.find_spec("wandb") is None:
        pytest.skip("pip install -e '.[wandb]'")
    logger = loggers.wandb(tmp_path, mode="offline")
    logger.log_metrics({"train/loss": 0.5}, 9)
    log_picture(logger, "renderings/a_0", torch.zeros(3, 8, 8, dtype=torch.uint8), 20)
    logger.finalize("success")
    number = (tmp_path / "wandb_run.txt").read_text().strip()
    [folder] = (tmp_path / "wandb").glob("offline-run-*")
    assert (folder / f"run-{number}.wandb").stat().st_size > 0
    assert len(list(folder.glob("files/media/images/renderings/*.png"))) == 1


@pytest.mark.parametrize("name", ["wandb", "mlflow"])
def test_logger_that_is_not_installed_is_named_with_its_extra(tmp_path, monkeypatch, name):
    monkeypatch.setitem(__import__("sys").modules, name, None)
    with pytest.raises(
        ValueError, match=rf"^logger={name}: expected {name}, which is not installed; pip install -e '.\[{name}\]' in a"
    ):
        getattr(loggers, name)(tmp_path)


@pytest.mark.parametrize(
    "content", [b"step,train/loss\n\xff,1\n", b"loss\n1\n", b"step\n" + b"1" * 5000 + b"\n", b"step\n" + b"x" * 200_000]
)
def test_table_that_is_damaged_is_named_in_one_line(tmp_path, content):
    (tmp_path / "csv").mkdir()
    (tmp_path / "csv" / "metrics.csv").write_bytes(content)
    with pytest.raises(ValueError, match=r"csv/metrics\.csv: expected the table of a training's log, got a damaged"):
        loggers.CsvLog(tmp_path)


@pytest.mark.parametrize("content", [b"step\nx\n", b"step,set,metric,value\n1,a\n", b"\xff", b"s\n\n"])
def test_validations_that_are_damaged_are_named_before_a_step(tmp_path, content):
    path = tmp_path / "validation.csv"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=rf"^{path}: expected the scores of a training's validations"):
        ValidationTable(path).on_train_start(None, None)


def test_run_that_has_settings_of_wandb_sends_its_log_nowhere(tmp_path, monkeypatch):
    monkeypatch.setattr(loggers, "expect_installed", lambda _: None)
    (tmp_path / "wandb").mkdir()
    (tmp_path / "wandb" / "settings").write_text("[default]\nbase_url = http://elsewhere\n")
    with pytest.raises(ValueError, match=r"expected no settings of wandb in the run's directory, got .*wandb/settings"):
        loggers.wandb(tmp_path)

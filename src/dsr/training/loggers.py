"""Where a training is logged, beside Lightning's TensorBoardLogger: logs that go on after an interruption."""

from __future__ import annotations

import csv as tables
import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from lightning.pytorch.loggers import CSVLogger, Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor

from dsr.metrics.formats import main_first
from dsr.utils.configuration import expect_library
from dsr.utils.files import write_text
from dsr.utils.guards import MOST_TABLE, read_limited
from dsr.utils.runs_table import list_run

_CURVES = ("loss", "gradient_norm")
_LARGEST_NUMBER = 1 << 10
"""Largest size in bytes of a file with a number."""
_ROWS_AT_ONCE = 10
"""Rows of a table that are written together."""
OPTIONAL = ("wandb", "mlflow")
"""Loggers that need the library of their name, which an extra of that name installs."""
RUN_IDS = {name: f"{name}_run.txt" for name in OPTIONAL}
"""The files in a run's directory with the numbers that services have given to the run."""


def expect_installed(name: str) -> None:
    """Check that the library of a logger, if it needs one, is installed.

    Args:
        name: the logger's.

    Raises:
        ConfigError: it is not.

    """
    if name in OPTIONAL:
        expect_library(f"logger={name}", name, name)


class CsvLog(CSVLogger):
    """A table of all logged values, a row for each step; rows of later steps, from before an interruption, go.

    Args:
        save_dir: the run's directory; the table is ``csv/metrics.csv`` in it.

    """

    def __init__(self, save_dir: str | Path) -> None:
        super().__init__(save_dir, name="", version="csv", flush_logs_every_n_steps=sys.maxsize)
        self._before = _read_table(Path(save_dir) / "csv" / "metrics.csv")

    @rank_zero_only
    def log_metrics(self, metrics: Any, step: int | None = None) -> None:
        """Add values to the table, all but the epoch, as there is only one."""
        values: dict[str, Tensor | float] = {name: float(value) for name, value in metrics.items() if name != "epoch"}
        if not values:
            return
        if self._before:
            kept = [row for row in self._before if step is None or int(row["step"]) <= step]
            self._before = []
            self.experiment.metrics.extend(kept)
        rows = self.experiment.metrics
        if rows and step is not None and rows[-1]["step"] == step:
            rows[-1].update(values)
        else:
            if len(rows) >= _ROWS_AT_ONCE:
                self.save()
            super().log_metrics(values, step)


class WandbLog(WandbLogger):
    """Weights & Biases, a run of which ends with the training."""

    @rank_zero_only
    def finalize(self, status: str) -> None:
        """End the run, so that the next training of a multirun has one of its own."""
        super().finalize(status)
        self.experiment.finish(exit_code=0 if status == "success" else 1)


def wandb(
    save_dir: str | Path, project: str = "dsr", entity: str | None = None, mode: Literal["online", "offline"] = "online"
) -> Logger:
    """Return the logger of Weights & Biases.

    Args:
        save_dir: the run's directory, which gives the run its name; local files are written to ``wandb`` in it.
        project: of the service.
        entity: user or team; None for the user's default.
        mode: ``offline`` for local files alone, which ``wandb sync`` uploads later.

    Raises:
        ValueError: wandb is not installed, or refuses to begin a run, such as without a login; or the run's directory
            has settings of it, which may be a stranger's, and send the log and the login elsewhere.

    """
    expect_installed("wandb")
    folder = Path(save_dir)
    if os.path.lexists(folder / "wandb" / "settings"):
        raise ValueError(f"save_dir: expected no settings of wandb in the run's directory, got {folder}/wandb/settings")
    import wandb as client  # noqa: PLC0415 - optional

    if getattr(rank_zero_only, "rank", 0):  # the first process logs
        return WandbLog(project=project)
    try:
        run = client.init(
            name=folder.name, dir=folder, project=project, entity=entity, mode=mode, resume="allow",
            id=_read_number(folder, "wandb"), settings=client.Settings(silent=True, console="off"),
        )  # fmt: skip
    except client.Error as error:
        raise ValueError(f"mode: wandb: {error}; wandb login, or logger.wandb.mode=offline for local files") from error
    run.define_metric("trainer/global_step")
    run.define_metric("*", step_metric="trainer/global_step", step_sync=True)
    _write_number(folder, "wandb", run.id)
    return WandbLog(project=project, experiment=run)


def mlflow(save_dir: str | Path, experiment: str = "dsr", tracking_uri: str | None = None) -> Logger:
    """Return the logger of MLflow.

    Args:
        save_dir: the run's directory, which gives the run its name.
        experiment: name of the experiment that the run belongs to.
        tracking_uri: address of a server or a store; None for ``$MLFLOW_TRACKING_URI``, or files in ``mlruns`` of the
            run's directory.

    Raises:
        ValueError: MLflow is not installed, or the store cannot be used.

    """
    expect_installed("mlflow")
    folder = Path(save_dir)
    from mlflow.exceptions import MlflowException  # noqa: PLC0415 - optional

    uri = tracking_uri or os.environ.get("MLFLOW_TRACKING_URI") or (folder / "mlruns").absolute().as_uri()
    if uri.startswith("file:"):
        os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
    try:
        logger = MLFlowLogger(experiment, folder.name, uri, run_id=_read_number(folder, "mlflow"))
        _write_number(folder, "mlflow", logger.run_id)
    except MlflowException as error:
        raise ValueError(f"tracking_uri: {uri}: {error}") from error
    return logger


def log_config(logger: Logger | None, text: str) -> None:
    """Log the complete configuration for readers, so that TensorBoard shows the run before it has values.

    Args:
        logger: of the training; others than TensorBoard's are left out.
        text: in Markdown.

    """
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_text("config", text)
        logger.experiment.flush()


def log_settings(logger: Logger | None, table: Mapping[str, Any], config: Mapping[str, Any]) -> None:
    """Log the settings of a training.

    Args:
        logger: of the training.
        table: the main settings, among them the columns of TensorBoard's table of runs.
        config: the complete configuration, for other loggers.

    """
    if isinstance(logger, TensorBoardLogger):
        logger.log_hyperparams(dict(table))
        list_run(logger.experiment, "training", table, {})
    elif logger is not None:
        logger.log_hyperparams(dict(config))


def log_layout(logger: Logger | None, metrics: Mapping[str, str], losses: Sequence[str] = _CURVES) -> None:
    """Lay out TensorBoard's *Custom scalars*: metrics of renderings first, then those of depth, then losses.

    A chart has a metric's mean over all validation sets and, if there are several, that of each, of the network and of
    bicubic interpolation.

    Args:
        logger: of the training; others than TensorBoard's have no layout.
        metrics: titles of the validation's metrics, by name.
        losses: names of values of the training.

    """
    if not isinstance(logger, TensorBoardLogger):
        return
    looks = main_first(name for name in metrics if "_v" in name)
    depth = [name for name in metrics if name not in looks]
    groups = {
        **{title: {metrics[name]: rf"(val|bicubic)(_[^/]*)?/{re.escape(name)}$" for name in names}
           for title, names in (("Looks", looks), ("Depth and normals", depth))},
        "Training": {name: f"train/{name}$" for name in losses},
    }  # fmt: skip
    layout = {title: {name: ["Multiline", [tag]] for name, tag in charts.items()} for title, charts in groups.items()}
    logger.experiment.add_custom_scalars({title: charts for title, charts in layout.items() if charts})


def log_picture(logger: Any, tag: str, picture: Tensor, step: int) -> None:
    """Log a picture where pictures are shown.

    Args:
        logger: of the training.
        tag: the picture's name.
        picture: (3, H, W) uint8.
        step: of the training.

    """
    array = picture.permute(1, 2, 0).numpy()
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_image(tag, picture, step)
    elif isinstance(logger, WandbLogger):
        logger.log_image(tag, [array], caption=[f"step {step}"])
    elif isinstance(logger, MLFlowLogger):
        logger.experiment.log_image(logger.run_id, array, artifact_file=f"{tag}/{step:06}.png")


def _read_table(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a table without empty cells; a row that was cut off is left out."""
    if not path.is_file():
        return []
    try:
        lines = read_limited(path, MOST_TABLE).decode().splitlines(keepends=True)
        rows = [row for row in tables.DictReader(lines) if None not in row and None not in row.values()]
        whole = [row for row in rows if row["step"].isdecimal()]
        return [{name: value for name, value in row.items() if value} | {"step": int(row["step"])} for row in whole]
    except (ValueError, KeyError, OSError, tables.Error) as error:
        raise ValueError(f"{path}: expected the table of a training's log, got a damaged one") from error


def _read_number(folder: Path, service: str) -> str | None:
    """Return the number that a service has given to the run, None for a new run."""
    try:
        text = read_limited(folder / RUN_IDS[service], _LARGEST_NUMBER).decode().strip()
    except (OSError, ValueError):
        return None
    return text if re.fullmatch(r"\w{1,64}", text) else None


@rank_zero_only
def _write_number(folder: Path, service: str, number: Any) -> None:
    """Keep the number that a service has given to the run."""
    write_text(folder / RUN_IDS[service], f"{number}\n")

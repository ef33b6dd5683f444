"""What a training writes to its loggers, which are Lightning's, beside values."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from lightning.pytorch.loggers import Logger, MLFlowLogger, TensorBoardLogger, WandbLogger
from torch import Tensor

from dsr.metrics.formats import main_first
from dsr.utils.configuration import expect_library
from dsr.utils.runs_table import list_run

_CURVES = ("loss", "gradient_norm")
OPTIONAL = ("wandb", "mlflow")  # loggers that need the library of their name, which an extra of that name installs


def expect_installed(name: str) -> None:
    """Raise ConfigError if a logger needs a library that is not installed."""
    if name in OPTIONAL:
        expect_library(f"logger={name}", name, name)


def log_config(logger: Logger | None, text: str) -> None:
    """Log the configuration as Markdown, so that TensorBoard shows the run before it has values."""
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_text("config", text)
        logger.experiment.flush()


def log_settings(logger: Logger | None, table: Mapping[str, Any], config: Mapping[str, Any]) -> None:
    """Log the main settings to TensorBoard and its table of runs, the complete configuration to other loggers."""
    if isinstance(logger, TensorBoardLogger):
        logger.log_hyperparams(dict(table))
        list_run(logger.experiment, "training", table, {})
    elif logger is not None:
        logger.log_hyperparams(dict(config))


def log_layout(logger: Logger | None, metrics: Mapping[str, str], losses: Sequence[str] = _CURVES) -> None:
    """Lay out TensorBoard's *Custom scalars*: metrics of renderings first, then those of depth, then losses.

    A chart has a metric's mean over all validation sets and, if there are several, the means of each, of the network
    and of bicubic interpolation. ``metrics`` are the titles of the validation's metrics by name.
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
    """Log a picture, (3, H, W) uint8, where pictures are shown."""
    array = picture.permute(1, 2, 0).numpy()
    if isinstance(logger, TensorBoardLogger):
        logger.experiment.add_image(tag, picture, step)
    elif isinstance(logger, WandbLogger):
        logger.log_image(tag, [array], caption=[f"step {step}"])
    elif isinstance(logger, MLFlowLogger):
        logger.experiment.log_image(logger.run_id, array, artifact_file=f"{tag}/{step:06}.png")

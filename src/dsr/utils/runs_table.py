"""TensorBoard's table of runs, *HParams*: one set of columns for trainings, evaluations and optimisations of an image.

TensorBoard takes the columns from the first run that it finds, so all have to have the same ones, of the same types.
"""

from collections.abc import Mapping
from typing import Any, Literal

from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.plugins.hparams import metadata
from tensorboard.plugins.hparams.api_pb2 import DataType, Experiment, HParamInfo, MetricInfo, MetricName
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from torch.utils.tensorboard.summary import hparams
from torch.utils.tensorboard.writer import SummaryWriter

Kind = Literal["training", "evaluation", "optimisation"]
# TensorBoard sorts settings that differ, and then the others, by name, and shows five until more are chosen.
COLUMNS = ("dataset", "degradation", "method", "scale", "w", "kind", "seed", "steps")
_COMPARED = COLUMNS[:5]
_NUMBERS = ("scale", "seed")  # that every run has; the others are text, as the type must not differ between runs
SCORES = {
    "RMSE_v": "RMSE_v (1/1000)",
    "RMSE_v1": "RMSE_v1 (1/1000), worst light",
    "DSSIM_v": "DSSIM_v (1/1000), worst light",
    "LPIPS_v": "LPIPS_v (1/1000), worst light",
    "RMSE_d": "RMSE_d (mm)",
    "BadPix_v_5": "BadPix_v (5, %), worst light",
    "Bumpiness_d": "Bump_d",
}  # with the headings of their columns, in the units of tables


def list_run(writer: SummaryWriter, kind: Kind, settings: Mapping[str, Any], scores: Mapping[str, float]) -> None:
    """Put a run into the table of runs; settings of other names are left out, and absent ones are a dash."""
    given = {**settings, "kind": kind}
    values = {}
    for name in COLUMNS:
        value = given.get(name)
        text = "-" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
        values[name] = value if name in _NUMBERS else text
    types = {name: DataType.DATA_TYPE_FLOAT64 if name in _NUMBERS else DataType.DATA_TYPE_STRING for name in COLUMNS}
    experiment = Experiment(
        hparam_infos=[HParamInfo(name=name, type=type_, differs=name in _COMPARED) for name, type_ in types.items()],
        metric_infos=[
            MetricInfo(name=MetricName(tag=f"score/{name}"), display_name=title) for name, title in SCORES.items()
        ],
    )
    about = metadata.create_summary_metadata(HParamsPluginData(experiment=experiment))
    columns = Summary(value=[Summary.Value(tag=metadata.EXPERIMENT_TAG, metadata=about)])
    _, start, end = hparams(values, {})
    for part in (columns, start, end):
        writer.file_writer.add_summary(part)  # type: ignore[attr-defined]  # torch's stubs say None
    list_scores(writer, scores)


def list_scores(writer: SummaryWriter, scores: Mapping[str, float], step: int = 0) -> None:
    """Write the scores of a run that is in the table of runs, in place of those of earlier steps."""
    for name, value in scores.items():
        writer.add_scalar(f"score/{name}", value, step)

"""What trainings show first in TensorBoard."""

import re

from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2

from dsr.training.callbacks import log_layout


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

"""Trainings without Hydra: the lines of docs/python.md, stock loggers, and checkpoints that say what they are of."""

import functools
import re
from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from small_scenes import sample_of, step
from torch import Tensor

from dsr.data.rendered import Procedural
from dsr.degradation.downsampling import Downsampling
from dsr.degradation.random_degradation import Everything
from dsr.methods.networks.facets_unet import FacetsUNet
from dsr.methods.networks.msg_net import MSGNet
from dsr.training.data_module import Part, PatchData
from dsr.training.degradation import Degradation
from dsr.training.module import SuperResolution, WarmupCosine
from dsr.training.objective import DepthObjective, SurfaceObjective
from dsr.training.settings import PatchSettings

PAGE = Path(__file__).resolve().parents[2] / "docs" / "python.md"

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers.*"),
    pytest.mark.filterwarnings("ignore:.*smaller than the logging interval.*"),
    pytest.mark.filterwarnings("ignore:.*LeafSpec.*"),
    pytest.mark.filterwarnings("ignore:.*sync_dist=True.*"),
    pytest.mark.filterwarnings("ignore:.*that ended before the epoch ended.*"),
    pytest.mark.filterwarnings("ignore:Precision bf16-mixed is not supported by the model summary.*"),
]


def _data(**named: Any) -> PatchData:
    settings = PatchSettings(patch=32, batch=2, validation_scenes=1)
    return PatchData([Part(Procedural(count=3, size=64))], settings, Degradation(4, Downsampling("box")), **named)


def _trainer(folder: Path, **named: Any) -> lightning.Trainer:
    quiet: dict[str, Any] = {"enable_progress_bar": False, "enable_model_summary": False, "logger": False}
    quiet["enable_checkpointing"] = False
    return lightning.Trainer(accelerator="cpu", default_root_dir=folder, **{**quiet, **named})


def test_lines_of_the_documentation_train_a_network_and_score_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    [lines] = re.findall(r"^```python\n(import lightning\n.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    small = lines.replace("count=6", "count=3, size=64").replace("patch=64", "patch=32").replace("=20", "=4")
    exec(compile(small, PAGE, "exec"), {})
    *_, printed = capsys.readouterr().out.strip().splitlines()
    score, shape = printed.split(maxsplit=1)
    assert 0 < float(score) < 2000
    assert shape == "torch.Size([1, 1, 64, 64])"


def test_lines_of_the_documentation_compute_metrics() -> None:
    [lines] = re.findall(r"^```python\n(from dsr.metrics.classes.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    sample = sample_of(*step())
    names: dict[str, Any] = {"depth": 1.02 * sample.depth, "sample": sample}
    exec(compile(lines, PAGE, "exec"), names)
    means = names["metrics"].compute()
    assert (float(means["BadPix_d_1pct"]), float(means["BadPix_d_5pct"])) == (1, 0)


def _same(first: SuperResolution, second: SuperResolution) -> bool:
    one, other = first.state_dict(), second.state_dict()
    return one.keys() == other.keys() and all(map(torch.equal, one.values(), other.values()))


@pytest.mark.parametrize("hints", [False, True])
def test_checkpoint_loads_without_arguments_and_predicts_the_same(tmp_path: Path, hints: bool) -> None:
    torch.manual_seed(0)
    net = FacetsUNet(4, 8, 8, 4) if hints else MSGNet(4)
    objective = SurfaceObjective(soft=3.0) if hints else DepthObjective("l1", 0.5)
    schedule = functools.partial(WarmupCosine, steps=2, warmup=1)
    module = SuperResolution(net, objective, torch.optim.SGD, schedule, average=0.5, validation_sets=["procedural"])
    data = _data(everything=Everything() if hints else None)
    trainer = _trainer(tmp_path, max_steps=2, precision="bf16-mixed", limit_val_batches=0)
    trainer.fit(module, data)
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    loaded = SuperResolution.load_from_checkpoint(tmp_path / "a.ckpt")
    assert _same(loaded, module)
    assert (type(loaded.net), loaded.net.arguments()) == (type(net), net.arguments())
    assert (loaded.objective, loaded.decay, loaded.sets) == (objective, 0.5, ("procedural",))
    assert isinstance(loaded.configure_optimizers()["optimizer"], torch.optim.SGD)
    assert isinstance(loaded.configure_optimizers()["lr_scheduler"]["scheduler"], WarmupCosine)
    trainer = _trainer(tmp_path)
    predictions: Any = [trainer.predict(each, data) for each in (module, loaded)]
    assert torch.equal(predictions[0][0], predictions[1][0])
    [scores] = trainer.test(loaded, data, verbose=False)
    [validated] = trainer.validate(module, data, verbose=False)
    assert scores["test/RMSE_v"] == validated["val/RMSE_v"] > 0
    trainer = _trainer(tmp_path, max_steps=3, limit_val_batches=0)
    trainer.fit(loaded, data, ckpt_path=tmp_path / "a.ckpt", weights_only=True)
    assert trainer.global_step == 3


class Own(MSGNet):
    """A network that is not dsr's."""

    def answer_scene(self, batch: Any) -> Tensor:
        return super().answer_scene(batch)


def test_checkpoint_names_no_class_beyond_its_kind_that_is_made(tmp_path: Path) -> None:
    trainer = _trainer(tmp_path, max_steps=1, limit_val_batches=0)
    trainer.fit(SuperResolution(Own(4), DepthObjective(), lambda weights: torch.optim.SGD(weights, 0.1)), _data())
    trainer.save_checkpoint(tmp_path / "a.ckpt")
    path, load = tmp_path / "a.ckpt", SuperResolution.load_from_checkpoint
    with pytest.raises(ValueError, match=r"^net: the checkpoint names .*test_notebook\.Own, neither "):
        load(path)
    assert isinstance(load(path, net=Own(4)).net, Own)
    content = torch.load(path, weights_only=True)
    for target, message in (
        ("dsr.utils.files.write_text", r"^net: expected a DisparityNetwork in the checkpoint, dsr.* is none$"),
        ("dsr.no_such.Net", r"^net: cannot import 'dsr\.no_such\.Net'"),
        ("os.system", r"^net: the checkpoint names os\.system, neither"),
    ):
        content["hyper_parameters"]["net"] = {"_target_": target, "path": str(tmp_path / "file"), "text": ""}
        torch.save(content, path)
        with pytest.raises(ValueError, match=message):
            load(path)
    assert not (tmp_path / "file").exists()
    del content["hyper_parameters"]
    torch.save(content, path)
    with pytest.raises(ValueError, match=r"a\.ckpt: expected a checkpoint of SuperResolution"):
        load(path)


def test_nodes_of_the_configuration_train_as_the_documentation_shows(tmp_path, monkeypatch, dsr_cache):
    monkeypatch.chdir(tmp_path)
    [block] = re.findall(r"```python\n(from hydra[^`]*)```", PAGE.read_text(encoding="utf-8"))
    quick = ["metrics.lpips=false", "dataset.size=64", "patches.patch=32", "patches.validation_scenes=1"]
    block = block.replace('"trainer.max_steps=20"]', f'"trainer.max_steps=2", {str(quick)[1:]}')
    made = {"PatchData": PatchData, "Part": Part, "Degradation": Degradation, "Downsampling": Downsampling}
    exec(block, made)
    assert made["method"].abilities.ratios == "any"
    assert any(tmp_path.iterdir())  # its log

"""What a Hydra user expects: every node of the configuration is one for ``hydra.utils.instantiate``."""

import pytest
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.utils import instantiate
from lightning.pytorch.callbacks import EarlyStopping, LearningRateMonitor
from methods_at_hand import AT_HAND

import dsr
from dsr.app.schema import TrainConfig, plain_config
from dsr.degradation.downsampling import Downsampling, Measured
from dsr.methods.networks.network import DisparityNetwork
from dsr.methods.recipe import read_recipe
from dsr.training.module import SuperResolution
from dsr.training.objective import Objective
from dsr.utils.configuration import build, config_directories, list_choices


def choices(group: str) -> list[str]:
    return list_choices(group, config_directories())


@pytest.mark.parametrize(
    ("group", "name"), [(g, name) for g in ("downsampling", "noise", "holes") for name in choices(g)]
)
def test_group_is_instantiated_as_the_command_builds_it(group: str, name: str) -> None:
    config = dsr.compose("eval", [f"{group}={name}"])
    made, built = instantiate(config[group]), build(group, plain_config(config)[group])
    assert type(made) is type(built)
    assert made == built or vars(made) == vars(built)
    assert group != "downsampling" or isinstance(made, Downsampling | Measured)


@pytest.mark.parametrize("name", [name for name in AT_HAND if read_recipe(name).abilities.needs is None])
def test_method_without_weights_is_instantiated(name: str) -> None:
    assert type(instantiate(dsr.compose("eval", [f"method={name}"]).method)) is read_recipe(name).kind


@pytest.mark.parametrize("name", choices("model"))
def test_model_is_the_lightning_module_with_its_optimiser_and_schedule(name: str) -> None:
    config = dsr.compose("train", [f"model={name}", "scale=8", "model.optimizer.lr=0.02", "trainer.max_steps=10"])
    module = instantiate(config.model)
    assert isinstance(module, SuperResolution)
    assert isinstance(module.net, DisparityNetwork)
    assert isinstance(module.objective, Objective)
    assert module.net.serves(module.net.scale, 8)
    made = module.configure_optimizers()
    assert type(made["optimizer"]) is torch.optim.AdamW
    assert made["optimizer"].defaults["lr"] == 0.02
    schedule = made["lr_scheduler"]["scheduler"]
    assert [schedule.lr_lambdas[0](step) for step in (0, 10)] == [pytest.approx(1 / 300), pytest.approx(11 / 300)]


def test_other_trainers_optimisers_schedules_and_callbacks_are_nodes() -> None:
    more = ["optimizer=sgd", "scheduler=constant", "callbacks=[default,early_stopping,learning_rate]"]
    config = dsr.compose("train", ["trainer=full", *more])
    assert instantiate(config.trainer, logger=False).max_steps == config.trainer.max_steps
    made = instantiate(config.model).configure_optimizers()
    assert type(made["optimizer"]) is torch.optim.SGD
    assert type(made["lr_scheduler"]["scheduler"]) is torch.optim.lr_scheduler.ConstantLR
    kinds = {type(instantiate(node)) for node in config.callbacks.values()}
    assert kinds >= {EarlyStopping, LearningRateMonitor}


def test_composed_configuration_names_its_choices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)  # as in a process without a command
    config = dsr.compose("train", ["model=facets", "dataset=folder", "dataset.root=here"])
    assert (config.names.model, config.names.dataset, config.names.optimizer) == ("facets", "folder", "adamw")
    assert TrainConfig.of(plain_config(config)).names == config.names

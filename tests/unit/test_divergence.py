"""Trainings whose numbers are no longer finite stop, say what happened, and keep the last good checkpoint."""

import math

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.utils.data import DataLoader

from dsr.utils.checkpoints import Divergence, DivergenceError
from dsr.utils.lightning import fit, make_trainer

NAN = math.nan


class Scripted(lightning.LightningModule):
    """A network of one weight whose losses, gradients, scores and weights are as written down."""

    def __init__(self, losses, norms=None, scores=None, weights=None):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))
        self.losses, self.norms, self.scores, self.weights = losses, norms or {}, scores or {}, weights or {}
        self.validation_scores = {}

    def training_step(self, _, index):
        step = index + 1
        loss = self.weight.sum() * 0 + self.losses.get(step, 0.5)
        self.log_dict({"train/loss": loss.detach(), "train/gradient_norm": self.norms.get(step, 1.0)}, batch_size=1)
        return loss

    def on_train_batch_end(self, *_):
        self.weight.data.fill_(self.weights.get(self.global_step, 1.0))

    def validation_step(self, *_):
        self.log("val/RMSE_d", self.scores.get(self.global_step, 0.1), batch_size=1)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), lr=0.25)


def train(folder, module, steps=8, interval=2, callbacks=(), patience=3, accumulate=1):
    """Train with a checkpoint after each validation; return the trainer."""
    last = ModelCheckpoint(folder, "last", enable_version_counter=False, save_on_train_epoch_end=False)
    trainer = make_trainer(
        torch.device("cpu"), steps, interval, callbacks=[Divergence(patience), last, *callbacks], logger=False,
        accumulate=accumulate,
    )  # fmt: skip
    loader = DataLoader(range(steps * accumulate), batch_size=None)
    fit(trainer, module, loader, val_dataloaders=DataLoader(range(1), batch_size=None))
    return trainer


def last_step(folder):
    return torch.load(folder / "last.ckpt", weights_only=True)["global_step"]


ROW = "the loss or its gradient is not finite from there on"
DIVERGED = {
    "losses": ({"losses": {4: NAN, 5: math.inf, 6: NAN}}, f"4: {ROW}", 4),
    "gradients": ({"losses": {}, "norms": dict.fromkeys((4, 5, 6), math.inf)}, f"4: {ROW}", 4),
    "score": ({"losses": {}, "scores": {4: NAN}}, "4: the validation's RMSE_d is nan", 2),
    "weights": ({"losses": {}, "weights": {6: math.inf}}, "6: the weights weight are not finite", 4),
}


@pytest.mark.parametrize("case", DIVERGED)
def test_diverged_training_stops_at_its_step_and_keeps_the_last_good_checkpoint(tmp_path, case):
    script, what, kept = DIVERGED[case]
    with pytest.raises(DivergenceError) as caught:
        train(tmp_path, Scripted(**script))
    assert str(caught.value) == f"diverged at step {what}, at a learning rate of 0.25"
    assert last_step(tmp_path) == kept


def test_few_steps_without_a_finite_loss_are_tolerated(tmp_path):
    trainer = train(tmp_path, Scripted({2: NAN, 3: NAN, 5: NAN, 6: NAN}))
    assert trainer.global_step == last_step(tmp_path) == 8


def test_steps_count_rather_than_the_batches_of_a_step(tmp_path):
    trainer = train(tmp_path, Scripted(dict.fromkeys(range(3, 8), NAN)), steps=6, accumulate=2)
    assert trainer.global_step == 6

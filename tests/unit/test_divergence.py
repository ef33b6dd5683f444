"""Trainings whose numbers are no longer finite stop, say what happened, and keep the last good checkpoint."""

import json
import math

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.utils.data import DataLoader

from dsr.app.divergence import NOTE, expect_no_divergence, note_divergence
from dsr.utils.checkpoints import Divergence, DivergenceError, Interruption
from dsr.utils.configuration import ConfigError
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


ROW = "after 3 steps in a row without finite numbers"
DIVERGED = {
    "losses": (
        {"losses": {4: NAN, 5: math.inf, 6: NAN}},
        f"6: the loss is nan {ROW}",
        4,
    ),
    "gradients": (
        {"losses": {}, "norms": dict.fromkeys((3, 4, 5), math.inf)},
        f"5: the norm of the gradient is inf {ROW}",
        4,
    ),
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


def test_no_checkpoint_is_kept_of_a_step_in_doubt(tmp_path):
    path = tmp_path / "kept.ckpt"
    with pytest.raises(DivergenceError):
        train(tmp_path, Scripted({3: NAN, 4: NAN, 5: NAN}), interval=8, callbacks=[Interruption(path, 0.0)])
    assert torch.load(path, weights_only=True)["global_step"] == 2


def test_note_of_a_divergence_refuses_the_same_settings_and_no_others(tmp_path):
    torch.save({"global_step": 20}, tmp_path / "last.ckpt")
    error = DivergenceError("diverged at step 30: the loss is nan, at a learning rate of 2")
    reported = str(note_divergence(tmp_path, tmp_path / "last.ckpt", {"scale": 4, "trainer": {"steps": 40}}, error))
    assert reported.startswith(
        f"{tmp_path}: the training diverged at step 30: the loss is nan, at a learning rate of 2; "
    )
    assert f"{tmp_path / 'last.ckpt'} of step 20 is kept; a lower model.optimizer.lr" in reported
    with pytest.raises(ConfigError, match=r"diverged at step 30: .*, and would again"):
        expect_no_divergence(tmp_path, {"scale": 4, "trainer": {"steps": 40}})
    expect_no_divergence(tmp_path, {"scale": 8, "trainer": {"steps": 40}})


def test_divergence_without_a_checkpoint_says_so(tmp_path):
    reported = str(note_divergence(tmp_path, tmp_path / "last.ckpt", {}, DivergenceError("diverged")))
    assert "it has no earlier checkpoint" in reported


@pytest.mark.parametrize("content", ["", "[]", "{", json.dumps({"what": 1})])
def test_damaged_note_of_a_divergence_is_no_note(tmp_path, content):
    (tmp_path / NOTE).write_text(content)
    expect_no_divergence(tmp_path, {})

"""A training that goes on from a stranger's checkpoint touches no file outside its own directory of checkpoints."""

import gc
import shutil
from pathlib import Path

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from dsr.utils.checkpoints import OwnFiles
from dsr.utils.lightning import fit, make_trainer


class Improving(lightning.LightningModule):
    """A training of one number whose validations have given scores."""

    def __init__(self, scores):
        super().__init__()
        self.weight, self.scores = torch.nn.Parameter(torch.zeros(1)), iter(scores)

    def training_step(self, batch, _):
        return (self.weight - batch).square().sum()

    def validation_step(self, batch, _):
        self.log("score", next(self.scores))

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


def loader(count):
    return torch.utils.data.DataLoader(torch.ones(count), batch_size=1)


def train(folder, steps, scores, resume=None, filename="best-{step}"):
    """Train with a validation after each step; return the lines that were said."""
    said = []
    best = ModelCheckpoint(folder, filename, monitor="score", mode="min", save_on_train_epoch_end=False)
    trainer = make_trainer(
        torch.device("cpu"), steps, 1, callbacks=[OwnFiles(folder, said.append), best], logger=False,
        default_root_dir=folder.parent,
    )  # fmt: skip
    fit(trainer, Improving(scores), loader(steps), resume, val_dataloaders=loader(1))
    trainer.save_checkpoint(folder / "last.ckpt")
    return said, best


def craft(folder, change):
    """Change the state of the callback that keeps checkpoints."""
    checkpoint = torch.load(folder / "last.ckpt", weights_only=True)
    [state] = [each for each in checkpoint["callbacks"].values() if "best_k_models" in each]
    change(state)
    checkpoint["hyper_parameters"] = {"best_model_path": state["best_model_path"]}
    torch.save(checkpoint, folder / "last.ckpt")


@pytest.fixture
def run(tmp_path):
    """The directory of checkpoints of a training of one step, beside a directory with something precious."""
    folder = tmp_path / "run" / "checkpoints"
    train(folder, 1, [0.5])
    (tmp_path / "victim" / "inner").mkdir(parents=True)
    (tmp_path / "victim" / "inner" / "thesis.txt").write_text("precious")
    return folder


PATHS = {
    "an absolute path": lambda folder: folder.parents[1] / "victim",
    "a path that leads out": lambda folder: f"{folder}/../../victim",
    "a relative path": lambda folder: "victim",
    "a link within": lambda folder: folder / "link",
    "a path through a link": lambda folder: folder / "link" / "inner",
    "the directory itself": lambda folder: folder,
    "its parent": lambda folder: f"{folder}/..",
}


@pytest.mark.parametrize("case", PATHS)
@pytest.mark.parametrize("dirpath", ["none", "its own", "that of the path"])
def test_better_validation_removes_nothing_that_a_checkpoint_names_elsewhere(run, monkeypatch, case, dirpath):
    monkeypatch.chdir(run.parents[1])
    (run / "link").symlink_to(run.parents[1] / "victim")
    path = str(PATHS[case](run))

    def change(state):
        score = state["best_model_score"]
        state |= {"best_k_models": {path: score}, "kth_best_model_path": path, "best_model_path": path}
        if dirpath == "none":
            del state["dirpath"]
        elif dirpath == "that of the path":
            state["dirpath"] = str(Path(path).parent)

    craft(run, change)
    said, best = train(run, 2, [0.1], run / "last.ckpt")
    assert (run.parents[1] / "victim" / "inner" / "thesis.txt").read_text() == "precious"
    assert (run / "link").is_symlink()
    assert Path(best.best_model_path).resolve().parent == run
    assert float(best.best_model_score) == pytest.approx(0.1)
    assert len(said) <= 1
    assert said or dirpath == "that of the path"  # whose last part may name a file of the run


def test_run_that_was_moved_keeps_its_best_and_removes_it_for_a_better_one(run, tmp_path):
    shutil.move(tmp_path / "run", tmp_path / "moved")
    folder = tmp_path / "moved" / "checkpoints"
    assert [path.name for path in folder.glob("best*")] == ["best-step=1.ckpt"]
    said, best = train(folder, 2, [0.9], folder / "last.ckpt")
    assert (said, best.best_model_path) == ([], str(folder / "best-step=1.ckpt"))
    said, best = train(folder, 3, [0.1], folder / "last.ckpt")
    assert (said, best.best_model_path) == ([], str(folder / "best-step=3.ckpt"))
    assert [path.name for path in folder.glob("best*")] == ["best-step=3.ckpt"]
    assert not (tmp_path / "run").exists()


def test_what_a_checkpoint_was_tried_with_takes_no_memory_in_the_training(run, monkeypatch):
    found = []

    def count(module):
        gc.collect()
        made = [each for each in gc.get_objects() if type(each) is torch.optim.SGD]
        found.append(sum(each.param_groups[0]["params"][0] is module.weight for each in made))

    monkeypatch.setattr(Improving, "on_train_start", count, raising=False)
    train(run, 2, [0.5, 0.4], run / "last.ckpt")
    assert found == [1]

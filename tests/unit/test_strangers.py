"""Files of strangers that the fuzzer found a way through with: each ends in one line that names the file."""

import io
import zipfile

import lightning
import pytest
import torch
from torch.utils.data import DataLoader

from dsr.app.entry import run_command
from dsr.data.download.fetching import unpack
from dsr.methods.recipe import read_recipe
from dsr.utils.console import one_line, print_error, printable
from dsr.utils.lightning import fit, make_trainer


def test_printable_replaces_what_controls_a_terminal_or_turns_text():
    assert printable("a\x1b[2Jb\x00\x85\u202e").replace("\N{REPLACEMENT CHARACTER}", "#") == "a#[2Jb###"
    assert printable("Küche 日本 \u200d\n") == "Küche 日本 \u200d\n"


def test_error_with_a_name_that_turns_text_is_one_line(capsys):
    print_error("gpj\u202e.bag: expected\na recording")
    assert capsys.readouterr().err == "error: gpj\N{REPLACEMENT CHARACTER}.bag: expected a recording\n"
    assert one_line(ValueError("a\x1b.png: expected")) == "a\N{REPLACEMENT CHARACTER}.png: expected"


@pytest.mark.parametrize(("content", "reason"), [(b"a: \x83", "UnicodeDecodeError"), (b"[" * 3000, "RecursionError")])
def test_damaged_configuration_file_is_named(tmp_path, monkeypatch, capsys, content, reason):
    path = tmp_path / "conf" / "method" / "mine.yaml"
    path.parent.mkdir(parents=True)
    path.write_bytes(content)
    expected = f"{path}: expected a readable YAML file, got {reason}"
    with pytest.raises(ValueError, match="expected a readable YAML file") as refused:
        read_recipe("mine", directories=[tmp_path / "conf"])
    assert str(refused.value) == expected
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        run_command("eval", print, ["--config-dir", str(tmp_path / "conf"), "method=mine"])
    assert (ended.value.code, capsys.readouterr().err) == (2, f"error: {expected}\n")


def test_archive_whose_names_are_no_text_is_refused(tmp_path):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("ü.txt", "text")
    (tmp_path / "set.zip").write_bytes(content.getvalue().replace("ü".encode(), b"\xcf\x20"))
    with pytest.raises(ValueError, match=r"set\.zip: expected an archive, got a damaged one"):
        unpack(tmp_path / "set.zip", tmp_path / "out", lambda *_: None)


class OneWeight(lightning.LightningModule):
    """A training of one number."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def training_step(self, batch, _):
        return (self.weight - batch).square().sum()

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


@pytest.mark.parametrize("content", [{"state_dict": {}}, [1], {"epoch": 1, "global_step": 2}])
def test_checkpoint_of_something_else_is_refused(tmp_path, content):
    torch.save(content, tmp_path / "last.ckpt")
    trainer = make_trainer(torch.device("cpu"), 1, 1, callbacks=[], logger=False, default_root_dir=tmp_path)
    with pytest.raises(ValueError, match=r"last\.ckpt: expected a checkpoint of this training") as refused:
        fit(trainer, OneWeight(), [torch.ones(1)], tmp_path / "last.ckpt")
    assert "\n" not in str(refused.value)


class Defective(lightning.Callback):
    def on_train_start(self, *_):
        raise RuntimeError("defective")


def test_defect_of_a_callback_is_not_taken_for_a_damaged_checkpoint(tmp_path):
    given = {"logger": False, "default_root_dir": tmp_path}
    trainer = make_trainer(torch.device("cpu"), 1, 1, callbacks=[], **given)
    numbers = DataLoader(torch.ones(2, 1), batch_size=None)
    fit(trainer, OneWeight(), numbers)
    trainer.save_checkpoint(tmp_path / "last.ckpt")
    trainer = make_trainer(torch.device("cpu"), 2, 1, callbacks=[Defective()], **given)
    with pytest.raises(RuntimeError, match="defective"):
        fit(trainer, OneWeight(), numbers, tmp_path / "last.ckpt")

"""Files of strangers that the fuzzer found a way through with: each ends in one line that names the file."""

import io
import warnings
import zipfile

import lightning
import numpy as np
import pytest
import torch
from PIL import Image
from small_results import write_result

from dsr.app.entry import run_command
from dsr.app.run_directory import expect_free
from dsr.app.upsample.stored import read_result
from dsr.cli import main
from dsr.data.download.fetching import unpack
from dsr.geometry.rigid_motion import as_rigid, from_quaternion, is_rotation
from dsr.io.photos import focal_in_exif
from dsr.methods.recipe import read_recipe
from dsr.report.study.study_table import read_study
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


def test_configuration_file_that_is_a_link_to_nothing_is_refused(tmp_path):
    (tmp_path / "method").mkdir()
    (tmp_path / "method" / "mine.yaml").symlink_to("nowhere")
    with pytest.raises(ValueError, match=r"method: expected a readable file mine\.yaml"):
        read_recipe("mine", directories=[tmp_path])


def test_archive_whose_names_are_no_text_is_refused(tmp_path):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("ü.txt", "text")
    (tmp_path / "set.zip").write_bytes(content.getvalue().replace("ü".encode(), b"\xcf\x20"))
    with pytest.raises(ValueError, match=r"set\.zip: expected an archive, got a damaged one"):
        unpack(tmp_path / "set.zip", tmp_path / "out", lambda *_: None)


def test_table_of_a_study_with_many_columns_is_read_without_them(tmp_path):
    names = ["dataset", "scene", "downsampling", "label", "scale", "user_first", "user_second", "user_top2"]
    path = tmp_path / "study.csv"
    path.write_text(",".join(names + ["user_first", "more"] * 500) + "\n" + "a,b,c,d,4,1,2,3" + ",5,x" * 500 + "\n")
    assert list(read_study(path).columns) == names


def test_result_with_a_depth_beyond_the_moon_is_refused(tmp_path):
    depth = np.full((64, 64), 2, np.float32)
    depth[3, 4] = 1e30
    folder = write_result(tmp_path / "out", depth, pose=np.eye(4).tolist())
    with pytest.raises(ValueError, match=r"depth_metres\.tiff: expected depths of 1e-06 to 1e\+09 m"):
        read_result(folder, "out")


def test_fusion_without_a_surface_names_the_result(tmp_path, capsys):
    folder = write_result(tmp_path / "out", with_errors=False, pose=np.eye(4).tolist())
    assert main(["fuse", str(folder), "-o", str(tmp_path / "mesh.ply"), "--voxel", "1e-6"]) == 2
    assert capsys.readouterr().err.startswith(f"error: {folder}: voxel: expected one of at least about")


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


class History(OneWeight):
    """A training of two numbers by an optimiser whose state has lists, of its last steps."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.tensor([0.5, -1.0]))

    def training_step(self, batch, _):
        return (self.weight.cosh() * torch.tensor([1.0, 3.0]) - batch * self.weight).sum()

    def configure_optimizers(self):
        return torch.optim.LBFGS(self.parameters(), 0.1, max_iter=2, history_size=3)


def train_history(folder, steps, resume=None):
    module, quiet = History(), {"logger": False, "enable_checkpointing": False, "default_root_dir": folder}
    trainer = make_trainer(torch.device("cpu"), steps, 8, callbacks=[], **quiet)
    fit(trainer, module, torch.utils.data.DataLoader(torch.ones(8)), resume)
    return trainer, module.weight.detach()


@pytest.mark.parametrize("steps", [1, 2, 4])
def test_history_of_an_optimiser_goes_on_as_saved(tmp_path, steps):
    train_history(tmp_path, steps)[0].save_checkpoint(tmp_path / "last.ckpt", weights_only=False)
    assert torch.equal(train_history(tmp_path, 6, tmp_path / "last.ckpt")[1], train_history(tmp_path, 6)[1])


@pytest.mark.parametrize("rows", [[[1e308, 1e308, 0], [1e308, -1e308, 0], [0, 0, 1]], [[1e200, 0, 0]] * 3])
def test_rotation_whose_squares_are_beyond_floats_is_refused_without_a_warning(rows):
    assert not is_rotation(np.array(rows), 0.1)
    with pytest.raises(ValueError, match="a: expected a rigid transform, got rows of length"):
        as_rigid(np.column_stack((rows, (0, 0, 0))), "a")
    with pytest.raises(ValueError, match="a: expected a quaternion of length 1, got inf"):
        from_quaternion((0, 0, 0), (1e308, 1e308, 1e308, 1e308), "a")


def test_record_of_a_run_that_is_nested_too_deeply_is_refused(tmp_path):
    (tmp_path / "versions.json").write_text('{"identity": ' + "[" * 100_000 + "]" * 100_000 + "}")
    with pytest.raises(ValueError, match="holds files of something else"):
        expect_free(tmp_path, {"overwrite": False}, {})


def test_damaged_exif_data_of_a_photo_are_ignored_without_a_warning(tmp_path):
    path = tmp_path / "photo.jpg"
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    Image.new("RGB", (8, 8)).save(path, exif=exif)
    assert focal_in_exif(path) == 28
    content = path.read_bytes()
    path.write_bytes(content[:35] + b"\xff" + content[36:])  # of the place of the first directory
    with warnings.catch_warnings(record=True) as reported:
        warnings.simplefilter("always")
        assert focal_in_exif(path) is None
    assert reported == []

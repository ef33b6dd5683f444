"""The directory of a run never collides, is never silently overwritten, and says what the run was."""

import importlib.metadata
import json
import re

import pytest
import torch
from omegaconf import OmegaConf

from dsr.app import run_directory as rundir
from dsr.app.run_directory import at_work, directory_of, expect_free, identity_of
from dsr.app.schema import compose, plain_config
from dsr.utils.configuration import ConfigError, config_directories

CPU = torch.device("cpu")


def config(**changes):
    return {
        "names": {"dataset": "folder", "downsampling": "box", "method": "msg_v"},
        "dataset": {"root": "data", "scenes": None}, "downsampling": {"kernel": "box"}, "method": {}, "scale": 4,
        "metrics": {"lpips": True}, "weights": "w.pth", "precision": "float32", "seed": 0, "output_dir": None,
        "overwrite": False, **changes,
    }  # fmt: skip


def claim(folder, plain, weights="abc"):
    with at_work(folder, plain, identity_of(plain, weights, CPU)):
        pass


@pytest.fixture(autouse=True)
def _own_folder(tmp_path_factory, monkeypatch):
    monkeypatch.chdir(tmp_path_factory.mktemp("work"))


def composed(kind, *overrides):
    return plain_config(compose(kind, overrides, config_directories()))


def name_of(kind, *overrides):
    plain = composed(kind, *overrides)
    return directory_of(kind, plain, identity_of(plain, None, CPU), overrides).name


@pytest.mark.parametrize(
    ("kind", "overrides", "name"),
    [
        ("train", "model=msg_v scale=8", "msg_v_x8_seed0"),
        ("train", "model=msg_v scale=8 loss.w=0.72", "msg_v_x8_w0.72_seed0"),
        ("train", "model=msg loss.w=auto seed=3", "msg_x4_w-auto_seed3"),
        ("train", "trainer=smoke trainer.max_steps=4 model.objective.w=0",
         "msg_v_x4_smoke_w0_max_steps4_seed0"),
        ("train", "noise=tof patches.scenes=5", "msg_v_x4_tof_scenes5_seed0"),
        ("eval", "method=bicubic", "bicubic_x4_simgeo_seed0"),
        ("eval", "method=bicubic +experiment=paper_tables", "bicubic_x4_simgeo_seed0"),
        ("eval", "method=bicubic +experiment=noise", "bicubic_x4_simgeo_experiment-noise_seed0"),
        ("eval", "method=dip_v scale=8 dataset=icl method.w=2 method.oracle=true",
         "dip_v_x8_icl_oracle-true_w2_seed0"),
        ("eval", "downsampling=nearest noise=gaussian_multiplicative noise.std=0.01 dataset.scenes=[lucy,plant]",
         "msg_v_x4_simgeo_nearest_gaussian_multiplicative_scenes-lucy+plant_std0.01_seed0"),
    ],
)  # fmt: skip
def test_name_says_what_differs_from_the_defaults(kind, overrides, name):
    assert name_of(kind, *overrides.split()) == name


def test_what_a_name_cannot_say_is_distinguished_by_a_hash():
    names = {name_of("eval", "dataset=folder", f"dataset.root={root}") for root in ("/a/my/scenes", "/b/my/scenes")}
    assert len(names) == 2
    assert all(re.fullmatch(r"msg_v_x4_folder_root-my-scenes_seed0-[0-9a-f]{8}", name) for name in names)
    longer = name_of("eval", f"dataset.scenes=[{','.join(f'scene_{number}' for number in range(99))}]")
    assert len(longer) < 130
    assert re.search(r"-[0-9a-f]{8}$", longer)


def test_run_takes_the_directory_of_no_other_run_and_finds_its_own():
    plain, folders = composed("eval"), []
    for weights in ("abc", "abd"):
        folders.append(directory_of("eval", plain, identity_of(plain, weights, CPU)))
        claim(folders[-1], plain, weights)
    assert folders[0].name == "msg_v_x4_simgeo_seed0"
    assert re.fullmatch(r"msg_v_x4_simgeo_seed0-[0-9a-f]{8}", folders[1].name)
    record = json.loads((folders[1] / "versions.json").read_text())
    assert record["hash"].startswith(folders[1].name.rpartition("-")[2])
    again = [directory_of("eval", plain, identity_of(plain, weights, CPU)) for weights in ("abc", "abd")]
    assert again == folders
    (folders[0] / "versions.json").unlink()
    (folders[0] / "thesis.txt").touch()
    assert directory_of("eval", plain, identity_of(plain, "abc", CPU)).name.startswith(f"{folders[0].name}-")


def test_identity_has_the_settings_that_predictions_depend_on_the_weights_the_device_and_the_versions(monkeypatch):
    own = identity_of(config(), "abc", CPU)
    for same in ({"weights": "elsewhere.pth"}, {"output_dir": "x"}, {"overwrite": True}, {"metrics": {"lpips": False}}):
        assert identity_of(config(**same), "abc", CPU) == own
    other = (
        {"scale": 8}, {"seed": 1}, {"precision": "bfloat16"}, {"dataset": {"root": "other"}},
        {"downsampling": {"kernel": "gaussian"}}, {"method": {"variant": "x"}},
    )  # fmt: skip
    found = [own, *(identity_of(config(**changes), "abc", CPU) for changes in other)]
    found += [identity_of(config(), *each) for each in (("abd", CPU), (None, CPU), ("abc", torch.device("cuda")))]
    assert identity_of(config(), "abc", torch.device("cuda", 1)) == found[-1]
    for name in ("RESULTS", "SCENES"):
        monkeypatch.setattr(rundir, name, 0)
        found.append(identity_of(config(), "abc", CPU))
    assert all(found.count(each) == 1 for each in found)


def test_claimed_directory_has_the_config_and_the_versions(tmp_path):
    (tmp_path / "new" / "run").mkdir(parents=True)
    (tmp_path / "new" / "run" / ".versions-8f3k.json").touch()  # of another run that begins in it
    claim(tmp_path / "new" / "run", config())
    (tmp_path / "new" / "run" / ".versions-8f3k.json").unlink()
    assert sorted(path.name for path in (tmp_path / "new" / "run").iterdir()) == ["config.yaml", "versions.json"]
    assert OmegaConf.to_container(OmegaConf.load(tmp_path / "new" / "run" / "config.yaml")) == config()
    record = json.loads((tmp_path / "new" / "run" / "versions.json").read_text())
    assert record["packages"]["torch"] == importlib.metadata.version("torch")
    assert {"dsr", "numpy", "hydra-core"} <= record["packages"].keys()
    assert record["accelerator"] == (torch.cuda.get_device_name() if torch.cuda.is_available() else None)
    assert record["git_commit"] is None or len(record["git_commit"]) == 40
    assert isinstance(record["git_dirty"], bool)
    assert record["identity"]["weights_sha256"] == "abc"
    assert record["identity"]["device"] == "cpu"


def test_directory_of_another_run_is_refused_with_the_changed_keys_before_the_claim_and_then(tmp_path):
    plain, other = config(), config(scale=8, dataset={"root": "other", "scenes": None})
    assert expect_free(tmp_path / "new", plain, identity_of(plain, "abc", CPU)) == []
    assert list(tmp_path.iterdir()) == []
    claim(tmp_path / "run", plain)
    before = (tmp_path / "run" / "config.yaml").read_bytes()
    keys = ["dataset.root", "scale", "weights_sha256"]
    identity = identity_of(other, "abd", CPU)
    message = f"run holds a run with another {', '.join(keys)}; .* overwrite=true"
    with pytest.raises(ConfigError, match=message):
        expect_free(tmp_path / "run", plain, identity)
    with pytest.raises(ConfigError, match=message):
        claim(tmp_path / "run", other, "abd")
    assert (tmp_path / "run" / "config.yaml").read_bytes() == before
    assert expect_free(tmp_path / "run", plain, identity, keys) == keys
    claim(tmp_path / "run", {**other, "overwrite": True})
    assert OmegaConf.load(tmp_path / "run" / "config.yaml").scale == 8
    assert json.loads((tmp_path / "run" / "versions.json").read_text())["identity"]["scale"] == 8


@pytest.mark.parametrize("content", [None, "", "[]", "{}", '{"identity": 3}', '{"identity": null}'])
def test_directory_with_foreign_files_is_refused_and_unchanged(tmp_path, content):
    (tmp_path / "thesis.txt").write_text("precious")
    if content is not None:
        (tmp_path / "versions.json").write_text(content)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ConfigError, match=r"^output_dir: .* holds files of something else"):
        claim(tmp_path, config())
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_file_in_place_of_the_directory_or_of_one_above_it_is_refused(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(ConfigError, match=r"^output_dir: .*file: expected a folder .*, got a file"):
        expect_free(tmp_path / "file", config(), {})
    with pytest.raises(ConfigError, match=r"^output_dir: expected a directory to write to, got .*run \(Not a dir"):
        claim(tmp_path / "file" / "run", config())

"""What finds glass: features that do not depend on units, and probabilities on simulated objects."""

import importlib.util
from pathlib import Path

import pytest
import safetensors.torch
import torch

from dsr.data.rendered import Procedural
from dsr.degradation.glass import add_glass
from dsr.degradation.noise import NOISES
from dsr.geometry.camera import Camera
from dsr.inference import upsample_surface
from dsr.methods.glass import FEATURES, GlassFinder, expect_glass, glass_features, probability_of_glass
from dsr.metrics.calibration import off_auc

SCRIPT = Path(__file__).parents[2] / "scripts" / "train_glass.py"


def _random(height, width, seed=0):
    generator = torch.Generator().manual_seed(seed)
    rgb = torch.rand(3, height, width, generator=generator)
    inverse = 0.5 + 0.01 * torch.randn(1, height // 2, width // 2, generator=generator)
    inverse[0, 10:14, 12:20] = torch.nan
    return rgb, inverse


def test_features_do_not_depend_on_the_unit_of_depth():
    rgb, inverse = _random(120, 160)
    found = glass_features(rgb, inverse)
    assert found.shape == (FEATURES, 240, 320)
    assert bool(found.isfinite().all())
    torch.testing.assert_close(glass_features(rgb, 1e3 * inverse), found, rtol=1e-3, atol=2e-3)


def _contradiction(*, textured, holes):
    """Return a photo and a wall; amid them a patch with texture and a highlight, and a patch that is lost in part."""
    rgb, inverse = torch.full((3, 240, 320), 0.5), torch.full((1, 240, 320), 0.5)
    if textured:
        noise = torch.rand(1, 40, 40, generator=torch.Generator().manual_seed(0))
        rgb[:, 100:140, 140:180] += 0.3 * (noise - 0.5)
        rgb[:, 104:108, 150:170] = 0.95
    if holes:
        inverse[0, 104:136, 150:156] = torch.nan
        inverse[0, 120:128, 150:174] = torch.nan
    return rgb, inverse


def test_texture_and_holes_together_are_glass():
    both, texture, holes = (
        float(probability_of_glass(*_contradiction(textured=textured, holes=holes)).max())
        for textured, holes in ((True, True), (True, False), (False, True))
    )
    assert both > 0.15
    assert texture == 0
    assert both > 2 * holes


@pytest.mark.parametrize("share", [0.9, 0.5, 0.2])
def test_single_missing_or_measured_pixels_are_no_glass(share):
    rgb, inverse = _contradiction(textured=True, holes=False)
    lost = torch.rand(inverse.shape, generator=torch.Generator().manual_seed(1)) > share
    assert float((expect_glass(rgb, inverse.masked_fill(lost, torch.nan)) > 0.02).float().mean()) < 0.01


def test_what_is_cut_away_is_no_glass():
    rgb, inverse = _contradiction(textured=True, holes=False)
    inverse[..., :130] = torch.nan
    assert float(probability_of_glass(rgb, inverse).max()) == 0
    narrow = inverse.clone()
    narrow[..., :105] = 0.5
    assert float(probability_of_glass(rgb, narrow).max()) > 0


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_probabilities_have_single_precision_and_no_gradient(dtype):
    rgb, inverse = _contradiction(textured=True, holes=True)
    with torch.inference_mode():
        probability_of_glass(rgb, inverse)
    found = probability_of_glass(rgb.to(dtype).requires_grad_(), inverse)
    assert found.dtype == torch.float32
    assert not found.requires_grad
    assert float(found.max()) > 0.1
    assert float(probability_of_glass(rgb.to(dtype), torch.full_like(inverse, torch.nan)).max()) == 0
    assert probability_of_glass(rgb[:, :3, :4], inverse[:, :1, :2]).shape == (1, 3, 4)


def test_wrong_depth_of_simulated_vessels_is_ranked_first_and_expected_to_be_wrong():
    source, aucs = Procedural(6, size=256, seed=5), []
    for number, name in enumerate(source.scenes()):
        scene, generator = source.load(name), torch.Generator().manual_seed(number)
        full, seen = add_glass(scene, generator, {"vessel": 1})
        rgb = full.rgb.float()
        inverse = NOISES["structured"](seen.float().reciprocal(), rgb.mean(dim=0, keepdim=True), generator)
        wrong = (full.depth != scene.depth) & ((inverse * full.depth - 1).abs() > 0.02)
        known = inverse.isfinite()
        if int((wrong & known).sum()) < 100:
            continue
        found = probability_of_glass(rgb, inverse)
        assert found.shape == wrong.shape
        aucs.append(float(off_auc(found[known].double(), wrong[known].double(), 0.5)))
    assert len(aucs) >= 3
    assert sum(aucs) / len(aucs) > 0.8


def test_stated_errors_of_all_methods_know_glass_unless_the_map_is_told_to_be_clean(
    monkeypatch,
):
    rgb, depth, camera = (
        torch.full((3, 48, 64), 0.5),
        torch.full((1, 48, 64), 2.0),
        Camera.from_fov(60, width=64, height=48),
    )
    glass = torch.zeros(1, 48, 64)
    glass[:, :24] = 0.06
    monkeypatch.setattr("dsr.inference.any_ratio.expect_glass", lambda *_: glass)
    for method in ("facets", "bilateral"):
        surface = upsample_surface(rgb, depth, camera, method=method, device="cpu")
        torch.testing.assert_close(surface.depth_error[:, :24], 0.06 * surface.depth[:, :24])
        assert float(surface.depth_error[:, 26:].max()) < 0.06
        assert surface.glass == 0.5
    clean = upsample_surface(rgb, depth, camera, settings={"noise": 0.0}, device="cpu")
    assert float(clean.depth_error.max()) < 0.06
    assert clean.glass is None


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Lightning's
def test_training_script_writes_weights_that_fit(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    spec = importlib.util.spec_from_file_location("train_glass", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    small = ["--scenes", "2", "--rendered", "1", "--steps", "2", "--workers", "0", "-o", "glass.safetensors"]
    monkeypatch.setattr("sys.argv", ["train_glass.py", *small])
    module.main()
    state = safetensors.torch.load_file("glass.safetensors")
    GlassFinder().load_state_dict(state)
    assert all(bool(each.isfinite().all()) for each in state.values())
    assert float(state["scale"].min()) > 0

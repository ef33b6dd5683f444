"""Prompt Depth Anything: what transformers' own processor and network give, files of others, and the hub."""

import json

import numpy as np
import pytest
import torch
from PIL import Image
from small_scenes import plane, sample_of

from dsr.methods.images import inpaint
from dsr.methods.recipe import read_recipe
from dsr.utils.configuration import ConfigError

transformers = pytest.importorskip("transformers", reason="pip install transformers")
from dsr.methods.networks.prompt_da import PromptDA  # noqa: E402


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder of a tiny network with random weights, as transformers writes it."""
    torch.manual_seed(0)
    backbone = transformers.Dinov2Config(
        hidden_size=16, num_hidden_layers=4, num_attention_heads=2, mlp_ratio=2, image_size=56,
        out_indices=[1, 2, 3, 4], reshape_hidden_states=False, initializer_range=0.15,
    )  # fmt: skip
    config = transformers.PromptDepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, neck_hidden_sizes=[4, 8, 8, 16], fusion_hidden_size=8,
        head_hidden_size=4, depth_estimation_type="metric", initializer_range=0.15,
    )  # fmt: skip
    path = tmp_path_factory.mktemp("promptda")
    transformers.PromptDepthAnythingForDepthEstimation(config).save_pretrained(path)
    return path


def photo(height, width):
    """Return a photo of 8 bits, (H, W, 3)."""
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def resized(picture, height, width):
    """Return a picture in 0..1, (h, w, 3), resized by Pillow without rounding."""
    planes = [Image.fromarray(each).resize((width, height), Image.Resampling.BICUBIC) for each in
              np.moveaxis(picture.astype(np.float32) / 255, -1, 0)]  # fmt: skip
    return np.stack([np.asarray(each) for each in planes], axis=-1).clip(0, 1)


def reference(folder, picture, metres, size):
    """Return what transformers computes, and the size of the photo that its network gets."""
    processor = transformers.PromptDepthAnythingImageProcessorPil(
        size={"height": size, "width": size}, ensure_multiple_of=14, keep_aspect_ratio=True, prompt_scale_to_meter=1.0,
        image_mean=[0.485, 0.456, 0.406], image_std=[0.229, 0.224, 0.225],
    )  # fmt: skip
    height, width = processor(images=picture, return_tensors="pt")["pixel_values"].shape[-2:]
    arguments = {"images": picture}
    if (height, width) != picture.shape[:2]:  # it would round
        photo = resized(picture, height, width)
        arguments = {"images": photo, "do_resize": False, "do_rescale": False, "input_data_format": "channels_last"}
    inputs = processor(prompt_depth=metres, return_tensors="pt", **arguments)
    network = transformers.PromptDepthAnythingForDepthEstimation.from_pretrained(folder)
    with torch.no_grad():
        outputs = network(**inputs)
    (found,) = processor.post_process_depth_estimation(outputs, target_sizes=[picture.shape[:2]])
    return found["predicted_depth"], (height, width)


@pytest.mark.parametrize(("shape", "size"), [((56, 84), 56), ((48, 64), 70), ((96, 64), 70), ((60, 200), 84)])
def test_result_is_that_of_transformers_own_processor_and_network(folder, shape, size):
    picture, metres = photo(*shape), np.random.default_rng(1).uniform(1, 4, (24, 32)).astype(np.float32)
    expected, within = reference(folder, picture, metres, size)
    seen = []
    method = PromptDA(str(folder), size)
    method.net.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].shape[2:]))
    with torch.no_grad():
        rgb = torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255
        found = method.predict(rgb, torch.from_numpy(metres)[None, None])
    assert seen == [within]
    assert float(expected.std()) > 0.01
    torch.testing.assert_close(found[0, 0], expected, rtol=0, atol=1e-5)


def test_holes_are_filled_and_do_not_enter_the_range(folder):
    method, problem = PromptDA(str(folder), 56), sample_of(plane(), torch.rand(3, 32, 48))
    problem.depth_lr[:, 3:5, 4:7] = torch.nan
    found = method(problem)
    assert (found.shape, found.dtype) == ((1, 32, 48), problem.depth_lr.dtype)
    assert bool(found.isfinite().all())
    problem.depth_lr[:] = inpaint(problem.depth_lr[None])[0]
    assert torch.equal(found, method(problem))


def test_recipe_takes_a_folder_and_knows_its_content(folder):
    method = read_recipe("prompt_da", {"weights": str(folder), "size": 56}).build(4)
    assert isinstance(method, PromptDA)
    assert method.content("set", "hall", 4).count(", ") == 1
    with pytest.raises(ConfigError, match=r"method.size: expected 14 or more, got 3"):
        read_recipe("prompt_da", {"weights": str(folder), "size": 3}).build(4)


def copied(folder, target, **changes):
    """Copy a folder with another configuration."""
    content = json.loads((folder / "config.json").read_text())
    (target / "config.json").write_text(json.dumps({**content, **changes}))
    (target / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes())
    return str(target)


def test_damaged_files_pickles_and_code_are_not_loaded(folder, tmp_path):
    code = {"auto_map": {"AutoModelForDepthEstimation": "evil.Model"}, "quantization_config": {"quant_method": "awq"}}
    weights = copied(folder, tmp_path, **code)
    (tmp_path / "evil.py").write_text("raise SystemExit('executed')")
    PromptDA(weights, 56)
    (tmp_path / "model.safetensors").write_bytes(b"\x08\0\0\0\0\0\0\0{}")
    with pytest.raises(ValueError, match=r"model.safetensors: expected"):
        PromptDA(weights)
    (tmp_path / "model.safetensors").unlink()
    torch.save({}, tmp_path / "pytorch_model.bin")
    with pytest.raises(ValueError, match=r"weights: expected"):
        PromptDA(weights)

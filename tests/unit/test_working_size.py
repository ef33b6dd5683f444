"""The noise of a sensor's map is distinguished from shape, and the map is worked on at the size that it suggests."""

import shutil

import cv2
import numpy as np
import pytest
import torch

from dsr.data.rendered import Procedural
from dsr.geometry.camera import Camera
from dsr.inference import upsample_surface
from dsr.inference.any_ratio import Selection, select
from dsr.inference.working_size import find_noise, limit_to_noise, mix_where_calm, reduce_by_medians, working_size_of
from dsr.methods.base import InverseSurface, MapNoise
from dsr.methods.recipe import Run, read_recipe
from dsr.sample import DepthSample
from dsr.utils.compute_device import fast_precision

SIZE = (480, 640)
CAMERA = Camera.centred(SIZE[1], SIZE[0], 600.0)
GREY = torch.full((3, *SIZE), 0.5)


def room():
    """Return the inverse depth of a floor and two walls, the nearer one in front."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float64)
    values = np.where(v > 320, 0.3 + 0.001 * (v - 320), 0.3 + 0.0001 * u)
    return np.where((u > 60) & (u < 190) & (v > 80) & (v < 400), 0.8 - 0.0002 * v, values)


def noisy(width, deviation=0.004):
    """Return depth of the room, (1, h, w), with noise of a full width at half maximum, in steps of a millimetre."""
    noise = np.random.default_rng(0).standard_normal(SIZE)
    if width > 1:
        noise = cv2.GaussianBlur(noise, (0, 0), width / 2.355 / np.sqrt(2))
    inverse = room() * (1 + deviation * noise / noise.std())
    return torch.from_numpy(np.round(1e3 / inverse) / 1e3)[None]


WAVES = GREY[:, :240, :320], noisy(20)[:, 100:340, 30:350], CAMERA.crop(100, 30, 240, 320)


@pytest.mark.parametrize("width", [3, 6, 10, 16, 24])
def test_noise_is_found_with_its_strength_and_extent(width):
    found = find_noise(noisy(width))
    assert found.extent == pytest.approx(width, rel=0.2)
    assert found.deviation == pytest.approx(0.004 * float(noisy(width).median()), rel=0.35)


def test_surfaces_without_noise_have_none_though_they_have_bumps(dsr_cache):
    assert find_noise(torch.from_numpy(1 / room())[None]) is None
    bumps = cv2.GaussianBlur(np.random.default_rng(0).standard_normal(SIZE), (0, 0), 8)
    assert find_noise(torch.from_numpy(1 / (room() * (1 + 0.004 * bumps / bumps.std())))[None]) is None
    source = Procedural(count=2, size=256)
    found = [find_noise(source.load(name).depth) for name in source.scenes()]
    assert all(noise is None or working_size_of(noise.extent) == 1 for noise in found)


@pytest.mark.parametrize(("extent", "factor"), [(1, 1), (9, 1), (10, 4), (20, 8), (37, 16), (200, 16)])
def test_size_is_divided_by_less_than_half_of_the_extent(extent, factor):
    assert working_size_of(extent) == factor


def test_medians_of_planes_are_planes_and_blocks_that_are_mostly_holes_are_holes():
    v, u = torch.meshgrid(torch.arange(12).double(), torch.arange(16).double(), indexing="ij")
    plane = (1 + 0.1 * u + 0.03 * v)[None]
    found = reduce_by_medians(plane, 4)
    assert found.shape == (1, 3, 4)
    steps = found[0].diff(dim=1)
    torch.testing.assert_close(steps, torch.full_like(steps, 0.4))
    plane[0, :4, :4] = torch.nan
    plane[0, 0, :3] = 1.0
    assert bool(reduce_by_medians(plane, 4)[0, 0, 0].isnan())
    plane[0, 0, 3] = 1.0
    assert float(reduce_by_medians(plane, 4)[0, 0, 0]) == 1


def test_calm_errors_are_no_larger_than_the_noise_leaves_and_others_stay():
    spread = torch.full((1, 8, 8), 0.02)
    spread[0, 0, 0] = 0.2
    measured = torch.ones(1, 4, 4)
    limited = limit_to_noise(spread, MapNoise(0.01, 20, 1.0), measured)
    assert float(limited[0, 4, 4]) == pytest.approx(0.45 * np.sqrt(2 / np.pi) * 0.01)
    assert float(limited[0, 0, 0]) == pytest.approx(0.2)
    assert torch.equal(limit_to_noise(spread, MapNoise(1.0, 20, 1.0), measured), spread)
    spread[0, 2:], measured[0, 1:] = 1.0, torch.nan  # most of the map is a hole, of which more is expected
    unsure = limit_to_noise(spread, MapNoise(0.01, 20, 1.0), measured)
    assert float(unsure[0, 1, 4]) == float(limited[0, 1, 4])
    assert float(unsure[0, 6, 4]) == 1


def test_evaluation_works_on_a_sensor_map_at_the_size_that_upsample_chooses():
    run = Run(precision=fast_precision(torch.device("cpu")))
    sample = DepthSample("set", "room", GREY, noisy(20), CAMERA, CAMERA, 1)
    surface = select(read_recipe("facets"), 1, measured=True).build(run).surface(sample)
    expected = upsample_surface(sample.rgb, sample.depth_lr, CAMERA, device="cpu", fill="all")
    assert surface.noise.reduced > 1
    for found, wanted in ((surface.depth, expected.depth), (surface.depth_error, expected.depth_error)):
        assert torch.equal(found, wanted)
    assert select(read_recipe("facets"), 1).direct
    assert select(read_recipe("facets", {"noise": 0}), 1, measured=True).direct


def test_weights_of_a_sensor_map_belong_to_the_run(tmp_path):
    files = select(read_recipe("facets"), 1, measured=True).files()
    assert {"facets_x2", "facets_x4", "facets_x8", "facets_x16"} <= {file.stem for file in files}
    own = tmp_path / "own.safetensors"
    shutil.copyfile(next(file for file in files if file.stem == "facets_x2"), own)
    selected = select(read_recipe("facets"), 1, own, measured=True)
    assert selected.files() == [own]
    assert not selected.direct


def test_errors_of_correlated_noise_are_limited_at_the_map_s_own_size():
    depth = noisy(8.5, 0.002)
    noise = find_noise(depth)
    surface = upsample_surface(GREY, depth, CAMERA)
    assert surface.noise.reduced == 1
    stated = float((surface.depth_error / surface.depth**2).nanmedian())
    left = 0.36 * noise.deviation / noise.distance**2
    assert stated < 1.18 * left  # 1.26 of it is what the network states


def test_evaluated_method_that_states_no_errors_has_none():
    camera = Camera.centred(48, 36, 50.0)
    depth = 2 + torch.linspace(0, 1, 48, dtype=torch.float64).expand(1, 36, 48)
    sample = DepthSample("set", "hall", torch.full((3, 36, 48), 0.5), depth, camera, camera, 1)
    surface = Selection(read_recipe("msg_v"), 1, direct=False).build(Run()).surface(sample)
    assert surface.depth_error is None
    assert surface.depth.dtype == torch.float64


def test_result_is_the_smoother_one_where_both_are_calm():
    one, two = torch.full((1, 8, 16), 0.5), torch.full((1, 8, 16), 0.6)
    spread = torch.full((1, 8, 16), 0.01)
    spread[..., :3] = 0.1
    found, smoother = (InverseSurface(each, spread, torch.full_like(one, 5.0)) for each in (one, two))
    mixed = mix_where_calm(found, smoother, torch.ones(1, 4, 8), reach=2).inverse
    assert torch.equal(mixed[..., :3], one[..., :3])
    assert torch.equal(mixed[..., 7:], two[..., 7:])
    assert bool((mixed[..., 2:7].diff() > 0).all())  # gradually, away from what is unsure
    assert mix_where_calm(found, InverseSurface(two), torch.ones(1, 4, 8), reach=2) is found


def test_waves_of_a_sensor_are_averaged_and_size_can_be_chosen():
    errors = {}
    for size in (None, 1, 8):
        surface = upsample_surface(*WAVES, working_size=size)
        wall = surface.depth[0, :200, 190:].double()
        errors[size] = float((wall.reciprocal() / torch.from_numpy(room()[100:300, 220:350]) - 1).std())
        assert surface.noise is not None
    assert errors[None] == errors[8] < 0.75 * errors[1]


def test_maps_that_are_known_to_be_clean_are_worked_on_as_they_are():
    reported, whole = (upsample_surface(*WAVES, working_size=size, settings={"noise": 0.0}) for size in (None, 1))
    assert torch.equal(reported.depth, whole.depth)


def test_board_before_a_stereo_camera_is_worked_on_at_an_eighth_or_less(shared):
    folder = shared / "real" / "stereo_board" / "depth"
    for name, factor in (("8", 8), ("14", 16)):
        depth = torch.from_numpy(cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_UNCHANGED).astype(np.float32))[None]
        found = find_noise(torch.where(depth > 0, depth / 1000, torch.nan))
        assert working_size_of(found.extent) == factor


@pytest.mark.parametrize(
    ("larger", "size", "options", "expected"),
    [
        *((1, 8, options, ".* got 8") for options in ({"method": "bicubic"}, {"scale": 4})),
        (1, 8, {"settings": {"noise": 0.0}}, ".* got 8"),
        (4, 8, {}, "at most 4 for"),
        (4, 3, {}, "one of 1, 2, 4, 8, 16, got 3"),
    ],
)
def test_size_without_effect_or_weights_is_refused(larger, size, options, expected):
    camera = CAMERA.rescale(larger * SIZE[1], larger * SIZE[0])
    rgb = torch.full((3, camera.height, camera.width), 0.5)
    with pytest.raises(ValueError, match=f"^working_size: expected {expected}"):
        upsample_surface(rgb, noisy(2), camera, working_size=size, **options)

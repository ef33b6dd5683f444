"""Depth cameras by name and by the values of their maps, and the least error that their disparity allows."""

import dataclasses
import math
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from dsr.degradation.sensors import SENSORS, Identified, identify, recognise, recognise_values
from dsr.geometry.camera import Camera
from dsr.inference import find_sensor, upsample_surface
from dsr.inference.working_size import find_noise

BY_NAME = {each.name: each for each in SENSORS}
PAGE = Path(__file__).parents[2] / "docs" / "sensors.md"
STATED = {
    "RealSense D435": ("Intel RealSense D435I", "Intel RealSense D435IF",
        "Intel RealSense D430 with Tracking Module",),
    "RealSense D455": ("Intel RealSense D457", "intel realsense d455",),
    None: ("Intel RealSense D405", "Orbbec Astra 2", "OAK-D-W", "oak_d_pro_w_ov9782", "iPhone 14", "iPhone 11 Pro",
        "iPhone13,2", "SM-G973F", "NIKON D4300", "Canon EOS 5D", "",),
    "RealSense D415": ("Intel RealSense D415",),
    "RealSense L515": ("Intel RealSense L515",),
    "Azure Kinect": ("Azure Kinect 4K Camera", "Azure Kinect Depth Camera", "Kinect for Azure", "Orbbec Femto Bolt",),
    "Kinect v2": ("Kinect for Windows v2", "Xbox Kinect One", "Microphone Array (Xbox NUI Sensor)", "kv2",),
    "Kinect v1": ("Xbox NUI Kinect", "Xbox NUI Camera", "Kinect for Xbox 360",),
    "Xtion": ("ASUS Xtion PRO LIVE",),
    "Astra": ("Orbbec Astra S",),
    "OAK-D Lite": ("OAK-D-LITE", "OAK-D Lite AF",),
    "OAK-D": ("OAK-D",),
    "OAK-D Pro": ("OAK-D-PRO", "OAK-D-PRO-FF-PB-FF#1", "OAK-D-S2-POE",),
    "ARKit lidar": ("iPhone 14 Pro", "iPhone 12 Pro Max", "iPad Pro (11-inch)", "iPhone13,3",),
    "phone time of flight": ("SM-G988B", "SM-N976B", "HUAWEI VOG-L29",),
}  # fmt: skip
"""What devices state, by the name of their sensor."""


@pytest.mark.parametrize("name", STATED)
def test_sensor_is_recognised_by_the_names_that_devices_state(name):
    for device in STATED[name]:
        found = recognise(device)
        assert (found and found.name) == name, device


def test_page_has_the_table():
    lines = [line for line in PAGE.read_text().splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    figures = {row[0]: row[1:] for row in rows if row[0] in BY_NAME and len(row) == 9}
    assert list(figures) == list(BY_NAME)
    for name, (kind, width, constant, step, noise, extent, spread, offset) in figures.items():
        sensor = BY_NAME[name]
        assert (kind, int(width)) == (sensor.kind, sensor.width)
        assert Fraction(step or 0) == (sensor.step or 0)
        for cell, figure in ((constant, sensor.stereo_constant), (noise, sensor.noise), (extent, sensor.extent)):
            assert float(cell or 0) == pytest.approx(figure or 0, rel=5e-3)
        for cell, figures_at in ((spread, sensor.spread), (offset, sensor.offset)):
            stated = [tuple(map(float, pair.split(" at "))) for pair in cell.split(", ") if pair]
            assert stated == [(pytest.approx(1000 * figure), distance) for distance, figure in figures_at or ()]
        assert recognise(name) is sensor


def least_error(camera, depth):
    return Identified(camera, "request").least_error(depth)


def test_least_error_is_that_of_the_disparity():
    depth = torch.tensor([[0.5, 1.0, 4.0]])
    camera = BY_NAME["RealSense D435"]
    torch.testing.assert_close(least_error(camera, depth), depth**2 * (0.08 / 32))
    rounded = BY_NAME["OAK-D"]
    torch.testing.assert_close(least_error(rounded, depth), depth**2 / (8 * math.sqrt(12) * 0.075 * 882.5))
    coarse = dataclasses.replace(camera, step=1.0)
    torch.testing.assert_close(least_error(coarse, depth), depth**2 / (math.sqrt(12) * 32))
    assert not least_error(BY_NAME["Astra"], depth).any()


def test_least_error_is_the_spread_of_time_of_flight_at_that_distance():
    depth = torch.tensor([[0.5, 1.0, 5.0], [9.0, 20.0, torch.nan]])
    expected = torch.tensor([[0.00125, 0.0025, 0.009], [0.0155, 0.0155, torch.nan]])
    torch.testing.assert_close(least_error(BY_NAME["RealSense L515"], depth), expected, equal_nan=True)
    both = dataclasses.replace(BY_NAME["RealSense D435"], spread=((1.0, 0.01), (2.0, 0.01)))
    torch.testing.assert_close(least_error(both, depth[0]), torch.tensor([0.005, 0.01, 25 * 0.08 / 32]))
    assert least_error(BY_NAME["Kinect v2"], depth.double()).dtype == torch.float64
    z = torch.tensor([1.0, 2.0, 3.0, 4.0])  # two papers: the second Kinect, and the first one far away
    torch.testing.assert_close(least_error(BY_NAME["Kinect v2"], z), (1.5 - 0.5 * z + 0.3 * z**2) / 1000)
    assert float(least_error(BY_NAME["Kinect v1"], z[3])) == pytest.approx(1.2e-3 + 1.9e-3 * 3.6**2, rel=0.2)


def slanted(near, far):
    """Return the inverse depth of a slanted wall, (480, 640)."""
    rows, columns = np.mgrid[:480, :640]
    return 1 / far + (1 / near - 1 / far) * (columns / 640 * 0.7 + rows / 480 * 0.3)


def as_stored(depth, unit):
    """Return depth rounded to a unit, (1, h, w)."""
    return torch.from_numpy(np.round(depth / unit) * unit)[None].float()


@pytest.mark.parametrize(("constant", "step"), [(43.5, 1 / 8), (33.7, 1 / 32), (66.2, 1 / 8), (43.5, 1.0)])
@pytest.mark.parametrize("unit", [1e-3, 1e-4])
def test_values_of_a_stereo_camera_give_its_constant(constant, step, unit):
    disparity = np.round(constant * slanted(0.5, 4.0) / step) * step
    depth = as_stored(constant / disparity, unit)
    depth[:, 100:150] = torch.nan
    found = recognise_values(depth)
    assert found.constant == pytest.approx(constant / step, rel=1e-3)
    assert 0.85 < found.confidence <= 1


def test_steps_that_the_rounding_hides_are_not_seen():
    disparity = np.round(33.7 * slanted(0.4, 0.7) * 32) / 32
    assert recognise_values(as_stored(33.7 / disparity, 1e-3)) is None


@pytest.mark.parametrize("unit", [1e-3, 1e-4])
def test_other_maps_have_no_steps_of_disparity(unit):
    rows, columns = np.mgrid[:480, :640]
    smooth = 0.5 + 3.1 * np.sin(0.3 + columns / 700 + (rows / 900) ** 1.7) ** 2
    noise = np.random.default_rng(0).normal(size=smooth.shape)
    assert recognise_values(as_stored(smooth, unit)) is None
    assert recognise_values(as_stored(smooth * (1 + 0.003 * noise), unit)) is None
    filtered = cv2.GaussianBlur(np.round(348 / smooth + noise) / 348, (5, 5), 1.0)
    assert recognise_values(as_stored(1 / filtered, unit)) is None
    assert recognise_values(torch.full((1, 48, 64), torch.nan)) is None
    assert recognise_values(torch.ones(1, 48, 64)) is None


@pytest.mark.parametrize(
    ("file", "unit", "constant"),
    [
        ("stereo_board/depth/8.png", 1e-3, 32 * 32.0),
        ("stereo_board/depth/31.png", 1e-3, 32 * 32.0),
        ("sunrgbd/open3d_sample/SUN_depth.png", 1e-3 / 8, 8 * 0.075 * 570.3),
        ("iphone_lidar/arkit_depth.png", 1e-3, None),
        ("rgbdd_real/DepthLR/20200509112638_LR_fill_depth.png", 1e-3, None),
    ],
)
def test_values_of_real_cameras_give_their_constants_and_those_of_time_of_flight_none(shared, file, unit, constant):
    stored = cv2.imread(str(shared / "real" / file), cv2.IMREAD_UNCHANGED)
    depth = torch.from_numpy(stored.astype(np.float64) * unit)[None].float()
    found = recognise_values(depth.masked_fill(depth == 0, torch.nan))
    assert (found and found.constant) == (constant and pytest.approx(constant, rel=0.003))


PART = (slice(None), slice(144), slice(192))  # of a map of 640 x 480 pixels
LENS = Camera.centred(192, 144, 360.0)
GREY = torch.full((3, 144, 192), 0.5)


def surface_of(depth, **settings):
    return upsample_surface(GREY, depth, LENS, **settings)


def counted(constant, unit=1e-4, noise=0.0):
    """Return a map of a slanted wall in steps of disparity, whose noise is correlated over 9 pixels."""
    inverse = slanted(1.0, 6.0)
    waves = cv2.GaussianBlur(np.random.default_rng(0).standard_normal(inverse.shape), (0, 0), 2.7)
    inverse = inverse + noise * waves / waves.std()
    return as_stored(constant / np.round(inverse * constant), unit)


@pytest.mark.slow
def test_sensor_is_identified_by_what_is_given_then_by_values_then_by_files():
    stereo = counted(1024)
    assert identify(stereo)[:2] == (BY_NAME["RealSense D435"], "values")
    assert identify(stereo).constant == pytest.approx(1024, rel=0.002)
    for part in (848 / 1280, 0.6, 0.5):  # modes, 640 x 480 is cropped
        assert identify(counted(1024 * part)).sensor is BY_NAME["RealSense D435"]
        assert identify(counted(1024 * part), "d435i")[:2] == (BY_NAME["RealSense D435"], "request")
    assert identify(stereo, device_name="Intel RealSense D435I").by == "file"
    assert identify(stereo, device_name="Azure Kinect 4K Camera").by == "file"  # of another kind: no steps of its own
    assert identify(stereo, device_name="Kinect v1")[:2] == (BY_NAME["RealSense D435"], "values")
    assert identify(stereo, device_name="SM-G988B")[:2] == (BY_NAME["RealSense D435"], "values")
    assert identify(stereo, "none") is None
    plain = as_stored(1 / slanted(1.0, 6.0), 1e-3)
    assert identify(plain) is None
    assert identify(plain, device_name="Record3D") is None  # no figures are known
    assert identify(plain, "Kinect v1").sensor is BY_NAME["Kinect v1"]


def test_sensor_that_is_unknown_or_contradicts_the_values_is_refused():
    for name in ("Leica", "Astra", "Kinect v1"):
        with pytest.raises(ValueError, match=r"sensor: expected"):
            identify(counted(1024), name)


def test_computed_disparity_is_no_camera():
    assert find_sensor(counted(1024)) is None
    assert find_sensor(counted(1024, noise=0.004)).sensor is BY_NAME["RealSense D435"]
    depth = counted(1024)[PART]
    auto, none = (surface_of(depth, sensor=name) for name in ("auto", "none"))
    assert torch.equal(auto.depth, none.depth)
    assert torch.equal(auto.depth_error, none.depth_error)


def test_stated_error_is_never_less_than_the_disparity_allows():
    depth = counted(512)[PART]
    none, named = (surface_of(depth, method="bicubic", scale=4, sensor=name) for name in ("none", "D435"))
    least = 0.45 * math.sqrt(2 / math.pi) * least_error(BY_NAME["RealSense D435"], named.depth) / 0.5
    assert torch.equal(none.depth, named.depth)
    torch.testing.assert_close(named.depth_error, torch.maximum(none.depth_error, least), rtol=5e-3, atol=1e-7)
    assert bool((named.depth_error > none.depth_error).any())


def test_systematic_error_of_a_known_sensor_is_added_to_the_stated_one():
    camera, rgb = Camera.centred(160, 120, 150.0), torch.full((3, 120, 160), 0.5)
    depth = as_stored(1 / slanted(0.4, 6.0)[::4, ::4], 1e-3)
    names = ("none", "Kinect v2", "Azure Kinect")
    found = {each: upsample_surface(rgb, depth, camera, method="bicubic", sensor=each) for each in names}
    z = found["none"].depth
    for name, metres in (("Kinect v2", 0 * z), ("Azure Kinect", 0.011 + 0.001 * z.clamp(0.5, 5.5))):
        assert torch.equal(found[name].depth, z)
        random = torch.maximum(found["none"].depth_error, 0.45 * math.sqrt(2 / math.pi) * least_error(BY_NAME[name], z))
        torch.testing.assert_close(found[name].depth_error, torch.hypot(random, metres / 2), rtol=5e-3, atol=1e-7)
    assert torch.equal(found["none"].angle_error, found["Azure Kinect"].angle_error)


@pytest.mark.slow
def test_correlated_noise_of_a_stereo_camera_is_given_as_it_grows():
    depth = counted(1024, 1e-3, noise=0.004)[PART]
    found = find_noise(depth)
    assert found.extent == pytest.approx(9, rel=0.2)
    assert found.deviation == pytest.approx(0.004 * found.distance**2, rel=0.2)
    reported = {"noise": found.deviation / found.distance**2, "noise_growth": 2.0}
    sensed, set_here, unset = (
        surface_of(depth, sensor=sensor, settings=settings).depth
        for sensor, settings in (("D435", {}), ("none", reported), ("none", {}))
    )
    torch.testing.assert_close(sensed, set_here)
    assert not torch.equal(sensed, unset)
    exact = surface_of(depth, sensor="D435", settings={"noise": 0.0}).depth
    assert torch.equal(exact, surface_of(depth, sensor="none", settings={"noise": 0.0}).depth)


def test_noise_that_is_not_correlated_is_left_to_the_network():
    inverse = slanted(1.0, 6.0) + 0.004 * np.random.default_rng(0).standard_normal((480, 640))
    depth = as_stored(1 / inverse, 1e-3)[PART]
    named, none = (surface_of(depth, sensor=name).depth for name in ("D435", "none"))
    assert torch.equal(named, none)


def test_growth_without_noise_is_refused():
    camera, rgb = Camera.centred(32, 32, 40.0), torch.full((3, 32, 32), 0.5)
    with pytest.raises(ValueError, match="noise_growth: expected noise with it"):
        upsample_surface(rgb, torch.ones(1, 8, 8), camera, settings={"noise_growth": 2.0})

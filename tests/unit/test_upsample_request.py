"""What ``dsr upsample`` is asked: the parts that are written, and the settings that a result depends on."""

import math
from pathlib import Path

import pytest

from dsr.app.upsample.parts import PARTS, Results
from dsr.app.upsample.request import FrameChoice, UpsampleRequest, Upsampling
from dsr.io.reading import CameraChoice, Reading
from dsr.utils.options import OptionError

OUT = Path("out")


def results(**options):
    return Results(output=OUT, **options)


@pytest.mark.parametrize(
    ("options", "of_frame", "of_all"),
    [
        ({"only": ("normals", "depth")}, ["depth", "normals"], []),
        ({"only": ("cloud",), "more": ("open3d",)}, ["depth", "cloud", "rgbd"], ["open3d"]),
        ({"only": ("nerfstudio", "gaussian")}, ["depth", "rgbd"], ["nerfstudio", "gaussian"]),
        ({"without": ("mesh",)}, [name for name in PARTS if PARTS[name].usual and name != "mesh"], []),
    ],
)
def test_parts_are_those_asked_for_and_what_they_are_made_of(options, of_frame, of_all):
    wanted = results(**options)
    assert [part.name for part in wanted.of_frame] == of_frame
    assert [part.name for part in wanted.of_all] == of_all


def test_settings_are_all_options_that_a_result_depends_on():
    request = UpsampleRequest(
        frames=FrameChoice(folders=(Path("in"),), workers=3),
        reading=Reading(camera=CameraChoice(intrinsics=(1.0, 2.0, 3.0, 4.0)), unit="sunrgbd", hole_value=math.nan),
        upsampling=Upsampling(settings=(("noise_growth", 1.0),), noise=0.01, device="cuda"),
        results=results(max_error=1.0, overwrite=True),
    )
    settings = request.settings
    assert (settings["depth_unit"], settings["intrinsics"]) == ("sunrgbd", [1.0, 2.0, 3.0, 4.0])
    assert settings["hole_value"] is None  # NaN is a hole anyway
    assert (settings["set"], settings["max_error"]) == ({"noise_growth": 1.0, "noise": 0.01}, 0.01)
    assert {"workers", "device", "overwrite", "output", "folders"} & set(settings) == set()


def test_argument_with_an_option_of_its_own_is_given_once():
    with pytest.raises(OptionError, match="noise: expected it once, got --set noise=1, too"):
        Upsampling(noise=0.1, settings=(("noise", 1),))

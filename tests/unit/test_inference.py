"""Upsampling anybody's picture: any size, any ratio, arrays and tensors; holes, also those between two surfaces."""

import math

import pytest
import torch
from methods_at_hand import AT_HAND

import dsr
from dsr.geometry.camera import Camera
from dsr.geometry.resampling import resize_inverse_depth
from dsr.inference import upsample_surface
from dsr.inference.plausibility import find_filled
from dsr.inference.resizing import plan_for, resize_nearest
from dsr.inference.rims import settle_holes
from dsr.inference.working_size import enlarged_by
from dsr.methods.images import inpaint
from dsr.methods.recipe import read_recipe


def _camera(height, width):
    return Camera(width, height, 60.0, 60.0, (width - 1) / 2, (height - 1) / 2)


def _plane(height, width, camera):
    """Return the depth of a slanted plane at the pixels of a map that covers the camera's view, (1, H, W) float64."""
    own = camera.rescale(width, height)
    x, y, _ = own.rays()
    return (0.5 + 0.2 * x - 0.1 * y).reciprocal()[None]


def upsample_depth(*given, **options):
    """Return the upsampled depth alone."""
    return upsample_surface(*given, **options).depth


def plan(size, size_lr, scale=None, method="facets"):
    """Return the plan of a method."""
    return plan_for(read_recipe(method), size, size_lr, scale)


def _photo(height, width):
    return torch.rand((3, height, width), generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("size", "coarse_size"),
    [((48, 64), (12, 16)), ((48, 64), (24, 32)), ((45, 60), (15, 20)), ((45, 61), (11, 15)), ((60, 75), (8, 10)),
     ((64, 96), (4, 6)), ((41, 46), (41, 46))],
    ids=lambda size: "x".join(map(str, size)),
)  # fmt: skip
@pytest.mark.parametrize("method", ["facets", "bicubic"])
def test_slanted_plane_is_reproduced_at_any_size_and_ratio(method, size, coarse_size):
    camera = _camera(*size)
    fine = upsample_depth(_photo(*size), _plane(*coarse_size, camera), camera, method=method)
    truth = _plane(*size, camera)
    assert fine.shape == truth.shape
    assert fine.dtype == torch.float32
    off = (fine.reciprocal() - truth.reciprocal()).abs()
    # a spline's depth is not straight where inverse depth is, and flat at the border: off by less than a low-resolution
    # pixel
    assert float(off.max()) < (3e-6 if method == "facets" else 0.3 / 60 * max(size[1] / coarse_size[1], 4))


def test_depth_of_the_photos_size_keeps_its_own_holes():
    camera = _camera(33, 46)
    depth = _plane(33, 46, camera)
    holes = torch.rand(depth.shape, generator=torch.Generator().manual_seed(1)) < 0.3
    depth = depth.masked_fill(holes, torch.nan)
    rgb = _photo(33, 46)
    kept = upsample_depth(rgb, depth, camera, fill="none")
    torch.testing.assert_close(kept.isnan(), holes)
    filled = upsample_depth(rgb, depth, camera)
    assert bool(filled.isfinite().all())
    assert float((filled / _plane(33, 46, camera) - 1).abs().max()) < 0.05


def test_enlarged_depth_is_reduced_to_its_low_resolution_map():
    camera = _camera(48, 64)
    coarse, rgb = _plane(6, 8, camera), _photo(48, 64)
    coarse[:, 1, 2] = torch.nan
    enlarged = coarse.repeat_interleave(8, -1).repeat_interleave(8, -2)
    assert enlarged_by(enlarged) == 8
    assert enlarged_by(enlarged[:, :-3, :-5]) == 8
    assert enlarged_by(enlarged[:, 1:]) == 1
    assert enlarged_by(coarse) == enlarged_by(torch.ones(1, 8, 8)) == 1
    torch.testing.assert_close(upsample_depth(rgb, enlarged, camera), upsample_depth(rgb, coarse, camera))


def test_nearest_repeats_pixels_and_a_step_stays_sharp_when_the_result_is_reduced():
    camera = Camera(15, 12, 1e5, 1e5, 7.0, 5.5)  # of so narrow a view that all range types agree
    coarse = torch.full((1, 8, 10), 1.0)
    coarse[..., 4:] = 2.0
    fine = upsample_depth(_photo(12, 15), coarse, camera, method="nearest")
    torch.testing.assert_close(fine[0], torch.tensor([1.0] * 6 + [2.0] * 9).expand(12, 15))
    step = resize_inverse_depth(torch.cat((torch.ones(1, 30, 13), torch.full((1, 30, 17), 0.5)), -1), (20, 20))
    assert set(step.unique().tolist()) == {0.5, 1.0}


@pytest.mark.parametrize("size", [(61, 50), (97, 33), (20, 80), (110, 85), (300, 81)])
def test_resizing_keeps_planes_to_rounding_up_to_the_border(size):
    def plane(height, width):
        y, x = ((torch.arange(n, dtype=torch.float64) + 0.5) / n for n in (height, width))
        return (0.3 + 0.5 * x + y[:, None])[None]

    torch.testing.assert_close(resize_inverse_depth(plane(97, 80), size), plane(*size), rtol=0, atol=1e-12)


def test_plan_describes_the_steps():
    assert plan((480, 640), (120, 160)).scale == 4
    assert plan((1440, 1920), (192, 256)).scale == 8  # 7.5
    assert plan((720, 1280), (240, 426), method="facets_box").steps == (4,)
    assert plan((3024, 4032), (192, 256), method="facets_box").steps == (8, 4)  # 15.75
    assert plan((480, 640), (480, 640), method="facets_box").coarsened == 4
    assert plan((480, 640), (480, 640), 8).coarsened == 8
    assert plan((480, 640), (120, 160), 8, method="facets_box").steps == (8,)
    assert plan((480, 640), (480, 640)).coarsened == 1  # at its own size
    assert plan((480, 640), (160, 213), method="bicubic").scale == 3  # 3.005
    assert plan((480, 640), (152, 203), method="bicubic").scale == 4  # 3.16
    assert plan((480, 640), (160, 214), method="bicubic").steps == ()
    for photo, depth, factor in (
        ((968, 1296), (480, 640), 2), ((964, 1286), (240, 320), 4), ((1440, 1920), (192, 256), 8),
        ((480, 640), (480, 640), 1),
    ):  # fmt: skip
        assert plan(photo, depth).scale == factor
        weights = read_recipe("facets").weights(max(photo[1] / depth[1], 1))
        assert weights.name == f"facets_x{max(factor, 2)}.safetensors"
    text = plan((3000, 4000), (750, 1000)).text
    assert "750 x 1000 depth to 3000 x 4000 by facets x4" in text
    assert text.count("\n") == 0
    gigabytes = float(text.split("about ")[1].split(" GB")[0])
    assert 1 < gigabytes < 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((48, 64), (12, 16), 4, "fcets"), "method: expected one of bicubic, .*, tgv, .*got 'fcets'"),
        (((48, 64), (12, 16), 2, "facets_box"), "scale: expected one of 4, 8, 16, 32 for facets_box, got 2"),
        (((48, 64), (12, 16), 8, "msg_v_noisy"), "scale: expected one of 4, 16 for msg_v_noisy, got 8"),
        (((48, 64), (12, 16), 0, "bicubic"), "scale: expected a positive whole number, got 0"),
        (((480, 640), (120, 150), None, "facets"), "aspect within 2%, got 120 x 150 for a photo of 480 x 640"),
        (((480, 640), (960, 1280), None, "facets"), "expected no more pixels than the photo, got 960 x 1280"),
        (((4800, 6400), (96, 128), None, "facets_box"), "at least 1/32 of the photo's size for facets_box, got 1/50"),
        (((2000, 2000), (500, 500), None, "dip_v"), "method=dip_v: expected a photo of up to 1048576 pixels"),
    ],
)
def test_invalid_request_is_refused_in_one_line(arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        plan(*arguments)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, 1e19, 1e-12])
def test_depth_that_is_no_distance_is_refused(value):
    depth = torch.ones(1, 12, 16)
    depth[0, 3, 4] = value
    with pytest.raises(ValueError, match=r"^depth: expected .*, got .* (in 1 of 192|in 0\.52% of the) pixels"):
        upsample_depth(_photo(48, 64), depth, _camera(48, 64))


def test_pixels_without_depth_stay_holes_and_a_result_without_any_is_refused(monkeypatch):
    result, camera = torch.full((1, 48, 64), 2.0), _camera(48, 64)
    result[0, 3, 5] = math.nan
    monkeypatch.setattr("dsr.methods.classical.interpolation.Interpolation.interpolate", lambda *_: result.clone())
    fine = upsample_depth(_photo(48, 64), _plane(12, 16, camera), camera, method="bicubic")
    assert fine.isnan().nonzero().tolist() == [[0, 3, 5]]
    result[:] = math.nan
    with pytest.raises(ValueError, match=r"^bicubic gave no finite positive depth in any of the 3072 pixels$"):
        upsample_depth(_photo(48, 64), _plane(12, 16, camera), camera, method="bicubic")


@pytest.mark.parametrize("method", AT_HAND)
def test_every_method_upsamples_any_size_and_its_holes(method):
    camera = _camera(31, 42)
    depth = _plane(15, 21, camera)
    depth[:, 4:6, 5:8] = torch.nan
    quick = {"dip": {"steps": 2}, "dip_v": {"steps": 2}, "srfs": {"iterations": 2}}.get(method, {})
    steps = []
    surfaces = [
        upsample_surface(
            _photo(31, 42), depth, camera, method=method, settings=quick, fill=fill,
            progress=lambda *step: steps.append(step),
        )
        for fill in ("all", "none")
    ]  # fmt: skip
    full, kept = (each.depth for each in surfaces)
    missing = resize_nearest(depth.isnan(), (31, 42))
    for surface, filled in zip(surfaces, (missing, torch.zeros_like(missing)), strict=True):
        assert torch.equal(surface.filled, filled)
    assert full.shape == (1, 31, 42)
    assert bool(full.isfinite().all())
    assert torch.equal(kept.isnan(), missing)
    assert all(done == total for done, total in steps[-1:])
    if not method.startswith("dip"):
        assert float((full / _plane(31, 42, camera) - 1).abs().max()) < 0.1


def test_settings_change_the_result_and_are_checked():
    camera, depth = _camera(32, 32), _plane(8, 8, _camera(32, 32))
    depth[:, 2:5, 2:5] *= 0.8
    exact, loose = (
        dsr.upsample(_photo(32, 32), depth, camera, method="tgv", **settings) for settings in ({}, {"data_weight": 0.1})
    )
    assert float((exact - loose).abs().max()) > 1e-3
    for settings, message in (
        ({"data_wieght": 3}, "data_wieght: unknown key; method=tgv takes iterations, .*data_weight"),
        ({"data_weight": "x"}, "data_weight: expected number or 'auto' or null, got 'x'"),
        ({"data_weight": -3}, "data_weight: expected a positive number, got -3"),
        ({"fill_holes": False}, "fill_holes: unknown key"),
    ):
        with pytest.raises(ValueError, match=f"^{message}"):
            dsr.upsample(_photo(32, 32), depth, camera, method="tgv", **settings)


def test_pixels_that_a_method_leaves_out_stay_holes():
    """They are not taken for infinitely far ones."""
    camera, photo = _camera(48, 64), _photo(48, 64)
    depth = _plane(24, 32, camera)
    depth = depth + 0.02 * torch.randn(depth.shape, generator=torch.Generator().manual_seed(0))
    whole = upsample_surface(photo, depth, camera, settings={})
    share = whole.depth_error / whole.depth
    limit = float(share.median())
    cut = upsample_depth(photo, depth, camera, settings={"max_error": limit})
    dubious = share > limit
    certain = (share - limit).abs() > 1e-4 * limit
    assert torch.equal(cut.isnan()[certain], dubious[certain])
    torch.testing.assert_close(cut[cut.isfinite()], whole.depth[cut.isfinite()])


@pytest.mark.parametrize(
    ("size_lr", "options"),
    [((96, 128), {}), ((48, 64), {"working_size": 4}), ((96, 128), {"method": "msg_v"}),
     ((36, 49), {"method": "bicubic"})],
)  # fmt: skip
def test_filled_depth_is_that_whose_nearest_pixel_of_the_map_is_a_hole_or_an_outlier(size_lr, options):
    camera = _camera(96, 128)
    depth = _plane(*size_lr, camera)
    depth[:, 4:6, 5:9], depth[:, 10:30, :25] = torch.nan, torch.nan
    depth[:, 20:22, 40:42] = 0.01
    surface = upsample_surface(_photo(96, 128), depth, camera, **options)
    missing = resize_nearest(depth.isnan() | (depth < 0.05), (96, 128))
    assert torch.equal(surface.filled, missing & surface.depth.isfinite())
    assert torch.equal(find_filled(surface.depth, depth), surface.filled)
    assert 0 < int(surface.filled.sum()) < int(missing.sum())


def test_wide_holes_stay_unless_all_are_to_be_filled():
    camera = _camera(96, 128)
    depth = _plane(48, 64, camera)
    depth[:, 10:40, 10:40] = torch.nan
    depth[:, 4:6, 50:53] = torch.nan
    rgb = _photo(96, 128)
    for method in ("facets", "bicubic"):
        small, wider, everything, none = (
            upsample_depth(rgb, depth, camera, method=method, **options)
            for options in ({}, {"max_hole": 60}, {"fill": "all"}, {"fill": "none"})
        )
        assert bool(small[:, 30:70, 30:70].isnan().all())
        assert bool(small[:, 8:12, 100:106].isfinite().all())
        assert bool(everything.isfinite().all())
        assert bool(wider.isfinite().all())
        assert int(none.isnan().sum()) == 4 * (900 + 6)
        there = small.isfinite()
        assert torch.equal(small[there], everything[there])
    for wrong in ({"fill": "some"}, {"max_hole": 0}, {"max_hole": math.inf}):
        with pytest.raises(ValueError, match=f"^{next(iter(wrong))}: expected"):
            upsample_depth(rgb, depth, camera, **wrong)


NEAR, FAR = 1.0, 2.5
CAMERA = Camera(width=160, height=128, fx=150.0, fy=150.0, cx=79.5, cy=63.5)
RED, BLUE = (0.8, 0.2, 0.1), (0.2, 0.3, 0.7)


def _ring(inside):
    """Return the photo of a red ring before a blue wall, its map, and what is inside of it, which the map lacks."""
    rows, columns = torch.meshgrid(torch.arange(32.0), torch.arange(40.0), indexing="ij")
    radius = ((rows - 15.5).square() + (columns - 19.5).square()).sqrt()
    ring, hole, lost = radius < 8, radius < 3, radius < 4
    red, blue, other = (torch.tensor(each)[:, None, None] for each in (RED, BLUE, inside))
    photo = torch.where(hole, other, torch.where(ring, red, blue)).repeat_interleave(4, 1).repeat_interleave(4, 2)
    photo = (photo + 0.02 * torch.randn(photo.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)
    hole = hole[None].repeat_interleave(4, 1).repeat_interleave(4, 2)
    return photo, torch.where(ring, NEAR, FAR).masked_fill(lost, torch.nan)[None], hole


@pytest.mark.parametrize("method", ["facets", "bicubic", "guided_filter"])
def test_loop_is_seen_through_where_the_photo_shows_what_is_behind(method):
    for colour, depth in ((BLUE, FAR), (RED, NEAR)):
        photo, given, hole = _ring(colour)
        surface = upsample_surface(photo, given, CAMERA, method=method, max_hole=20)
        assert bool(surface.filled[hole].all())
        middle = torch.zeros_like(hole)
        middle[:, 58:70, 74:86] = True
        torch.testing.assert_close(surface.depth[middle], torch.full((144,), depth), rtol=0.06, atol=0)


def test_hole_that_shows_neither_surface_is_doubtful():
    errors = []
    for colour in (BLUE, (0.5, 0.25, 0.4)):
        photo, given, _ = _ring(colour)
        surface = upsample_surface(photo, given, CAMERA, max_hole=20)
        errors.append(float((surface.depth_error / surface.depth)[:, 60:68, 76:84].mean()))
    assert errors[0] < 0.1 < errors[1]


@pytest.mark.parametrize("shape", ["ring", "floor", "hill", "outliers"])
def test_undecided_hole_is_doubtful_at_a_step_and_not_on_a_slope(shape):
    rows, columns = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    squared = (rows % 20 - 10).square() + (columns % 20 - 10).square()
    few = torch.rand(rows.shape, generator=torch.Generator().manual_seed(0)) < 0.01
    depth = {
        "ring": torch.where(squared < 50, NEAR, FAR),
        "floor": 1 / (0.25 + rows / 80),
        "hill": 1 / (0.5 + (rows / 60).square() + (columns / 80).square()),
        "outliers": torch.where(few, NEAR, 1.5 * NEAR),
    }[shape]
    holes = (squared < 12)[None]
    found = settle_holes(depth[None].masked_fill(holes, torch.nan).reciprocal(), torch.full((3, 60, 80), 0.5), holes)
    doubtful = (found.doubt[holes] > 0.02).float().mean()
    assert doubtful > 0.95 if shape == "ring" else doubtful < 0.02


def test_strip_beside_a_near_object_is_of_what_is_behind_it():
    depth = torch.full((1, 40, 60), FAR)
    depth[:, 10:30, 20:40] = NEAR
    photo = torch.tensor(BLUE)[:, None, None].expand(3, 40, 60).clone()
    photo[:, 10:30, 20:40] = torch.tensor(RED)[:, None, None]
    holes = torch.zeros_like(depth, dtype=torch.bool)
    holes[:, 10:30, 17:20], holes[:, 10:30, 40:43] = True, True
    found = settle_holes(depth.masked_fill(holes, torch.nan).reciprocal(), photo, holes)
    torch.testing.assert_close(inpaint(found.inverse[None], photo[None])[0].reciprocal(), depth, rtol=1e-3, atol=0)


def test_other_holes_are_left_to_the_method():
    generator = torch.Generator().manual_seed(0)
    photo = torch.rand((3, 40, 60), generator=generator)
    slope = torch.linspace(2, 2.2, 60).expand(1, 40, 60).clone()
    holes = torch.zeros_like(slope, dtype=torch.bool)
    holes[:, 10:20, 20:30] = True
    step = torch.where(torch.arange(60) < 30, NEAR, FAR).expand(1, 40, 60)
    points = torch.rand(step.shape, generator=generator) < 0.2
    for depth, missing, fill in ((slope, holes, holes), (step, holes, ~holes), (step, ~points, ~points)):
        given = depth.masked_fill(missing, torch.nan).reciprocal()
        found = settle_holes(given, photo, fill)
        torch.testing.assert_close(found.inverse, given, equal_nan=True)
        assert not bool(found.doubt.any())


def test_maps_on_other_sizes_and_without_holes_pass():
    for size in ((1, 1), (2, 3), (5, 4)):
        full = torch.ones(1, *size)
        assert torch.equal(settle_holes(full, torch.rand(3, 10, 12), full > 2).inverse, full)
        pierced = full.clone()
        pierced[0, 0, 0] = torch.nan
        assert settle_holes(pierced, torch.rand(3, 10, 12), pierced.isnan()).inverse.shape == full.shape

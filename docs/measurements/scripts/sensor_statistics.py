# Frozen: this measured once what the documentation says of it, from benchmarks/. It is not maintained.
"""Compare the statistics of real sensors' maps with those of the simulated sensors that a network is trained on.

    python docs/measurements/scripts/sensor_statistics.py [--shared DIR] [--scenes 6] [--draws 4] [--sheet FILE] [--only KIND,...]

``DIR`` holds ``real``; without it simulated sensors stand alone. Simulated maps are drawn at factor 1 from rendered
scenes (``dataset=procedural``), in millimetres as cameras write them. The first table has a map's amplitude of noise
and its correlation length: those of the largest window in which the residual about a plane stays shorter than a fifth
of the window, in its flattest tenth, of simulated sensors before a wall; medians of the maps and, of simulated ones,
the 5th to 95th percentiles. The second compares windows of 48 pixels, the flattest tenth of each map, and steps of
depth: medians, and the two-sample statistic of Kolmogorov and Smirnov (0 for equal distributions, 1 for disjoint ones).
One device has one setting while simulated ones have many, so what counts is that the real medians lie within the
simulated range. ``--sheet`` draws photo, relit depth, residual about a plane and its power spectrum of each real sensor
above those of simulated ones: one sheet for each kind, or one for all where they stand alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from panel_grid import Panel, save_panels
from scipy import ndimage, stats

from dsr.data import sunrgbd
from dsr.data.rendered import Procedural
from dsr.degradation.noise import NOISES
from dsr.geometry.camera import Camera
from dsr.geometry.surface import render_for_viewing
from dsr.io.depth_files import read_depth_file
from dsr.pictures.depth_views import normals_seen_by

WINDOWS = (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384)
WINDOW = 48
"""Pixels of the windows that are compared."""
JUMP = 0.08
"""Relative change of depth across a step."""
REACH = 7
"""Pixels on each side of a step that are looked at."""


class Map(NamedTuple):
    """A sensor's map: depth in metres, (h, w), NaN in holes, and the photo's brightness there, in [0, 1]."""

    depth: np.ndarray
    luma: np.ndarray


class Sensor(NamedTuple):
    """A real sensor, by the simulated kind that is meant for it, and the files of its maps, photo beside depth."""

    kind: str
    files: Callable[[Path], Iterator[tuple[Path, Path]]]
    unit: float = 1e-3


def _pairs(depth: str, photo: str) -> Callable[[Path], Iterator[tuple[Path, Path]]]:
    """Return a finder of depth maps, by a pattern below ``real``, and of photos that lie in the same order."""
    return lambda real: zip(sorted(real.glob(depth)), sorted(real.glob(photo)), strict=True)


SENSORS: Mapping[str, Sensor] = {
    "stereo_board": Sensor("stereo", _pairs("stereo_board/depth/*.png", "stereo_board/color/*.png")),
    "depth_camera": Sensor("stereo", _pairs("depth_camera/*/raw_depth.png", "depth_camera/*/rgb.*")),
    "cleargrasp": Sensor("stereo", _pairs("cleargrasp/*-opaque-depth*.exr", "cleargrasp/*-opaque-rgb*.jpg"), 1.0),
    "ddrnet": Sensor("structured", _pairs("ddrnet/depth_map/*.png", "ddrnet/color_map/*.png")),
    "kinect1": Sensor("structured", _pairs("sunrgbd/img_*/depth/*.png", "sunrgbd/img_*/image/*.jpg"), 0.0),
    "kinect2": Sensor("flight", _pairs("sunrgbd/2014*/depth/*.png", "sunrgbd/2014*/image/*.jpg"), 0.0),
    "rgbdd_real": Sensor("flight", _pairs("rgbdd_real/DepthLR/*.png", "rgbdd_real/RGB/*.jpg")),
    "iphone_lidar": Sensor("lidar", _pairs("iphone_lidar/arkit_depth.png", "iphone_lidar/image.jpg")),
}
"""A unit of 0: that of SUN RGB-D's files."""


def read_map(sensor: Sensor, depth: Path, photo: Path) -> Map:
    """Read a map, and its photo at the map's size."""
    values = (
        sunrgbd.read_depth(depth)[0].numpy() if sensor.unit == 0 else sensor.unit * np.squeeze(read_depth_file(depth))
    ).astype(np.float32)
    values[~(values > 0)] = np.nan
    grey = cv2.imread(str(photo), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise ValueError(f"{photo}: expected a photo")
    return Map(values, cv2.resize(grey, values.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32) / 255)


def simulate(kind: str, scenes: int, draws: int, *, wall: bool = False) -> Iterator[Map]:
    """Yield maps of a simulated sensor at the size of rendered scenes, or of a wall there, rounded to millimetres."""
    source = Procedural(count=scenes)
    for number, name in enumerate(source.scenes()):
        scene = source.load(name)
        assert scene.depth is not None  # noqa: S101 - rendered scenes have their depth
        values = scene.depth.float().reciprocal()
        if wall:
            values = values.nanmedian() * torch.linspace(1, 1.1, values.shape[-1]).expand_as(values)
        luma = scene.rgb.float().mean(dim=0, keepdim=True)
        for draw in range(draws):
            generator = torch.Generator().manual_seed(1000 * number + draw)
            depth = NOISES[kind](values, luma, generator).reciprocal()
            yield Map((1000 * depth[0]).round().numpy() / 1000, luma[0].numpy())


def residuals(depth: np.ndarray, size: int, most: int = 1500) -> np.ndarray:
    """Return relative residuals of inverse depth about planes, (n, size, size), in windows of which 95 % are known."""
    stride = max(size // 2, int(np.sqrt(depth.size / most)))
    windows = np.lib.stride_tricks.sliding_window_view(1 / depth, (size, size))[::stride, ::stride]
    values = windows.reshape(-1, size * size)
    values = values[np.isfinite(values).mean(axis=1) >= 0.95].astype(np.float64)
    if not len(values):
        return np.zeros((0, size, size))
    known = np.isfinite(values)
    values = np.where(known, values / np.nanmedian(values, axis=1, keepdims=True) - 1, 0)
    v, u = np.mgrid[:size, :size] / size
    basis, _ = np.linalg.qr(np.stack([np.ones(size * size), u.ravel(), v.ravel()], axis=1))
    for _ in range(3):
        plane = values @ basis @ basis.T
        values = np.where(known, values, plane)
    return np.where(known, values - plane, np.nan).reshape(-1, size, size)


def correlation_length(residual: np.ndarray) -> float:
    """Return the full width at half maximum of the autocorrelation of windows along rows and columns, pixels."""
    power, before = np.nanmean(residual**2), 1.0
    if power == 0:
        return np.nan
    for lag in range(1, residual.shape[1] // 2 + 1):
        along = np.nanmean(residual[:, :, lag:] * residual[:, :, :-lag])
        now = (along + np.nanmean(residual[:, lag:] * residual[:, :-lag])) / 2 / power
        if now < 0.5:
            return 2 * (lag - 1 + (before - 0.5) / (before - now))
        before = now
    return float(residual.shape[1])


def deviations(residual: np.ndarray) -> np.ndarray:
    """Return the standard deviations of windows, (n,)."""
    return np.sqrt(np.nanmean(residual**2, axis=(1, 2)))


def flattest(residual: np.ndarray) -> np.ndarray:
    """Return the flattest tenth of windows, at least six of them."""
    return residual[np.argsort(deviations(residual))[: max(6, len(residual) // 10)]]


def noise_of(depth: np.ndarray) -> tuple[float, float] | None:
    """Return a map's relative amplitude of noise and its correlation length, pixels; None where shape hides it."""
    best = last = None
    for size in WINDOWS:
        windows = residuals(depth, size) if size <= 0.6 * min(depth.shape) else np.zeros((0, 1, 1))
        if len(windows) < 6:
            break
        flat = flattest(windows)
        deviation = deviations(flat)
        amplitude = float(np.median(deviation))
        if amplitude > 0.02 or (last and last[1] > 2e-4 and amplitude > 1.05 * last[1] * (size / last[0]) ** 2):
            break
        if amplitude > 2e-4:
            length = correlation_length(flat / np.maximum(deviation, amplitude / 3)[:, None, None])
            if length <= size / 5:
                best = amplitude, length
        last = size, amplitude
    return best


def spectrum_slope(residual: np.ndarray) -> float:
    """Return the slope of the logarithm of a window's power over that of its frequency; 0 for white noise."""
    size = residual.shape[-1]
    taper = np.hanning(size)
    power = np.abs(np.fft.fft2(np.nan_to_num(residual) * taper * taper[:, None])) ** 2
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.fftfreq(size))
    rings = np.digitize(frequency, edges := np.geomspace(2 / size, 0.35, 8))
    means = [power[rings == ring].mean() + 1e-20 for ring in range(1, len(edges))]
    return float(np.polyfit(np.log(np.sqrt(edges[1:] * edges[:-1])), np.log(means), 1)[0])


def crossed(depth: np.ndarray) -> np.ndarray:
    """Return which shares of clear steps of depth are crossed within 1, 2 and 3 pixels, (n, 3)."""
    found = []
    for values in (1 / depth, 1 / depth.T):
        lines = np.lib.stride_tricks.sliding_window_view(values, 2 * REACH, axis=1).reshape(-1, 2 * REACH)
        jump = lines[:, -1] - lines[:, 0]
        middle = np.abs(lines[:, REACH] - lines[:, REACH - 1])
        with np.errstate(invalid="ignore"):
            clear = (np.abs(jump) > JUMP * np.minimum(lines[:, -1], lines[:, 0])) & np.isfinite(lines.sum(axis=1))
            flat = np.maximum(np.abs(lines[:, 2] - lines[:, 0]), np.abs(lines[:, -1] - lines[:, -3]))
            lines, jump, middle = (each[clear & (flat < 0.1 * np.abs(jump))] for each in (lines, jump, middle))
        lines = lines[middle >= np.abs(np.diff(lines, axis=1)).max(axis=1, initial=0) - 1e-12]
        jump = np.abs(lines[:, -1] - lines[:, 0])[:, None]
        changes = [np.abs(lines[:, reach:] - lines[:, :-reach]).max(axis=1) for reach in (1, 2, 3)]
        found.append(np.stack(changes, axis=1) / jump)
    return np.concatenate(found)


def hole_shares(values: Map) -> np.ndarray:
    """Return the share of holes up to 3, 10 and more pixels from a step, and on dark, medium, bright surfaces."""
    holes = np.isnan(values.depth)
    places = ndimage.distance_transform_edt(holes, return_distances=False, return_indices=True)
    filled = 1 / values.depth[tuple(places)]
    high, low = ndimage.maximum_filter(filled, 3), ndimage.minimum_filter(filled, 3)
    steps = high > (1 + JUMP) * low
    away = ndimage.distance_transform_edt(~steps) if steps.any() else np.full(holes.shape, np.inf)
    regions = [away <= 3, (away > 3) & (away <= 10), away > 10]
    regions += [values.luma < 0.15, (values.luma >= 0.15) & (values.luma < 0.6), values.luma >= 0.6]
    return np.array([holes[region].mean() if region.sum() > 50 else np.nan for region in regions])


class Statistics(NamedTuple):
    """What is measured of a group of maps; arrays of maps, windows, steps."""

    noise: np.ndarray
    windows: np.ndarray
    steps: np.ndarray
    holes: np.ndarray
    equal: np.ndarray
    gaps: np.ndarray


def measure(maps: Iterable[Map], flat: Iterable[Map]) -> Statistics:
    """Measure maps: noise (n, 2), of ``flat``; windows' deviation, length, slope; steps; holes; and values, mm."""
    noise = [noise_of(each.depth) or (np.nan, np.nan) for each in flat]
    windows, steps, holes, equal, gaps = [], [np.zeros((0, 3))], [], [], []
    for each in maps:
        found = residuals(each.depth, WINDOW)
        for residual in flattest(found) if len(found) else ():
            length = correlation_length(residual[None])
            windows.append((deviations(residual[None])[0], length, spectrum_slope(residual)))
        steps.append(crossed(each.depth))
        holes.append(hole_shares(each))
        known = np.isfinite(each.depth[:, 1:] + each.depth[:, :-1])
        equal.append((each.depth[:, 1:] == each.depth[:, :-1])[known].mean())
        gaps.append(1e3 * np.median(np.diff(np.unique(each.depth[np.isfinite(each.depth)]))))
    return Statistics(*(np.array(each) for each in (noise, windows or np.zeros((0, 3)))), np.concatenate(steps),
                      np.array(holes), np.array(equal), np.array(gaps))  # fmt: skip


def _range(values: np.ndarray, factor: float = 1.0, digits: int = 2, *, spread: bool = False) -> str:
    """Return a median, and the 5th to 95th percentile."""
    values = factor * values[np.isfinite(values)]
    if not len(values):
        return "-"
    low, middle, high = np.percentile(values, (5, 50, 95))
    return f"{middle:.{digits}f}" + (f" ({low:.{digits}f} to {high:.{digits}f})" if spread else "")


def _two_sample(real: np.ndarray, simulated: np.ndarray) -> str:
    """Return the two-sample statistic as text; nothing where a sample is empty."""
    both = [each[np.isfinite(each)] for each in (real, simulated)]
    return f"; {stats.ks_2samp(*both).statistic:.2f}" if min(map(len, both)) else ""


def print_tables(real: Mapping[str, Statistics], simulated: Mapping[str, Statistics]) -> None:
    """Print the tables, real sensors beside the simulated kind."""
    print("| map | amplitude, % | length, px | equal neighbours, % | gap, mm | holes, %: to 3, 10, more px from steps "
          "| dark, medium, bright |\n| --- | --- | --- | --- | --- | --- | --- |")  # fmt: skip
    for name, found in (*real.items(), *((f"simulated {kind}", each) for kind, each in simulated.items())):
        spread = name.startswith("simulated")
        amplitude, length = (
            _range(found.noise[:, 0], 100, spread=spread),
            _range(found.noise[:, 1], 1, 1, spread=spread),
        )
        holes = ["-" if np.isnan(each).all() else f"{100 * np.nanmean(each):.1f}" for each in found.holes.T]
        equal, gaps = _range(found.equal, 100, 0, spread=spread), _range(found.gaps, 1, 1, spread=spread)
        print(
            f"| {name} | {amplitude} | {length} | {equal} | {gaps} | {', '.join(holes[:3])} | {', '.join(holes[3:])} |"
        )
    columns = ("deviation, %", "length, px", "slope", *(f"step within {reach} px, %" for reach in (1, 2, 3)))
    print(f"\n| map; two-sample statistic | {' | '.join(columns)} |\n|{' --- |' * 7}")
    formats = ((100, 2), (1, 1), (1, 2), (100, 0), (100, 0), (100, 0))
    for kind, other in simulated.items():
        there = (*other.windows.T, *other.steps.T)
        for name in (name for name in real if SENSORS[name].kind == kind):
            here = (*real[name].windows.T, *real[name].steps.T)
            cells = [f"{_range(a, *form)}{_two_sample(a, b)}" for a, b, form in zip(here, there, formats, strict=True)]
            print(f"| {name} | {' | '.join(cells)} |")
        cells = [_range(each, *form, spread=True) for each, form in zip(there, formats, strict=True)]
        print(f"| simulated {kind} | {' | '.join(cells)} |")


def flattest_window(depth: np.ndarray) -> tuple[int, int, int]:
    """Return size, row and column of the flattest window of those of the largest size of which 95 % are known."""
    for size in (192, 96, 48):
        found = []
        for top in range(0, depth.shape[0] - size + 1, size // 4):
            for left in range(0, depth.shape[1] - size + 1, size // 4):
                for window in residuals(depth[top : top + size, left : left + size], size):
                    found.append((float(np.nanmedian(np.abs(window))), top, left))
        if found:
            return (size, *min(found)[1:])
    raise ValueError("no window of 48 pixels is known")


def panels_of(name: str, values: Map) -> list[Panel]:
    """Return photo, relit depth, residual about a plane and its spectrum in the flattest well-known window."""
    size, top, left = flattest_window(values.depth)
    place = np.s_[top : top + size, left : left + size]
    depth = torch.from_numpy(values.depth[place].astype(np.float64))[None]
    camera = Camera.from_fov(60, *values.depth.shape[::-1]).crop(top, left, size, size)
    relit = render_for_viewing(normals_seen_by(camera, depth))[0, 0].numpy()
    residual = residuals(values.depth[place], size)[0]
    power = (
        np.abs(np.fft.fftshift(np.fft.fft2(np.nan_to_num(residual) * np.hanning(size) * np.hanning(size)[:, None])))
        ** 2
    )
    spectrum = np.log10(power + 1e-20) - np.log10(power.max() + 1e-20)
    return [
        Panel(f"{name}, {size} pixels", np.repeat(values.luma[place][..., None], 3, axis=2)),
        Panel("relit", relit),
        Panel("residual, -2 to 2 %", np.clip(residual / 0.04 + 0.5, 0, 1)),
        Panel("its spectrum, 5 decades", np.clip(1 + spectrum / 5, 0, 1)),
    ]


def draw_sheets(path: Path, kinds: Iterable[str], maps: Mapping[str, list[Map]]) -> None:
    """Draw the first map of each real sensor above two simulated ones, a sheet for each kind; or these alone."""
    sheets: dict[Path, list[Panel]] = {}
    for kind in kinds:
        panels = sheets.setdefault(path.with_name(f"{kind}_{path.name}") if maps else path, [])
        for name in (name for name in maps if SENSORS[name].kind == kind):
            panels += panels_of(name, maps[name][0])
        for number, each in enumerate(simulate(kind, 3 if maps else 2, 2 if maps else 1)):
            panels += panels_of(f"simulated {kind} {number}", each)
    for each, panels in sheets.items():
        save_panels(each, panels, 4, width=192)


def main() -> None:
    """Measure, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, help="folder that holds real")
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--draws", type=int, default=4, help="simulated maps of a scene")
    parser.add_argument("--only", help="simulated kinds, separated by commas; all")
    parser.add_argument("--sheet", type=Path, help="a JPEG file; with --shared KIND_FILE beside it for each kind")
    options = parser.parse_args()
    kinds = options.only.split(",") if options.only else sorted({sensor.kind for sensor in SENSORS.values()})
    maps = {}
    for name, sensor in SENSORS.items() if options.shared else ():
        if sensor.kind in kinds:
            maps[name] = [read_map(sensor, *each) for each in sensor.files(options.shared / "real")]
            if not maps[name]:
                parser.error(f"--shared: expected maps of {name} in {options.shared / 'real'}, got none")
    if options.sheet:
        draw_sheets(options.sheet, kinds, maps)
    count = options.scenes, options.draws
    simulated = {kind: measure(simulate(kind, *count), simulate(kind, *count, wall=True)) for kind in kinds}
    print_tables({name: measure(each, each) for name, each in maps.items()}, simulated)


if __name__ == "__main__":
    main()

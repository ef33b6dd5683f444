"""Draw enlarged crops of real and simulated captures, rendered, to look at and for the documentation.

    python benchmarks/crops.py --shared DIR [--only NAME,...] [--methods bilateral,tgv,...] [--output DIR]
        [--device cpu]

Writes ``NAME.jpg`` for each capture: windows of the photo, the input, the methods' results and the truth where there
is one, all lit by e1, holes in pink. ``DIR`` holds ``real``, ``scenes``, ``weights/peers`` and ``simulate_phone.py``.
Below a method's name are its scores on the whole frame: the mean angle between normals, RMSE_v in 1/1000 and, for real
sensors, the share of the pixels that could be scored, see ``dsr.metrics.sensor``.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from captures import CAPTURES, Capture, run_method
from panel_grid import EMPTY, Panel, rendering_of_input, repeat_pixels, save_panels

from dsr.geometry.lights import FIGURE_LIGHT
from dsr.methods.recipe import read_recipe
from dsr.pictures.depth_views import rendering
from dsr.utils.ratios import round_ratio

METHODS = "bilateral,tgv,pgsr,msg_v,facets"
COLUMNS = 4
"""Panels of a row."""


def describe(capture: Capture, found: dict[str, float] | None) -> str:
    """Return scores as a line of text, with the line break before it; empty without scores."""
    if found is None:
        return ""
    text = f"\n{found['angle']:.1f}° / {1e3 * found['RMSE_v']:.0f}"
    return f"{text} / {100 * found['covered']:.0f} %" if capture.measured else text


def panels_of(capture: Capture, methods: list[str], shared: Path, device: str) -> list[Panel]:
    """Return the pictures of a whole capture: photo, input, results and truth, each (H, W) or (H, W, 3)."""
    sample = capture.sample
    size = (sample.camera.height, sample.camera.width)
    raw = capture.scores(sample.depth_lr) if sample.scale == 1 else None
    panels = [
        Panel("photo", sample.rgb.permute(1, 2, 0).numpy()),
        Panel("input" + describe(capture, raw), rendering_of_input(sample)),
    ]
    for name in methods:
        depth = run_method(capture, name, shared, device)
        caption = f"{read_recipe(name).label}{describe(capture, capture.scores(depth))}"
        panels.append(Panel(caption, rendering(depth, sample.camera)))
        print(f"  {caption}".replace("\n", ": "), flush=True)
    if capture.truth is not None:
        truth = rendering(capture.truth.depth, capture.truth.camera)
        panels.append(Panel("truth", repeat_pixels(truth, size)))
    return panels


def heading_of(name: str, capture: Capture) -> str:
    """Return the text above a picture."""
    sample = capture.sample
    sizes = (f"{camera.height} x {camera.width}" for camera in (sample.camera_lr, sample.camera))
    text = f"{name}: {' to '.join(sizes)} (x{round_ratio(sample.scale)}), surfaces lit by {FIGURE_LIGHT}, pink: holes"
    if capture.truth is None:
        return text
    share = " / share of pixels scored" if capture.measured else ""
    return f"{text}; whole frame: mean angle between normals / RMSE_v, 1/1000{share}"


def draw(name: str, capture: Capture, methods: list[str], shared: Path, output: Path, device: str) -> Path:
    """Write the picture of a capture."""
    panels = panels_of(capture, methods, shared, device)
    cropped: list[Panel] = []
    for window in capture.windows:
        row = [Panel(panel.caption, panel.picture[window.slices]) for panel in panels]
        cropped += row + [EMPTY] * (-len(row) % COLUMNS)
    path = output / f"{name}.jpg"
    save_panels(path, cropped, COLUMNS, heading_of(name, capture))
    return path


def main() -> None:
    """Draw the captures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shared", type=Path, default=Path(os.environ.get("DSR_SHARED", "../shared")))
    parser.add_argument("--only", default=",".join(CAPTURES), help="names of captures; all are the default")
    parser.add_argument("--methods", default=METHODS)
    parser.add_argument("-o", "--output", type=Path, default=Path("outputs/crops"))
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.only.split(","):
        if name not in CAPTURES:
            raise SystemExit(f"--only: expected some of {', '.join(CAPTURES)}, got {name}")
        capture = CAPTURES[name](options.shared)
        print(name, flush=True)
        methods = options.methods.split(",")
        print(draw(name, capture, methods, options.shared, options.output, options.device), flush=True)


if __name__ == "__main__":
    main()

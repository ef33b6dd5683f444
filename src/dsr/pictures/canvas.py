"""A figure whose pictures are placed in inches, how figures are written, and a row of pictures for a notebook."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from matplotlib.transforms import Bbox, TransformedBbox
from PIL import Image

from dsr.utils.files import replacing

HOLE_COLOUR = "#d684b4"
_DPI = 300  # of figures that are written twice
_PNG_LEVEL = 6  # compression of PNG files
_HEIGHT, _WIDTH, _GAP = 220, 320, 6  # pixels: the panels' largest size, and what lies between them
_QUALITY = 85


class Part(NamedTuple):
    """A rectangle of a picture in relative coordinates: 0 is the left or upper edge, 1 the right or lower edge."""

    left: float
    right: float
    top: float
    bottom: float

    def of(self, place: Bbox) -> Bbox:
        """Return where the part is of a picture that is drawn at a place."""
        x0, x1 = (place.x0 + at * place.width for at in (self.left, self.right))
        y1, y0 = (place.y1 - at * place.height for at in (self.top, self.bottom))
        return Bbox.from_extents(x0, y0, x1, y1)


def colours(name: str | Colormap) -> Any:
    """Return a colour map that shows NaN in the hole colour."""
    return mpl.colormaps.get_cmap(name).with_extremes(bad=HOLE_COLOUR)


class Canvas:
    """A figure with positions in inches from the lower left corner.

    All pictures are in one :class:`~matplotlib.axes.Axes` of the figure's size, as each further one takes long to make.
    """

    def __init__(self, width: float, height: float) -> None:
        self.figure = Figure(figsize=(width, height))
        FigureCanvasAgg(self.figure)
        self._pictures = self.figure.add_axes((0, 0, 1, 1), label="pictures", autoscale_on=False)
        self._pictures.set(xlim=(0, width), ylim=(0, height))
        self._pictures.set_axis_off()

    def text(self, x: float, y: float, text: str, **style: Any) -> None:
        """Write a text, none of which is taken as a formula."""
        width, height = self.figure.get_size_inches()
        self.figure.text(x / width, y / height, text, parse_math=False, **style)

    def show(
        self,
        place: Bbox,
        picture: np.ndarray,
        label: str = "",
        *,
        colour_map: str | Colormap = "gray",
        limits: tuple[float, float] | Normalize = (0.0, 1.0),
        within: Bbox | None = None,
        **style: Any,
    ) -> AxesImage:
        """Draw a picture: (H, W), NaN in holes, or (H, W, 3) in [0, 1]; what is not within a rectangle is cut off."""
        norm = limits if isinstance(limits, Normalize) else Normalize(*limits)
        extent = (place.x0, place.x1, place.y0, place.y1)
        image = self._pictures.imshow(
            picture, cmap=colours(colour_map), norm=norm, extent=extent, aspect="auto", label=label, **style
        )
        if within is not None:
            image.set_clip_box(TransformedBbox(within, self._pictures.transData))
        return image

    def bar(self, image: AxesImage, place: Bbox, label: str = "", *, most: int | None = None, **style: Any) -> Colorbar:
        """Draw the colour bar of a picture, with at most so many ticks."""
        if most is not None:
            style |= {"ticks": MaxNLocator(most), "format": ScalarFormatter(useOffset=False)}
        width, height = self.figure.get_size_inches()
        bounds = (place.x0 / width, place.y0 / height, place.width / width, place.height / height)
        return self.figure.colorbar(image, cax=self.figure.add_axes(bounds, label=label), **style)

    def frame(self, place: Bbox, label: str = "", **style: Any) -> None:
        """Draw a rectangle."""
        self._pictures.add_patch(Rectangle(place.p0, place.width, place.height, label=label, **style))


class Panels(Canvas):
    """Rows of panels, in the middle of which stand pictures of one ratio of height to width; all lengths in inches."""

    def __init__(
        self,
        shape: tuple[int, int],  # number of rows and columns
        aspect: float,  # of the pictures
        size: tuple[float, float],  # width and height of a panel
        across: tuple[float, float],  # left of the first column, and right of each one
        down: tuple[float, float, float],  # above the first row, between rows, and below the last one
    ) -> None:
        (rows, columns), self._aspect, (self._width, self._height) = shape, aspect, size
        (self._left, self._gap), (self._above, self._between, below) = across, down
        height = self._above + rows * self._height + (rows - 1) * self._between + below
        super().__init__(self._left + columns * (self._width + self._gap), height)

    def space(self, row: int, column: int) -> Bbox:
        """Return the space of a panel."""
        top = self.figure.get_figheight() - self._above - row * (self._height + self._between)
        left = self._left + column * (self._width + self._gap)
        return Bbox.from_bounds(left, top - self._height, self._width, self._height)

    def place(self, row: int, column: int) -> Bbox:
        """Return where the picture of a panel is."""
        space = self.space(row, column)
        width = min(space.width, space.height / self._aspect)
        height = width * self._aspect
        left, bottom = (space.x0 + space.x1 - width) / 2, (space.y0 + space.y1 - height) / 2
        return Bbox.from_bounds(left, bottom, width, height)

    def panel(self, row: int, column: int, picture: np.ndarray, title: str, **style: Any) -> AxesImage:
        """Draw a picture below its title."""
        place = self.place(row, column)
        self.text((place.x0 + place.x1) / 2, place.y1 + 0.08, title, fontsize=12, ha="center")
        return self.show(place, picture, **{"interpolation": "nearest", **style})

    def bar_below(
        self, image: AxesImage, row: int, columns: tuple[int, int], label: str, extend: str, height: float = 0.09
    ) -> None:
        """Draw a colour bar below the panels from one column to another."""
        left, right = self.space(row, columns[0]).x0, self.space(row, columns[1]).x1
        width = min(right - left, 1.6 * self._width) - 0.2 * self._width
        below = self.place(row, columns[1]).y0
        place = Bbox.from_bounds((left + right - width) / 2, below - 0.1 - height, width, height)
        self.bar(image, place, extend=extend, orientation="horizontal").set_label(label, labelpad=1)


def save_both(folder: Path, name: str, figure: Figure) -> list[Path]:
    """Write a figure as PNG, and as PDF with text as text and pictures not resampled, atomically; return the files."""
    paths = []
    for suffix, interpolation, metadata in ((".pdf", "none", {"CreationDate": None}), (".png", "auto", {})):
        for axes in figure.axes:
            for image in axes.images:
                image.set_interpolation(interpolation)
        paths.append(folder / f"{name}{suffix}")
        with mpl.rc_context({"pdf.fonttype": 42, "image.composite_image": False}):
            write_figure(paths[-1], figure, _DPI, metadata)
    return paths


def write_figure(
    path: Path, figure: Figure, dpi: int, metadata: Mapping[str, Any] | None = None, *, few_colours: bool = False
) -> None:
    """Write a figure atomically, in the format given by the suffix; a PNG of few colours has a table of 256 of them."""
    with replacing(path) as temporary, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")  # a name may have letters that the font lacks
        if path.suffix != ".png":
            figure.savefig(temporary, dpi=dpi, metadata=metadata)
            return
        canvas = FigureCanvasAgg(figure)
        figure.set_dpi(dpi)
        canvas.draw()
        opaque = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")  # 3 channels are written faster
        if few_colours:
            opaque = opaque.quantize(256)
        opaque.save(temporary, "PNG", compress_level=_PNG_LEVEL, dpi=(dpi, dpi))


def encode_row(panels: Sequence[np.ndarray]) -> bytes:
    """Return panels of one aspect in a row as a WebP, transparent between them.

    Panels are (H, W) grey or (H, W, 3) RGB in [0, 1] of any size, NaN in holes. Pixels of small ones are repeated.
    """
    height, width = panels[0].shape[:2]
    scale = min(_HEIGHT / height, _WIDTH / width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    opaque = np.full((size[1], size[0], 1), 255, np.uint8)
    shown = []  # the panels as RGBA of this size
    for panel in panels:
        colour = np.repeat(panel[..., None], 3, axis=2) if panel.ndim == 2 else panel
        pixels: Any = with_holes(colour).astype(np.float32)
        smaller = size[0] < pixels.shape[1]
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_NEAREST)
        shown.append(np.concatenate((np.round(255 * pixels.clip(0, 1)).astype(np.uint8), opaque), axis=2))
    gap = np.zeros((size[1], _GAP, 4), np.uint8)
    row = np.concatenate([each for panel in shown for each in (gap, panel)][1:], axis=1)
    done, content = cv2.imencode(".webp", row[..., [2, 1, 0, 3]], [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    if not done:
        raise OSError(f"the picture of {row.shape} could not be encoded")
    return content.tobytes()


def with_holes(picture: np.ndarray) -> np.ndarray:
    """Return an (H, W, 3) picture with the pixels that are not finite in the hole colour."""
    known = np.isfinite(picture).all(axis=2, keepdims=True)
    return np.where(known, picture, np.array(colours("gray").get_bad()[:3], picture.dtype))

"""Photos with a depth map in one HEIC file, as iPhones write in portrait mode, read by the package pillow-heif.

What the 8 bits of the map stand for is a message of HEVC (H.265, depth representation information), which libheif
reads: https://github.com/strukturag/libheif, libheif/api/libheif/heif.h. Apple's is mostly disparity in 1/m; its
calibration is XMP text of the map, of which pillow-heif has none and which is searched for in the file (tags of
https://exiftool.org/TagNames/XMP.html#apple_pdi and AVDepthData's documentation): the matrix is column by column, in
pixels of the reference size, of the picture before it is turned as its properties say. Relative accuracy is disparity
up to an unknown scale and shift.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dsr.io.cameras import turn_camera
from dsr.io.frames import CaptureFrame, Geometry, Source, accuracy_notes, stated
from dsr.io.pairs import Pair, PairingResult
from dsr.io.photos import decode_heic, open_heic, read_heic, turned_in_heic
from dsr.io.trajectories import intrinsics_camera
from dsr.notes import Assumption
from dsr.utils.guards import MOST_FILE, MOST_TEXT, numbers_in, read_limited

_APP = "HEIC"  # not the device in the EXIF data: the depth is of its two lenses or a network, not of its depth sensor
_INVERSE_DEPTH, _DISPARITY, _DEPTH = 0, 1, 2  # of HEVC's depth_representation_type


@dataclass(frozen=True)
class _HeicImage(Source):
    """The ``photo`` or the ``depth`` map of a HEIC file."""

    def read(self) -> np.ndarray:
        """Return (H, W, 3) uint8 RGB, or (h, w) float32 depth in metres, NaN where there is none."""
        if self.name == "photo":
            return read_heic(self.file)
        maps = [each for each in open_heic(self.file).info.get("depth_images", ()) if each is not None]
        if not maps:
            raise ValueError(f"{self.file}: expected a photo with a depth map, as of portrait mode; none can be read")
        values, metadata = decode_heic(self.file, maps[0]), maps[0].info["metadata"] or {}
        kind = metadata.get("representation_type")
        names = ("d_min", "d_max") if kind == _DISPARITY else ("z_near", "z_far")
        if kind not in (_INVERSE_DEPTH, _DISPARITY, _DEPTH) or not all(name in metadata for name in names):
            raise ValueError(f"{self.file}: expected a depth map with the range of its values, got {metadata!s:.120}")
        low, high = (float(metadata[name]) for name in names)
        share = values.astype(np.float64) / np.iinfo(values.dtype).max
        with np.errstate(all="ignore"):
            if kind == _INVERSE_DEPTH:
                low, high = (float(np.divide(1, each)) for each in (high, low))
            mapped = low + share * (high - low)
            depth = mapped if kind == _DEPTH else 1 / mapped
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan).astype(np.float32)


def read(path: Path) -> PairingResult:
    """Return the pair of a HEIC file."""
    content = read_limited(path, MOST_FILE)
    place = content.find(b"http://ns.apple.com/depthData/")  # in XMP text about the map, if there is some
    first, end = content.rfind(b"<x:xmpmeta", 0, max(place, 0)), content.find(b"</x:xmpmeta>", max(place, 0))
    xmp = content[first:end] if place >= 0 and first >= 0 and end - first <= MOST_TEXT and end >= 0 else b""
    sources = _HeicImage(path, "photo"), _HeicImage(path, "depth")
    frame = CaptureFrame(_APP, stated(_geometry, path, xmp), path, xmp, *sources)
    pair = Pair(path.stem, path, path / "depth", unit=1.0, capture=frame)
    return PairingResult((pair,), (Assumption("HEIC photos with depth maps of their own"),))


def _geometry(path: Path, xmp: bytes) -> Geometry:
    text = xmp.decode(errors="replace")
    accuracy = re.search(r"depthData:Accuracy\W{1,3}(\w+)", text)
    absolute = accuracy is not None and accuracy[1] == "absolute"
    notes = tuple(accuracy_notes(absolute=absolute, stated=accuracy is not None))
    matrix = re.search(r"depthData:IntrinsicMatrix>(.*?)</depthData:IntrinsicMatrix>", text, re.DOTALL)
    sides = dict(re.findall(r"depthData:IntrinsicMatrixReference(Width|Height)\W{1,3}(\d{1,6})\b", text))
    if matrix is None or len(sides) < 2:
        return Geometry(None, None, notes)
    values = numbers_in(re.findall(r"<rdf:li>\s*([^<\s]*)\s*</rdf:li>", matrix[1]))
    width, height = int(sides["Width"]), int(sides["Height"])
    if len(values) != 9 or min(width, height) < 1:
        raise ValueError(f"{path}: depthData:IntrinsicMatrix: expected 9 numbers, got {matrix[1].strip()!r:.60}")
    camera = intrinsics_camera(f"{path}: depthData:IntrinsicMatrix", (height, width), [values[n] for n in (0, 4, 6, 7)])
    return Geometry(turn_camera(camera, turned_in_heic(path)), None, notes)

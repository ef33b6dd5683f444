"""``dsr.Surface``: an upsampled depth map with its normals, renderings, points, mesh and expected errors."""

import functools
import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar, cast

import numpy as np
import torch
import trimesh
from torch import Tensor

from dsr.app.upsample.outputs import Result, ResultFolder
from dsr.app.upsample.parts import Results
from dsr.app.upsample.stored import write_scene
from dsr.geometry.camera import Camera
from dsr.geometry.lights import FIGURE_LIGHT, Direction, direction_of
from dsr.geometry.mesh import Mesh, triangulate, vertex_normals
from dsr.geometry.surface import render_for_viewing, shade
from dsr.inference.resizing import Plan
from dsr.io.exports import as_bytes, whole_normals
from dsr.io.files import python_messages
from dsr.io.inputs import Picture
from dsr.io.photos import data_url
from dsr.methods import base
from dsr.methods.base import MapNoise, Outliers
from dsr.notes import warn
from dsr.pictures.canvas import encode_row

Array = TypeVar("Array", np.ndarray, Tensor)
# options of `dsr upsample` that Surface.save takes
_OPTIONS = ("format", "max_error", "certain", "max_faces", "max_points", "keep", "overwrite")


class Points(NamedTuple):
    """Coloured points with normals: (N, 3) float32 in metres, (N, 3) uint8 sRGB, and (N, 3) float32 unit vectors."""

    points: np.ndarray
    colours: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True, repr=False, eq=False)
class Surface(Generic[Array]):
    """A depth map of the photo's size, as :class:`dsr.Upsampler` gives it.

    Maps are arrays (H, W), or tensors (1, H, W) on the device of the depth map if that was a tensor. Points, meshes
    and normals are in the camera's frame: x right, y down, z forward, in metres.

    Example:
        >>> import numpy as np
        >>> import dsr
        >>> camera = dsr.Camera.from_fov(60, width=64, height=48)
        >>> photo = np.full((48, 64, 3), 128, np.uint8)
        >>> surface = dsr.Upsampler("bicubic")(photo, np.full((12, 16), 1.5), camera)
        >>> surface
        Surface(64 x 48, 1.5 to 1.5 m, bicubic x4)
        >>> surface.depth.shape, surface.depth_error.shape, bool(surface.filled.any())
        ((48, 64), (48, 64), False)
        >>> float(surface.render("e4").mean().round(2))  # a wall that faces the light
        1.0
        >>> len(surface.mesh().faces), len(surface.points().points)
        (5922, 3072)

    """

    _picture: Picture
    _found: base.Surface
    _plan: Plan
    _seconds: float
    _device: torch.device | None

    @property
    def depth(self) -> Array:
        """Distance to the image plane in metres, float32, NaN where it is missing."""
        return self._give(self._found.depth)

    @property
    def depth_error(self) -> Array:
        """The absolute error of the depth that is to be expected at each pixel, in metres."""
        return self._give(self._found.depth_error)

    @property
    def angle_error(self) -> Array:
        """The angle between the normal and the true one that is to be expected at each pixel, in degrees."""
        return self._give(self._found.angle_error)

    @property
    def filled(self) -> Array:
        """Where there is depth that was not measured, bool."""
        return self._give(self._found.filled)

    @property
    def noise(self) -> MapNoise | None:
        """The noise of the depth map that was given; None for a method that does not estimate it."""
        return self._found.noise

    @property
    def outliers(self) -> Outliers | None:
        """What of the depth map that was given was treated as holes."""
        return self._found.outliers

    @property
    def glass(self) -> float | None:
        """The share of the pixels that are probably glass, mirrors or gloss; None of a map told to be clean."""
        return self._found.glass

    @property
    def photo(self) -> Array:
        """The photo: (H, W, 3) uint8 as an array, (3, H, W) float32 in [0, 1] as a tensor."""
        rgb = self._picture.rgb
        return cast("Array", as_bytes(rgb).transpose(1, 2, 0) if self._device is None else rgb.to(self._device))

    @property
    def camera(self) -> Camera:
        """The camera of the photo, and of all maps here."""
        return self._picture.camera

    def normals(self) -> Array:
        """Return the unit normals, which face the camera, NaN in holes: (H, W, 3) float32, or a tensor (3, H, W)."""
        normals = self._normals
        return cast("Array", normals.numpy().transpose(1, 2, 0) if self._device is None else normals.to(self._device))

    def render(self, light: str | Direction | Sequence[float] = FIGURE_LIGHT) -> Array:
        """Return the surface without its colours, under one light: clipped Lambertian shading.

        Args:
            light: one of the paper's four, ``e1`` to ``e4``; or the direction from the surface to the light, of any
                length, such as (0, -1, -1) for one above the camera.

        Returns:
            In [0, 1], NaN in holes.

        Raises:
            ValueError: there is no such light, or the direction has no length.

        """
        if isinstance(light, str):
            direction = list(direction_of(light))
        else:
            try:
                given = np.asarray(light, np.float64)
            except (TypeError, ValueError):
                given = np.empty(0)
            length = float(np.linalg.norm(given))
            if given.shape != (3,) or not 0 < length < np.inf:
                raise ValueError(f"light: expected a name, or three numbers that are not all 0, got {light!r:.60}")
            direction = (given / length).tolist()
        shaded = shade(self._normals[None], torch.tensor([direction], dtype=self._normals.dtype))
        return self._give(shaded[0].clamp(0, 1))

    def points(self, max_error: float | None = Results.max_error) -> Points:
        """Return the pixels as points, as ``dsr upsample`` writes them to ``cloud.ply``.

        Args:
            max_error: pixels whose depth is expected to be off by more are left out, percent of it; None for none.

        Raises:
            ValueError: no pixel is left.

        """
        mesh = triangulate(self._certain(max_error), self.camera, isolated=True)
        return Points(mesh.vertices, self._colours(mesh), vertex_normals(mesh))

    def mesh(self, max_error: float | None = Results.max_error) -> trimesh.Trimesh:
        """Return the surface as triangles with the photo's colours, cut at depth steps, at full density.

        ``dsr upsample --keep all`` writes the same to ``mesh.ply``, with fewer triangles if there are very many.

        Args:
            max_error: see :meth:`points`.

        Raises:
            ValueError: no two neighbours are left.

        """
        mesh = triangulate(self._certain(max_error), self.camera)
        if not len(mesh.faces):
            raise ValueError("mesh: expected neighbours of known depth to make a surface of, got none")
        normals, colours = vertex_normals(mesh), self._colours(mesh)
        return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=normals, vertex_colors=colours, process=False)

    def save(self, folder: str | os.PathLike[str], parts: Sequence[str] | None = None, **options: Any) -> list[Path]:
        """Write the files of ``dsr upsample``, for ``dsr view``, ``dsr fuse`` and other programs; see docs/results.md.

        Args:
            folder: is made if need be. To a folder of this surface parts are added; any other is refused.
            parts: some of its parts, such as ``["depth", "mesh"]``; None for the usual ones.
            **options: of the command, by their names: ``format``, ``max_error``, ``certain``, ``max_faces``,
                ``max_points``, ``keep``, ``overwrite``.

        Returns:
            The files.

        Raises:
            ValueError: there is no such part or option, nothing can be made of the surface, or a file is in the place
                of another.

        """
        with python_messages():
            if unknown := sorted(options.keys() - set(_OPTIONS)):
                raise ValueError(f"save: expected some of {', '.join(_OPTIONS)}, got {', '.join(unknown)}")
            wanted = Results(output=Path(folder), only=None if parts is None else tuple(parts), **options)
            content = hashlib.sha256(self._found.depth.numpy().tobytes() + as_bytes(self._picture.rgb).tobytes())
            inputs = {"surface": {"sha256": content.hexdigest()}}  # which a folder of results has for its inputs
            path, limit = wanted.output, wanted.max_error / 100
            results = ResultFolder(path, inputs, {"max_error": limit}, wanted)
            results.expect_agreement("take another folder, or overwrite=True")
            results.expect_free()
            found = self._found.without_dubious(limit) if wanted.certain else self._found
            notes = results.store(Result(self._picture, found, self._plan, wanted), {"upsampling": self._seconds})
            warn(note for note in notes if note.code)
            files = [path / name for name in results.earlier["files"]]
            if wanted.of_all:
                exports, problems = write_scene(path, {path.name: path}, wanted.of_all, overwrite=wanted.overwrite)
                if problems:
                    raise ValueError(problems[0])
                files += exports.values()
            return files

    def __repr__(self) -> str:
        size = f"{self.camera.width} x {self.camera.height}"
        return f"Surface({size}, {self._range()}, {self._plan.method} x{self._plan.scale})"

    def _range(self) -> str:
        known = self._found.depth[self._found.depth.isfinite()]
        return f"{known.min():.3g} to {known.max():.3g} m" if len(known) else "nothing known"

    def _repr_html_(self) -> str:
        """Return the photo, the depth map that was given, and the surface, both under a light, for a notebook."""
        before = self._picture.depth_lr
        view = self.camera.rescale(before.shape[-1], before.shape[-2])
        normals = whole_normals(before, view), self._normals
        tones: list[np.ndarray] = [render_for_viewing(each[None])[0, 0].numpy() for each in normals]
        content = encode_row([self._picture.rgb.permute(1, 2, 0).numpy(), *tones])
        error = float(self._found.depth_error.nanmedian()) if self._found.depth_error is not None else float("nan")
        size = f"{self.camera.width} x {self.camera.height}"
        about = (
            f"photo; depth as given, {view.width} x {view.height}; surface, {size}: {self._range()}, "
            f"&plusmn; {1e3 * error:.2g} mm (median), by {escape(self._plan.method)}"
        )
        about += "; pink: holes" if bool(before.isnan().any() or self._found.depth.isnan().any()) else ""
        source = data_url(content, "webp")
        return (
            f'<figure style="margin:0"><img src="{source}" alt="{about}" style="max-width:100%">'
            f'<figcaption style="font-size:85%">{about}</figcaption></figure>'
        )

    @functools.cached_property
    def _normals(self) -> Tensor:
        """The normals, (3, H, W)."""
        return whole_normals(self._found.depth, self.camera)

    def _certain(self, max_error: float | None) -> Tensor:
        """Return the depth, (1, H, W), without pixels that are likely to be wrong."""
        if max_error is None:
            return self._found.depth
        depth = self._found.without_dubious(max_error / 100).depth
        if not bool(depth.isfinite().any()):
            raise ValueError(f"max_error: expected a percentage that leaves pixels, got {max_error}")
        return depth

    def _colours(self, mesh: Mesh) -> np.ndarray:
        return as_bytes(self._picture.rgb.flatten(1)[:, torch.from_numpy(mesh.pixels)]).T

    def _give(self, values: Tensor | None) -> Array:
        """Return a map, (1, H, W), as the depth map was given."""
        assert values is not None  # noqa: S101 - AnyRatio estimates what a method does not say
        return cast("Array", values[0].numpy().copy() if self._device is None else values.to(self._device, copy=True))

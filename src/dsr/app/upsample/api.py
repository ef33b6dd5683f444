"""``dsr.upsample`` and ``dsr.Upsampler``: what the command computes, from Python."""

import functools
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from dsr.app.upsample.arrays import picture_of, pictures_of
from dsr.app.upsample.checks import align
from dsr.app.upsample.frames import nearest, prepare, view_of, vote, without_repeats
from dsr.app.upsample.outputs import as_stored
from dsr.app.upsample.surface import Array, Surface
from dsr.geometry.camera import Camera
from dsr.inference import DEFAULT, WIDEST, Fill
from dsr.inference.any_ratio import upsampler
from dsr.inference.resizing import size_of
from dsr.inference.sequences import View
from dsr.inference.steady import Steady
from dsr.io.cameras import doubt_camera, doubt_depth
from dsr.io.files import python_messages
from dsr.io.inputs import Picture
from dsr.methods import base
from dsr.notes import warn
from dsr.utils.guards import naming
from dsr.utils.progress import Steps

Maps = TypeVar("Maps", np.ndarray, Tensor, list[Any])


def upsample(
    rgb: Any,
    depth: Maps,
    camera: Camera | list[Camera],
    scale: int | None = None,
    *,
    mask: Any = None,
    unit: str | float | None = None,
    progress: Steps | None = None,
    **how: Any,
) -> Maps:
    """Upsample a depth map to the photo's resolution, or a batch of them.

    The depth map has to be registered to the photo: the same view and the same field of view, at any size up to the
    photo's, with holes or without. Weights come with the package. A warning says what can hardly be right, such as a
    photo of another view.

    A batch is lists of photos and depth maps, or arrays and tensors with an axis in front. One camera is that of all.

    Args:
        rgb: the photo: an array (H, W, 3) of any strides, a tensor (3, H, W) on any device, or a picture of PIL; 8 or
            16 bits, or floats from 0 to 1.
        depth: distance to the image plane, (h, w), a tensor may be (1, h, w): floats in metres, NaN in holes; or the
            values of a file, with their ``unit``.
        camera: the photo's, in its pixels: ``dsr.Camera``.
        scale: the upsampling factor; None to choose it by the sizes. ``facets`` refines a depth map that already has
            the photo's size as it is; for a given scale, and for other networks, it is first averaged over blocks of
            scale x scale pixels, 4 x 4 for None.
        mask: valid mask of the depth's shape, for maps whose holes are not marked.
        unit: of the depth's values, see :func:`dsr.read_depth`; holes are 0, NaN, infinity or the largest whole number
            then, as in files.
        progress: a function that is called with the number of parts done and their total.
        **how: the other arguments of :class:`Upsampler`.

    Returns:
        Depth in metres, float32, NaN in holes, of the kind of ``depth``: an array (H, W), a tensor (1, H, W) on its
        device, or for a batch a list, or (B, H, W) and (B, 1, H, W).

    Raises:
        ValueError: a shape, value, method, setting or scale is not as above, or the method has no solution.

    Example:
        A disc in front of a wall, as a low-resolution sensor sees it:

        >>> import numpy as np
        >>> import dsr
        >>> rows, columns = np.mgrid[0:64, 0:96]
        >>> inside = (rows - 32) ** 2 + (columns - 48) ** 2 < 20**2
        >>> photo = np.where(inside[..., None], [200, 120, 80], [60, 70, 90]).astype(np.uint8)
        >>> depth_lr = np.where(inside, 1.0, 2.0).reshape(16, 4, 24, 4).mean(axis=(1, 3))
        >>> depth_lr[3, 5] = np.nan  # a hole
        >>> camera = dsr.Camera.from_fov(60, width=96, height=64)
        >>> depth_hr = dsr.upsample(photo, depth_lr, camera, scale=4)
        >>> depth_hr.shape, bool(np.isfinite(depth_hr).all())
        ((64, 96), True)
        >>> float(depth_hr[32, 48].round(1)), float(depth_hr[2, 2].round(1))
        (1.0, 2.0)
        >>> stored = np.nan_to_num(1000 * depth_lr).astype(np.uint16)  # as files have it
        >>> dsr.upsample([photo, photo], [stored, stored], camera, unit="mm", method="bicubic")[1].shape
        (64, 96)

    """
    run, given = Upsampler(scale=scale, **how), cast("Any", depth)
    several = isinstance(rgb, list | tuple) or isinstance(given, list | tuple) or getattr(rgb, "ndim", 0) == 4
    if not several:
        return cast("Maps", run(rgb, given, cast("Camera", camera), mask=mask, unit=unit, progress=progress).depth)
    found = []
    for number, each in enumerate(pictures_of(rgb, given, camera, mask)):
        with naming(f"picture {number} of the batch"):
            found.append(run(**each, unit=unit, progress=progress).depth)
    if isinstance(given, list | tuple):
        return found  # type: ignore[return-value]
    if not found:
        raise ValueError("rgb, depth: expected a batch of one picture at least, got none")
    return cast("Maps", torch.stack(found) if isinstance(given, Tensor) else np.stack(found))


class Upsampler:
    """A method that loads its weights once, for many pictures or the frames of a camera.

    It computes what ``dsr upsample`` does. Calls from several threads take turns; other processes may get it pickled.

    Args:
        method: ``facets``; or any other method in ``conf/method``, such as ``msg_v``, ``tgv``, ``guided_filter``,
            ``bicubic``, and ``dip_v``, which takes minutes.
        scale: see :func:`upsample`.
        device: ``auto`` for a GPU if there is one; or ``cpu``, ``cuda``, ``cuda:1``.
        fill: which holes are filled: ``all``, only ``small`` ones, or ``none``. The others stay NaN.
        max_hole: width of the widest hole that counts as small, in degrees of view; one of 5 pixels always does.
        working_size: by what ``facets`` divides the map's size first, 1, 2, 4, 8 or 16; None as its noise suggests.
        sensor: what measured the depth, such as ``RealSense D435``; ``auto`` by its values, ``none`` for none.
        register: whether to move the depth map to the photo's edges, if it lies beside them.
        **settings: the method's arguments, by their names in its file in ``conf/method``, such as ``noise=0.002`` of
            ``facets``, the standard deviation of the map's noise in metres, if it is known.

    Raises:
        ValueError: a method is not as there; settings and scale are checked with the first picture.

    Example:
        >>> import numpy as np
        >>> import dsr
        >>> upsampler = dsr.Upsampler("bicubic")
        >>> camera = dsr.Camera.from_fov(60, width=32, height=24)
        >>> for metres in (1.0, 2.0):
        ...     surface = upsampler(np.zeros((24, 32, 3), np.uint8), np.full((12, 16), metres), camera)
        ...     print(f"{surface.depth.mean():.1f} m")
        1.0 m
        2.0 m

    """

    def __init__(
        self,
        method: str = DEFAULT,
        scale: int | None = None,
        *,
        device: str = "auto",
        fill: Fill = "small",
        max_hole: float = WIDEST,
        working_size: int | None = None,
        sensor: str = "auto",
        register: bool = False,
        **settings: Any,
    ) -> None:
        self._run = upsampler(
            method, scale, settings=settings, device=device, fill=fill, max_hole=max_hole, working_size=working_size
        )
        self._sensor, self._register = sensor, register
        self._lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {name: each for name, each in vars(self).items() if name != "_lock"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, _lock=threading.Lock())

    def __call__(
        self,
        rgb: Any,
        depth: Array,
        camera: Camera,
        *,
        mask: Any = None,
        unit: str | float | None = None,
        progress: Steps | None = None,
        steady: Steady | None = None,
    ) -> Surface[Array]:
        """Upsample a depth map; the arguments are those of :func:`upsample`, for one picture, and of :meth:`stream`."""
        with python_messages():
            picture, device = _read(rgb, depth, camera, mask=mask, unit=unit)
            return self._upsample(picture, device, progress=progress, steady=steady)

    def stream(
        self, frames: Iterable[tuple[Any, ...]], *, neighbours: int = 4, unit: str | float | None = None,
        steady: Steady | None = None,
    ) -> Iterator[Surface[Any]]:  # fmt: skip
        """Yield the surface of each frame, as they come.

        Frames with a pose are fused with their neighbours before, as ``dsr upsample --poses --neighbours`` does, which
        lessens noise: a surface is there when the neighbours after it were read.

        Args:
            frames: (rgb, depth, camera) each, or (rgb, depth, camera, pose): the arguments of :func:`upsample`, and the
                transform from the camera's frame (x right, y down, z forward) to the world's, 4 x 4, metres; None for a
                frame without one. The depth marks its holes. Whether photos and depth fit each other is looked at in
                the first one. A frame without any measurement has a surface without depth.
            neighbours: number of frames that vote on each frame's depth, 4 for two on either side; 0 for none.
            unit: of the depth's values, see :func:`upsample`.
            steady: ``dsr.inference.Steady()`` averages successive surfaces of a camera that stands still.

        Raises:
            ValueError: as of :func:`upsample`, with the number of the frame.

        Example:
            >>> import numpy as np
            >>> import dsr
            >>> camera = dsr.Camera.from_fov(60, width=32, height=24)
            >>> photo, stored = np.zeros((24, 32, 3), np.uint8), np.full((12, 16), 1500, np.uint16)
            >>> frames = ((photo, stored, camera, np.eye(4)) for _ in range(3))
            >>> [f"{s.depth.mean():.1f} m" for s in dsr.Upsampler("bicubic").stream(frames, unit="mm")]
            ['1.5 m', '1.5 m', '1.5 m']

        """
        if neighbours < 0:
            raise ValueError(f"neighbours: expected 0 or a positive number of frames, got {neighbours!r}")
        return self._stream(frames, neighbours, unit, steady)

    def _stream(
        self, frames: Iterable[tuple[Any, ...]], neighbours: int, unit: str | float | None, steady: Steady | None
    ) -> Iterator[Surface[Any]]:
        """Yield surfaces; frames are read ahead for those before them, and their errors wait for their own turn."""
        source, place = enumerate(frames), 0
        kept: dict[int, tuple[Picture, torch.device | None] | ValueError] = {}
        views: dict[int, View] = {}  # of the frames that may vote

        def read_up_to(last: int) -> None:
            while max(kept, default=place - 1) < last and (following := next(source, None)) is not None:
                number, frame = following
                try:
                    picture, _ = kept[number] = _read_frame(frame, number, unit)
                except ValueError as error:
                    kept[number] = error
                    continue
                if picture.pose is not None and not _is_empty(picture):
                    views[number] = view_of(picture, picture.pose)

        while True:
            read_up_to(place)
            given = kept.get(place)
            if given is None:
                return
            if isinstance(given, ValueError):
                raise given
            picture, device = given
            voting: list[View] | None = None
            if neighbours and picture.pose is not None:
                read_up_to(place + max(neighbours - place, -(-neighbours // 2)))
                near = nearest(place, max(kept) + 1, neighbours, views.__contains__)
                voting = [views[number] for number in near]
            with naming(f"frame {place}"), python_messages():
                surface = self._upsample(picture, device, voting, look=place == 0, steady=steady)
            yield surface
            place += 1
            kept.pop(place - neighbours - 1, None)
            views.pop(place - neighbours - 1, None)

    def _upsample(
        self,
        picture: Picture,
        device: torch.device | None,
        voting: Sequence[View] | None = None,
        progress: Steps | None = None,
        *,
        look: bool = True,
        steady: Steady | None = None,
    ) -> Surface[Any]:
        """Return the surface of a picture on whose depth others vote; ``look`` whether photo and depth fit."""
        size, size_lr = size_of(picture.rgb), size_of(picture.depth_lr)
        if _is_empty(picture):  # then nothing is known of its holes
            holes = torch.full((1, *size), torch.nan)
            found = base.Surface(holes, holes, holes, filled=torch.zeros_like(holes, dtype=torch.bool))
            return Surface(picture, found, self._run.plan(size, size_lr), 0.0, device)
        fuse = (lambda each: each) if voting is None else functools.partial(vote, views=voting, count=len(voting))
        picture, sensor = prepare(picture, self._sensor, fuse)
        planned = self._run.plan(size, size_lr)  # which refuses sizes before anything is looked at
        if look:
            view = picture.camera.rescale(size_lr[1], size_lr[0])
            doubts = [*doubt_camera(picture.camera, "camera", size_lr),
                      *doubt_depth(picture.depth_lr, view, "orthogonal")]  # fmt: skip
            picture = replace(picture, assumptions=(*picture.assumptions, *doubts))
        if look or self._register:
            picture = align(picture, register=self._register)
        warn(note for note in picture.assumptions if note.code)
        started = time.perf_counter()
        with self._lock:
            found = as_stored(self._run.upsample(picture.rgb, picture.depth_lr, picture.camera, progress, sensor))
        if steady is not None:
            found = as_stored(steady.average(found, picture.rgb))
            steady.remember(found, picture.rgb)
        return Surface(picture, found, planned, time.perf_counter() - started, device)


def _is_empty(picture: Picture) -> bool:
    """Return whether a depth map has no measurement."""
    return bool(picture.depth_lr.isnan().all())


def _read(rgb: Any, depth: Any, camera: Any, **further: Any) -> tuple[Picture, torch.device | None]:
    """Return a user's arguments as a picture, and the device of the depth map if that is a tensor."""
    picture = picture_of(rgb, depth, camera, **further)
    device = depth.device if isinstance(depth, Tensor) else None
    return picture if _is_empty(picture) else without_repeats(picture), device


def _read_frame(frame: Any, number: int, unit: str | float | None) -> tuple[Picture, torch.device | None]:
    """Return a frame of a stream, see :func:`_read`."""
    with naming(f"frame {number}"), python_messages():
        if not isinstance(frame, tuple | list) or len(frame) not in (3, 4):
            came = f"{len(frame)} of them" if isinstance(frame, tuple | list) else type(frame).__name__
            raise ValueError(f"expected (rgb, depth, camera) or (rgb, depth, camera, pose), got {came}")
        rgb, depth, camera, pose = (*frame, None)[:4]
        return _read(rgb, depth, camera, unit=unit, pose=pose, empty=True)

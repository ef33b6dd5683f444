"""The commands behind ``dsr view`` and ``dsr fuse``: one page, or one mesh, of results of ``dsr upsample``."""

import itertools
import math
import webbrowser
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from dsr.app.requests import FuseRequest, ViewRequest
from dsr.app.upsample.parts import ERRORS
from dsr.app.upsample.stored import (
    INFO,
    find_results,
    read_camera,
    read_complete,
    read_depth,
    read_result,
)
from dsr.geometry.mesh import FusedMesh, fuse_maps, suggest_voxel
from dsr.geometry.poses import PosedMap, as_rigid, check_poses, visible
from dsr.io.exports import INPUT, read_input, world_comment, write_glb, write_ply
from dsr.io.images import read_pixels
from dsr.io.posed_frames import read_errors
from dsr.io.scene_files import RGBD
from dsr.notes import Assumption, expect_no_warning
from dsr.report.surface_page import Packed, is_view, pack_result, save_view
from dsr.utils.console import ConsoleProgress, one_line, show
from dsr.utils.files import expect_target
from dsr.utils.guards import naming, natural_key, refusing_excess
from dsr.utils.progress import megabytes, show_length

_WHOLE_PAGE = 6  # the page has at most this many times the vertices of one surface
_PHOTO, _SMALL_PHOTO, _FEW = 2048, 1024, 4  # pixels of the photos' longer side on pages of few results, and of more
_GREY = 190
_SEEN = 2.0  # voxels between a point and a frame's depth up to which the frame sees it
_VIEWS = 5  # successive results over which distances are compared
_LEAST_ERROR = 1e-4  # smallest expected error in metres that a weight distinguishes


def view(request: ViewRequest, console: Console) -> list[str]:
    """Write the page and open it; return the problems of results that cannot be read, one line each."""
    page = request.page or request.output / "view.html"
    expect_target(page)
    if page.exists() and not (page.is_file() and is_view(page)):
        raise ValueError(f"{page}: is there already and no page of `dsr view`; take another -o")
    folders = find_results(request.output)
    places = np.linspace(0, len(folders) - 1, min(len(folders), request.most)).round()
    chosen = [folders[at] for at in np.unique(places.astype(int))]
    packed, problems = _pack(request, chosen, console)
    if not packed:
        raise ValueError("; ".join(problems))
    notes = []
    if len(chosen) < len(folders):
        notes.append(f"{len(chosen)} of {len(folders)} results, taken at equal distances; --most N shows more.")
    if problems:
        notes.append(f"{len(problems)} of {len(chosen)} results could not be read and are left out.")
    name = request.output.resolve().name
    save_view(page, packed, title=f"{name}: depth before and after", notes=notes)
    for note in notes:
        show(console, f"  {note}")
    largest, factors = max(each.vertices for each in packed), sorted({each.about["after"]["factor"] for each in packed})
    reduced = "" if factors == [1] else f", maps reduced by {' or '.join(map(str, factors))} each way"
    size = megabytes(page.stat().st_size)
    show(console, f"{_count(packed)}, at most {largest:,} vertices each{reduced}, {size} -> {page}")
    if request.open_page and not webbrowser.open(page.resolve().as_uri()):
        show(console, "there is no browser to open it with; open it yourself, or copy it to where there is one")
    return problems


def _pack(request: ViewRequest, folders: Sequence[Path], console: Console) -> tuple[list[Packed], list[str]]:
    each = min(request.vertices, _WHOLE_PAGE * request.vertices // len(folders))
    photo_side = _PHOTO if len(folders) <= _FEW else _SMALL_PHOTO
    packed: list[Packed] = []
    problems: list[str] = []
    for folder in ConsoleProgress(console).track(folders, "read", label=lambda path: path.name, lines=False):
        name = "/".join(folder.relative_to(request.output).parts) or request.output.resolve().name
        try:
            with refusing_excess():
                packed.append(pack_result(read_result(folder, name), each, photo_side))
        except (ValueError, OSError) as error:
            problems.append(one_line(error))
    return packed, problems


def fuse(request: FuseRequest, console: Console) -> list[str]:
    """Fuse the depth of results into a mesh, and return the problems, one line each."""
    max_error = request.max_error / 100
    recordings: dict[Path, list[Path]] = {}
    problems: list[str] = []
    for folder in sorted({each for place in request.folders for each in find_results(place)}, key=natural_key):
        try:
            _load(folder, max_error)
            recordings.setdefault(folder.parent, []).append(folder)
        except (ValueError, OSError) as error:
            problems.append(one_line(error))
    frames = sorted(itertools.chain(*recordings.values()), key=natural_key)
    if not frames:
        raise ValueError(f"expected results of `dsr upsample` with poses; {problems[0]}")

    def fault(recording: Sequence[Path]) -> Assumption | None:
        return check_poses(len(recording), lambda number: _load(recording[number], max_error))

    warnings = [each for each in dict.fromkeys(map(fault, recordings.values())) if each is not None]
    if request.strict:
        expect_no_warning(str(request.folders[0]), warnings)
    for each in warnings:
        show(console, str(each))

    def maps() -> Iterator[PosedMap]:
        return (_load(folder, max_error) for folder in frames)

    with naming(f"{frames[0]}{' and others' if len(frames) > 1 else ''}"):
        voxel = suggest_voxel(maps()) if request.voxel is None else request.voxel
        mesh = fuse_maps(maps, voxel)
    colours = _colours(mesh.vertices, frames, max_error, _SEEN * voxel, problems)
    ups = {read_complete(folder)["up"] for folder in frames}
    frame = _write(request.output, mesh, colours, ups.pop() if len(ups) == 1 else "")
    size = f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles, voxels of {show_length(voxel)}"
    show(console, f"{_count(frames)} -> {request.output}: {size}; in {frame}")
    if request.score:
        from dsr.metrics.temporal import opw, rsd  # noqa: PLC0415 - torchmetrics, which takes a second

        known = _scores(recordings.values(), max_error, opw, 2, 1)
        mean = show_length(float(np.mean(known))) if known else "nan"
        show(console, f"successive results differ by {mean}, {len(known)} pairs of a view in common (OPW)")
        known = _scores(recordings.values(), max_error, rsd, _VIEWS, _VIEWS)
        spread = f"{100 * np.mean(known):.2f} %" if known else "nan"
        show(console, f"distances of points spread by {spread} of their mean (RSD)")
    return problems


def _write(path: Path, mesh: FusedMesh, colours: np.ndarray, up: str) -> str:
    """Write a mesh, and return what its axes are."""
    if path.suffix.lower() == ".glb":
        write_glb(path, mesh.vertices, mesh.normals, mesh.faces, colours=colours, up=up)
        return "glTF's axes"
    write_ply(path, mesh.vertices, colours, mesh.normals, mesh.faces, frame=world_comment(up))
    return "the world's frame of the poses"


def _count(results: Sequence[object]) -> str:
    return "1 result" if len(results) == 1 else f"{len(results)} results"


def _scores(
    recordings: Iterable[Sequence[Path]], max_error: float, metric: Callable[..., Tensor], views: int, step: int
) -> list[float]:
    """Return a metric of each group of so many successive results of one camera, where it has a value."""
    found = []
    for recording in recordings:
        for start in range(0, len(recording) - 1, step):
            group = [_load(folder, max_error) for folder in recording[start : start + views]]
            if len({each.camera for each in group}) == 1:
                depths = torch.from_numpy(np.stack([each.depth for each in group]))[:, None]
                found.append(float(metric(depths, group[0].camera, [each.pose for each in group])))
    return [each for each in found if not math.isnan(each)]


def _load(folder: Path, max_error: float) -> PosedMap:
    path, info = folder / INFO, read_complete(folder)
    if info.get("pose") is None:
        raise ValueError(f"{path}: expected a pose; run `dsr upsample` on a capture with poses, or with --poses")
    camera = read_camera(folder, info)
    depth = read_depth(folder, camera).astype(np.float64)
    deviation = None
    if (folder / ERRORS).is_file():
        deviation = np.maximum(read_errors(folder / ERRORS, camera)[0].astype(np.float64), _LEAST_ERROR)
        with np.errstate(invalid="ignore"):
            depth = np.where(deviation <= max_error * depth, depth, np.nan)
    return PosedMap(depth, camera, as_rigid(info["pose"], f"{path}: pose"), deviation)


def _colours(
    vertices: np.ndarray, frames: Sequence[Path], max_error: float, near: float, problems: list[str]
) -> np.ndarray:
    """Return the mean colour of points at most ``near`` metres from frames' depth, (N, 3) uint8; grey without photo."""
    total, weight = np.zeros(vertices.shape), np.zeros(len(vertices))
    for folder in frames:
        path, photo = folder / "rgbd" / RGBD[0], None
        try:
            if (folder / INPUT).is_file():
                photo = read_input(folder / INPUT)[0]
            elif path.is_file():
                photo = read_pixels(path, cv2.IMREAD_COLOR)[..., ::-1]
        except (ValueError, OSError) as error:
            problems.append(one_line(error))
            continue
        if photo is None:
            continue
        depth, camera, pose, _ = _load(folder, max_error)
        places, pixels, z = visible(vertices, camera, pose)
        columns, rows = np.rint(pixels).astype(np.intp).T
        seen = np.abs(depth[rows, columns] - z) <= near
        places, rows, columns, z = places[seen], rows[seen], columns[seen], z[seen]
        own = photo[rows * photo.shape[0] // camera.height, columns * photo.shape[1] // camera.width]
        total[places] += own / z[:, None] ** 2
        weight[places] += 1 / z**2
    known = weight > 0
    total[known] /= weight[known, None]
    return np.where(known[:, None], np.rint(total), _GREY).astype(np.uint8)

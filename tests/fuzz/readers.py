"""All readers of other people's files: what makes valid files, and what reads them as the commands do."""

import contextlib
import functools
import importlib.util
import io
import json
import os
import tarfile
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import captures
import data_set_files
import numpy as np
import realsense
import single_files
import torch
from PIL import Image
from small_files import written
from small_lpips import random_trunk

from dsr.cli import main
from dsr.data.download import Collection, Item
from dsr.data.download.fetching import state, unpack, verify
from dsr.data.folder import Folder
from dsr.data.ibims import IBims
from dsr.data.nyu import NYU
from dsr.data.tofmark import ToFMark
from dsr.evaluation.scenes import failure_line
from dsr.io.cameras import read_any_camera
from dsr.io.depth_files import DEPTH_SUFFIXES, write_depth_file
from dsr.io.trajectories import read_poses
from dsr.methods.classical.shape_from_shading import read_foreground
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.peers.local_filters import SVLRM
from dsr.methods.networks.peers.peer_network import load_peer
from dsr.methods.networks.trained import load_msg_weights
from dsr.metrics.lpips import load_lpips
from dsr.utils.progress import Progress
from fuzz.judging import REFUSALS, EscapedError, Place, RefusedError


@dataclass(frozen=True)
class Reader:
    """One kind of files: what writes valid ones into a folder, and what reads them; of each round it gets some cases.

    A reader that takes long, or whose files do, has the weight 1.
    """

    name: str
    make: Callable[[Path], Any]
    read: Callable[[Place], Any]
    weight: int = 3


@functools.cache
def unit(name: str) -> ModuleType:
    """Return the module of a unit test, for what it writes files with."""
    path = Path(__file__).resolve().parents[1] / "unit" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"fuzz_{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(call: Callable[[], Any], *, faulty: bool = False) -> None:
    """Run what returns an exit code or exits; ``faulty``: exit code 1 says that a scene has a problem."""
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors):
        try:
            code = call()
        except SystemExit as error:
            code = error.code
        except Exception as error:
            raise EscapedError from error
    if code == 2:
        raise RefusedError([line.removeprefix("error: ") for line in errors.getvalue().splitlines() if line.strip()])
    if code and not (code == 1 and faulty):
        raise AssertionError(f"ends with exit code {code}: {errors.getvalue()[-300:]}")


def command(*arguments: object) -> None:
    """Run ``dsr`` in this process."""
    run(lambda: main([str(each) for each in arguments]), faulty=arguments[0] == "doctor")


def upsample(*options: str) -> Callable[[Place], None]:
    """Return what reads the input as ``dsr upsample`` does, without computing; ``{}`` in options is its folder."""

    def read(place: Place) -> None:
        given = [each.format(place.input) for each in options]
        first = [] if "--rgb" in options else [place.input]
        command("upsample", *first, *given, "-o", place.out, "--dry-run")

    return read


# Captures and pictures


def pictures(folder: Path) -> None:
    """Write photos, depth maps and confidence maps of all formats."""
    photos = (".jpg", ".jpeg", ".tiff", ".bmp", ".webp", ".ppm", ".png")
    for number, (suffix, suffix_lr) in enumerate(zip(photos, DEPTH_SUFFIXES, strict=True)):
        captures.save(folder / "rgb" / f"{number}{suffix}", captures.photo(number))
        maps = {"depth": captures.depth(number).astype(np.float32), "conf": (captures.levels() / 2).astype(np.float32)}
        if suffix_lr == ".png":
            maps = {"depth": captures.millimetres(number), "conf": (captures.levels() > 0).astype(np.uint16)}
        for kind, values in maps.items():
            (folder / kind).mkdir(exist_ok=True)
            write_depth_file(folder / kind / f"{number}{suffix_lr}", values)


def rig(folder: Path) -> None:
    """Write a photo with EXIF data, and a depth map of another camera with mask and confidence."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    exif[0x0112] = 1
    Image.fromarray(captures.photo()).save(folder / "photo.jpg", exif=exif, quality=90)
    captures.save(folder / "depth.png", captures.millimetres())
    captures.save(folder / "mask.png", np.full(captures.SIZE_LR, 255, np.uint8))
    captures.save(folder / "confidence.png", captures.levels())
    camera = {"width": 16, "height": 12, "fx": 12.5, "fy": 12.7, "cx": 7.4, "cy": 5.6}
    (folder / "camera.json").write_text(json.dumps(CAMERA))
    (folder / "ir.json").write_text(json.dumps({**camera, "depth_unit": 0.001, "range_type": "orthogonal"}))
    (folder / "extrinsics.txt").write_text("1 0 0 0.01\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")


CAMERA = {"width": 64, "height": 48, "fx": 50.0, "fy": 51.0, "cx": 31.0, "cy": 24.0}
_RIG = ("--rgb", "{}/photo.jpg", "--depth", "{}/depth.png", "--camera", "{}/camera.json", "--depth-camera",
        "{}/ir.json", "--extrinsics", "{}/extrinsics.txt", "--mask", "{}/mask.png", "--confidence",
        "{}/confidence.png", "--min-confidence", "0.5")  # fmt: skip
_PICTURES = ("--rgb", "{}/rgb", "--depth", "{}/depth", "--confidence", "{}/conf", "--min-confidence", "0.5")


def colmap(folder: Path, write: str, *, depth: bool) -> None:
    """Write photos with a sparse model of COLMAP, with depth maps or with points alone."""
    models = unit("test_format_colmap")
    for number in range(models.FRAMES):
        captures.save(folder / "images" / f"{number:03}.png", captures.photo(number))
        if depth:
            captures.save(folder / "depth" / f"{number:03}.png", captures.millimetres(number))
    getattr(models, write)(folder / "sparse" / "0", "OPENCV", models.NAMES, points=not depth)


def zipped(folder: Path) -> None:
    """Write a ZIP file of an export of 3D Scanner App."""
    with tempfile.TemporaryDirectory() as place, zipfile.ZipFile(folder / "scan.zip", "w") as archive:
        for path in sorted(captures.scanner_app(Path(place) / "scan").iterdir()):
            archive.write(path, f"scan/{path.name}", zipfile.ZIP_DEFLATED)


def read_zipped(place: Place) -> None:
    """Read a ZIP file, which is unpacked into the folder of temporary files."""
    with mock.patch.object(tempfile, "tempdir", str(place.out)):
        command("upsample", place.input / "scan.zip", "-o", place.out / "results", "--dry-run")


_CONFIDENT = ("record3d", "polycam", "scanner app")
CAPTURES = {
    **captures.FOLDERS,
    "realsense bag": lambda folder: realsense.bag(folder / "scan.bag", realsense.Recording()),
    "realsense db3": lambda folder: realsense.db3(folder / "scan.db3", realsense.Recording()),
    **{f"colmap {kind}": functools.partial(colmap, write=f"write_{kind}", depth=True) for kind in ("binary", "text")},
    "colmap points": functools.partial(colmap, write="write_binary", depth=False),
    "colmap text points": functools.partial(colmap, write="write_text", depth=False),
}
OF_CAPTURES = (
    Reader("pictures", pictures, upsample(*_PICTURES), 6),
    Reader("rig", rig, upsample(*_RIG), 6),
    Reader("poses", captures.tum, upsample("--poses", "{}/groundtruth.txt", "--neighbours", "2")),
    Reader("zip", zipped, read_zipped),
    *(Reader(name, make, upsample(*(("--min-confidence", "0.5") if name in _CONFIDENT else ())))
      for name, make in CAPTURES.items()),
)  # fmt: skip


# Data sets


def data_set(make: Callable[..., Any], **settings: Any) -> Callable[[Place], None]:
    """Return what reads the first scenes of a data set, at their original size."""

    def read(place: Place) -> None:
        source = make(str(place.input), **settings)
        for scene in source.scenes()[:3]:
            try:
                source.fingerprint(scene)
                source.load(scene)
            except REFUSALS as error:
                raise RefusedError([f"{place.input}: {failure_line(scene, error)}"]) from error

    return read


def read_prepared(folder: Path) -> None:
    """Read a scene of a data set: prepared, and from the damaged or kept cache."""
    with mock.patch.dict(os.environ, DSR_CACHE=str(folder / "cache")):
        source = data_set_files.opened(data_set_files.SETS["icl"], folder, size=64)
        source.load(source.scenes()[0])


def prepared(folder: Path) -> None:
    """Write a frame and the cache of its prepared scene."""
    data_set_files.write_frame("icl", folder)
    read_prepared(folder)


def scenes(folder: Path) -> None:
    """Write two scenes of dsr's own layout: depth with a mask and a measured map, and disparity."""
    rows = np.mgrid[0:48, 0:64][0]
    for name in ("kitchen", "hall"):
        captures.save(folder / name / "rgb.png", captures.photo())
    write_depth_file(folder / "kitchen" / "depth.npy", (1.5 + rows / 40).astype(np.float32))
    write_depth_file(folder / "kitchen" / "depth_lr4.npy", captures.depth().astype(np.float32))
    write_depth_file(folder / "hall" / "disparity.pfm", (6 + rows / 9).astype(np.float32))
    captures.save(folder / "kitchen" / "mask.png", np.full((48, 64), 255, np.uint8))
    for name, more in {"kitchen": {"depth_unit": "m", "hole_value": 0.0}, "hall": {"baseline": 0.08}}.items():
        (folder / name / "camera.json").write_text(json.dumps({**CAMERA, **more}))


def tofmark(folder: Path) -> None:
    """Write scenes of ToFMark as MATLAB 5 and 7.3 files, and one as pictures."""
    tests = unit("test_format_tofmark")
    variables = {"intensity": tests.GREY / 255, "depth_gt": tests.TRUTH, "depth_tof": tests.SPARSE}
    tests.old(folder / "benchmarking_dataset_devil.mat", variables, compress=True)
    tests.new(folder / "benchmarking_dataset_shark.mat", variables)
    written(folder / "books.bmp", tests.bmp(tests.GREY))
    written(folder / "books_depth.bmp", tests.bmp(np.where(tests.SPARSE > 0, tests.GREY, 0)))


OF_SETS = (
    *(Reader(f"data {name}", functools.partial(data_set_files.write_frame, name),
             data_set(kind.make, **{"scenes": "found", **kind.settings}), 2)
      for name, kind in data_set_files.SETS.items()),
    Reader("data folder", scenes, data_set(Folder), 6),
    Reader("data nyu of one file", lambda folder: unit("test_format_nyu").official(folder / "nyu_depth_v2_labeled.mat"),
           data_set(NYU, size=None), 1),
    Reader("data ibims of matrices", lambda folder: unit("test_format_ibims").matrices(folder),
           data_set(IBims, scenes="found"), 1),
    Reader("data tofmark", tofmark, data_set(
        ToFMark, scenes="found", depth_range=[1.0, 4.0], intrinsics=[40.0, 40.0, 19.5, 9.5]), 6),
    Reader("data prepared", prepared, lambda place: read_prepared(place.input), 1),
    Reader("doctor", scenes, lambda place: command("doctor", place.input), 1),
)  # fmt: skip


# Single files, weights and archives


def archive(path: Path) -> None:
    """Write an archive as data sets are published in."""
    if path.suffix == ".zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
            packed.writestr("set/a.txt", "content " * 40)
        return
    with tarfile.open(path, "w:gz" if path.suffix == ".gz" else "w") as tar:
        member, link = tarfile.TarInfo("set/a.txt"), tarfile.TarInfo("set/link")
        member.size, link.type, link.linkname = 320, tarfile.SYMTYPE, "a.txt"
        tar.addfile(member, io.BytesIO(b"content " * 40))
        tar.addfile(link)


def read_archive(path: Path) -> None:
    unpack(path, path.parents[1] / "out" / "set", lambda *_, **__: None)


def checksums(path: Path) -> None:
    """Write a record of downloaded files, and one of them."""
    written(path.parent / "books" / "b.txt", b"content")
    digest = "ed7002b439e9ac845f22357d822bac1444730fbdb6016d3ec9432297b9ec9f73"
    entries = {"books/b.txt": {"sha256": digest, "size": 7}, "a.zip": {"sha256": None, "size": 9, "files": {"x": 1}}}
    path.write_text(json.dumps(entries))


def read_checksums(path: Path) -> None:
    items = (Item("books/b.txt", ("https://localhost/b.txt",)),)
    collection = Collection("books", "Books", "", "", "", ("books",), None, items)
    state(collection, path.parent)
    problems = verify(collection, path.parent, Progress())
    if problems:
        raise RefusedError(problems)


def caffe_model(path: Path) -> None:
    tests = unit("test_trained_weights")
    path.write_bytes(tests.caffemodel(tests.caffe_layers(MSGNet(2, "hui"))))


def peer(path: Path) -> None:
    """Write a network's tensors by name, in torch's present or earlier format."""
    torch.save(SVLRM(4).state_dict(), path, _use_new_zipfile_serialization="old" not in path.name)


_OPEN3D = {"width": 64, "height": 48, "intrinsic_matrix": [50, 0, 0, 0, 51, 0, 31, 24, 1]}
FILES = {
    **single_files.READERS,
    "open3d.json": (single_files.text(json.dumps(_OPEN3D)), read_any_camera),
    "trajectory.log": (single_files.text("0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"), read_poses),
    "times.txt": (single_files.text("# time tx ty tz qx qy qz qw\n1305031102.03 0.1 0.2 -0.3 0 0 0 1\n"), read_poses),
    "foreground.png": (single_files.picture, lambda path: read_foreground(path, (48, 64))),
    "published.pth": (lambda path: unit("test_trained_weights").published(path),
                      lambda path: load_msg_weights(path, 4)),
    "hui.caffemodel": (caffe_model, lambda path: load_msg_weights(path, 2)),
    **{name: (peer, lambda path: load_peer(path, SVLRM, 4)) for name in ("peer.pth", "peer_old.pth")},
    "lpips.pth": (lambda path: torch.save(random_trunk(), path), load_lpips),
    "checksums.json": (checksums, read_checksums),
    **dict.fromkeys(("set.zip", "set.tar", "set.tar.gz"), (archive, read_archive)),
}  # fmt: skip


def _single(name: str, write: Callable[[Path], Any], read: Callable[[Path], Any]) -> Reader:
    return Reader(name, lambda folder: write(folder / name), lambda place: read(place.input / name))


OF_FILES = tuple(_single(name, *functions) for name, functions in FILES.items())

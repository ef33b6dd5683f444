"""The readers of other people's files: what makes valid files, and what reads them as the commands do."""

import contextlib
import io
import os
import re
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import captures
import realsense

from dsr.cli import main
from fuzz import run_seeds, seeds
from fuzz.judging import EscapedError, RefusedError
from fuzz.place import Place

_SUFFIXES = (".png", ".jpg", ".heic", ".tiff", ".npy", ".npz", ".pfm", ".exr", ".depth", ".json", ".txt")
_LIBRARY = (ValueError, OSError)  # What the commands turn into a line


@dataclass(frozen=True)
class Reader:
    """One kind of files.

    Args:
        name: shown in counts.
        make: writes valid files into a folder.
        read: reads them as a command does.
        weight: how many cases it gets of each round; 1 for those that take long.
        refusals: exceptions that the commands turn into a line.

    """

    name: str
    make: Callable[[Path], Any]
    read: Callable[[Place], Any]
    weight: int = 4
    refusals: tuple[type[BaseException], ...] = _LIBRARY


def command(*arguments: object) -> None:
    """Run ``dsr`` in this process.

    Raises:
        RefusedError: it ends with exit code 2.

    """
    _run(lambda: main([str(each) for each in arguments]), faulty=arguments[0] == "doctor")


def _run(call: Callable[[], Any], *, faulty: bool = False) -> None:
    """Run what returns an exit code or exits.

    Args:
        call: what to run.
        faulty: whether exit code 1 says that a scene has a problem.

    Raises:
        RefusedError: it ends with exit code 2.

    """
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


def _upsample(*options: str) -> Callable[[Place], None]:
    """Return what reads pictures without computing; names of files in the options end in a suffix."""

    def read(place: Place) -> None:
        given = [str(place.input / each) if Path(each).suffix in _SUFFIXES else each for each in options]
        command("upsample", *given, "-o", place.out, "--dry-run")

    return read


def _pair(depth: str, *more: str, rgb: str = "photo.png") -> Callable[[Place], None]:
    return _upsample("--rgb", rgb, "--depth", depth, *more)


def _recording(*options: str) -> Callable[[Place], None]:
    """Return what reads a folder of pictures or a capture."""

    def read(place: Place) -> None:
        command("upsample", place.input, "-o", place.out, "--dry-run", *options)

    return read


def _zip(place: Place) -> None:
    """Read a ZIP file, which is unpacked into the folder of temporary files."""
    before, tempfile.tempdir = tempfile.tempdir, str(place.out)
    try:
        command("upsample", place.input / "scan.zip", "-o", place.out / "results", "--dry-run")
    finally:
        tempfile.tempdir = before


def _confidences(place: Place) -> None:
    command("upsample", "--rgb", place.input / "rgb", "--depth", place.input / "depth", "--confidence",
            place.input / "conf", "--min-confidence", "0.5", "-o", place.out, "--dry-run")  # fmt: skip


def _sequence(poses: str, frames: str = ".") -> Callable[[Place], None]:
    def read(place: Place) -> None:
        command("upsample", place.input / frames, "--poses", place.input / poses, "--neighbours", "2", "-o", place.out,
                "--dry-run")  # fmt: skip

    return read


def _dataset(module: str, name: str, **arguments: Any) -> Callable[[Place], None]:
    """Return what reads every scene of a data set, at its original size."""

    def read(place: Place) -> None:
        import importlib  # noqa: PLC0415 - with what it imports only where it is needed

        from dsr.evaluation.scenes import failure_line  # noqa: PLC0415

        source = getattr(importlib.import_module(f"dsr.data.{module}"), name)(str(place.input), **arguments)
        for scene in source.scenes()[:3]:
            try:
                source.fingerprint(scene)
                source.load(scene)
            except _LIBRARY as error:
                raise RefusedError([f"{place.input}: {failure_line(scene, error)}"]) from error

    return read


def _prepared(place: Place) -> None:
    """Read a data set's scenes twice: prepared, and from the damaged or kept cache."""
    from dsr.data.icl import ICL  # noqa: PLC0415

    os.environ["DSR_CACHE"] = str(place.input / "cache")
    source = ICL(str(place.input), "found", size=64)
    for scene in source.scenes()[:2]:
        source.load(scene)


def _make_prepared(folder: Path) -> None:
    seeds.icl(folder)
    before = os.environ.get("DSR_CACHE")
    _prepared(Place(folder.parent) if folder.name == "input" else _At(folder))
    if before is not None:
        os.environ["DSR_CACHE"] = before


@dataclass(frozen=True)
class _At(Place):
    """A place whose input is a given folder."""

    @property
    def input(self) -> Path:
        return self.root


def _unpack(place: Place) -> None:
    from dsr.data.download.fetching import unpack  # noqa: PLC0415

    problems = []
    for name in ("set.zip", "set.tar.gz", "set.tar"):
        path = place.input / name
        try:
            unpack(path, place.out / name, lambda *_, **__: None)
        except _LIBRARY as error:
            problems.append(error)
    if problems:
        raise problems[0]


def _verify(place: Place) -> None:
    from dsr.data.download.collections import Collection, Item  # noqa: PLC0415
    from dsr.data.download.fetching import state, verify  # noqa: PLC0415
    from dsr.utils.progress import Progress  # noqa: PLC0415

    items = (Item("books/b.txt", ("https://localhost/b.txt",)),)
    collection = Collection("books", "Books", "", "", "", ("books",), None, items)
    state(collection, place.input)
    problems = verify(collection, place.input, Progress())
    if problems:
        raise RefusedError(problems)


def _weights(place: Place) -> None:
    from dsr.methods.networks.trained import TrainedNetwork  # noqa: PLC0415

    TrainedNetwork(place.input / "weights.safetensors", 2, "msg_v")


def _published(*names: str) -> Callable[[Place], None]:
    def read(place: Place) -> None:
        from dsr.methods.networks.trained import load_msg_weights  # noqa: PLC0415

        _each(place, names, lambda path: load_msg_weights(path, 2))

    return read


def _peers(place: Place) -> None:
    from dsr.methods.networks.peers.local_filters import SVLRM  # noqa: PLC0415
    from dsr.methods.networks.peers.peer_network import load_peer  # noqa: PLC0415

    _each(place, ("peer.pth", "peer_old.pth"), lambda path: load_peer(path, SVLRM, 4))


def _lpips(place: Place) -> None:
    from dsr.metrics.lpips import load_lpips  # noqa: PLC0415

    _each(place, ("peer.pth", "peer_old.pth"), load_lpips)


def _each(place: Place, names: tuple[str, ...], read: Callable[[Path], Any]) -> None:
    """Read several files, and raise the first refusal at the end."""
    problems = []
    for name in names:
        try:
            read(place.input / name)
        except _LIBRARY as error:
            problems.append(error)
    if problems:
        raise problems[0]


def _report(*parts: str) -> Callable[[Place], None]:
    def read(place: Place) -> None:
        command("report", place.input, "-o", place.out / "report", "--only", ",".join(parts))

    return read


def _report_with_study(place: Place) -> None:
    command("report", place.input, "-o", place.out / "report", "--only", "tables", "--study", place.input / "study.csv")


def _collect(place: Place) -> None:
    command("study", "collect", place.input, place.input / "answers", "-o", place.out / "study.csv")


def _hydra(name: str, *arguments: str) -> None:
    """Run ``eval.py`` or ``train.py`` in this process, without ``dsr``, which catches more."""
    from dsr.app.entry import run_eval, run_train  # noqa: PLC0415

    try:
        _run(lambda: {"eval": run_eval, "train": run_train}[name](arguments))
    except RefusedError as refused:  # a line may begin with the key of a configuration
        raise RefusedError([re.sub(r"^([a-z_]+(\.\w+)*: )", r"input/ \1", line) for line in refused.lines]) from refused


def _eval_again(place: Place) -> None:
    _hydra("eval", *run_seeds.evaluation_arguments(place.input, place.input / "run"))


def _eval_run(place: Place) -> None:
    _hydra("eval", f"run={place.input / 'run'}", f"output_dir={place.out / 'run'}", "metrics.lpips=false", "device=cpu")


def _resume(place: Place) -> None:
    _hydra("train", f"resume={place.input / 'run'}", "device=cpu")


def _checkpoint(place: Place) -> None:
    from dsr.training.module import SuperResolution  # noqa: PLC0415

    path = place.input / "run" / "checkpoints" / "best.ckpt"
    SuperResolution.load_from_checkpoint(path)


def _foreground(place: Place) -> None:
    from dsr.methods.classical.shape_from_shading import read_foreground  # noqa: PLC0415

    read_foreground(place.input / "mask.png", (48, 64))


def _configured(place: Place) -> None:
    command("upsample", "--rgb", place.input / "photo.png", "--depth", place.input / "depth.png", "--config-dir",
            place.input / "conf", "--method", "more", "--set", "data_weight=30", "-o", place.out,
            "--dry-run")  # fmt: skip


def _composed(place: Place) -> None:
    """Compose an evaluation with a user's method and data set, and read the method."""
    from omegaconf import DictConfig  # noqa: PLC0415

    from dsr.app.entry import run_command  # noqa: PLC0415
    from dsr.app.schema import EvalConfig, plain_config  # noqa: PLC0415

    def job(config: DictConfig) -> None:
        EvalConfig.of(plain_config(config))

    folder = place.input / "conf"
    _run(lambda: run_command("eval", job, ["--config-dir", str(folder), "method=mine", "dataset=ours"]))


READERS = (
    *(Reader(f"depth {kind}", lambda folder, kind=kind: seeds.pair(folder, f".{kind}"), _pair(f"depth.{kind}"))
      for kind in ("png", "tiff", "npy", "npz", "pfm", "exr")),
    Reader("depth icl", seeds.icl_depth, _pair("photo.depth"), 2),
    Reader("jpeg with exif", seeds.jpeg_with_exif, _pair("depth.png", rgb="photo.jpg")),
    Reader("photos", seeds.photos, _recording()),
    Reader("rig", seeds.rig, _pair("depth.png", "--camera", "camera.json", "--depth-camera", "ir.json", "--extrinsics",
                                   "extrinsics.txt")),
    Reader("open3d camera", seeds.open3d_camera, _pair("depth.npy", "--camera", "camera.json", "--depth-camera",
                                                       "camera.json", "--extrinsics", "extrinsics.json")),
    Reader("matrix, mask", seeds.matrix_camera, _pair("depth.tiff", "--camera", "matrix.txt", "--mask", "mask.png",
                                                      "--confidence", "confidence.png", "--min-confidence", "0.5")),
    Reader("confidence", seeds.confidence_folder, _confidences),
    Reader("tum", seeds.tum, _recording()),
    Reader("tum poses", seeds.tum, _sequence("groundtruth.txt")),
    Reader("kitti poses", seeds.poses_of_lines, _sequence("kitti.txt", "frames")),
    Reader("log poses", seeds.poses_of_lines, _sequence("trajectory.log", "frames")),
    Reader("colmap", seeds.colmap, _sequence("sparse/0/images.bin")),
    Reader("colmap text", lambda folder: seeds.colmap(folder, binary=False), _recording()),
    Reader("colmap points", lambda folder: seeds.colmap(folder, depth=False), _recording()),
    Reader("colmap text points", lambda folder: seeds.colmap(folder, binary=False, depth=False), _recording()),
    Reader("dsr scenes", seeds.dsr_scenes, _recording()),
    Reader("stray", lambda folder: captures.stray(folder, video=False), _recording()),
    Reader("stray video", captures.stray, _recording()),
    Reader("record3d", seeds.r3d, _recording("--min-confidence", "0.5")),
    Reader("record3d folder", seeds.record3d_folder, _recording()),
    Reader("record3d export", seeds.record3d_export, _recording()),
    Reader("polycam", captures.polycam, _recording("--min-confidence", "0.5")),
    Reader("arkitscenes app", captures.arkitscenes, _recording()),
    Reader("open3d", captures.open3d, _recording()),
    Reader("sens", seeds.sens, _recording()),
    Reader("scannetpp", captures.scannetpp, _recording(), 2),
    Reader("scannetpp deflate", lambda folder: captures.scannetpp(folder, "deflate"), _recording(), 1),
    Reader("scannet", captures.scannet, _recording(), 2),
    Reader("7-scenes", captures.seven_scenes, _recording(), 2),
    Reader("sunrgbd app", captures.sunrgbd, _recording(), 2),
    Reader("replica", captures.replica, _recording(), 2),
    Reader("scanner app", captures.scanner_app, _recording("--min-confidence", "0.5"), 2),
    Reader("zip", seeds.zipped, _zip),
    Reader("ros 1", lambda folder: captures.ros(folder / "scan.bag", 1), _recording(), 2),
    Reader("ros 1 jpeg", lambda folder: captures.ros(folder / "scan.bag", 1, floats=True, compressed=True),
           _recording(), 2),
    Reader("ros 2", seeds.ros2, _recording(), 2),
    Reader("ros 2 packed", seeds.ros2_packed, _recording(), 1),
    Reader("kinect", seeds.kinect, _recording(), 2),
    Reader("heic", seeds.heic, _recording()),
    Reader("heic beside depth", seeds.heic_beside_depth, _pair("depth.npy", rgb="photo.heic"), 2),
    Reader("zed", captures.zed, _recording(), 1),
    Reader("ros 2 mcap", seeds.ros2_alone, _recording(), 2),
    Reader("ros rvl", lambda folder: captures.ros(folder / "scan.bag", 1, rvl_depth=True), _recording(), 2),
    Reader("realsense bag", lambda folder: realsense.bag(folder / "scan.bag", realsense.Recording()), _recording(), 2),
    Reader("realsense db3", lambda folder: realsense.db3(folder / "scan.db3", realsense.Recording()), _recording(), 2),
    Reader("data folder", seeds.dsr_scenes, _dataset("folder", "Folder")),
    Reader("doctor", seeds.dsr_scenes, lambda place: command("doctor", place.input), 1),
    Reader("middlebury", seeds.middlebury, _dataset("middlebury", "Middlebury", scenes="found", size=None, fill=())),
    Reader("middlebury 2006", seeds.middlebury_levels,
           _dataset("middlebury", "MiddleburyLevels", year=2006, scenes="found", size=None)),
    Reader("icl", seeds.icl, _dataset("icl", "ICL", scenes="found", size=None), 1),
    Reader("prepared", _make_prepared, _prepared, 1),
    Reader("sunrgbd", seeds.sunrgbd, _dataset("sunrgbd", "SunRGBD", scenes="found", size=None)),
    Reader("tofmark 5", seeds.tofmark_old,
           _dataset("tofmark", "ToFMark", scenes="found", depth_range=[1.0, 4.0], intrinsics=[40.0, 40.0, 19.5, 9.5])),
    Reader("tofmark 7.3", seeds.tofmark_new,
           _dataset("tofmark", "ToFMark", scenes="found", intrinsics=[40.0, 40.0, 19.5, 9.5])),
    Reader("nyu", seeds.nyu, _dataset("nyu", "NYU", size=None), 2),
    Reader("nyu files", seeds.nyu_files, _dataset("nyu", "NYU", split="test", scenes="found"), 2),
    Reader("tartanair", seeds.tartanair, _dataset("tartanair", "TartanAir", size=None), 2),
    Reader("sintel", seeds.sintel, _dataset("sintel", "Sintel", scenes="found")),
    Reader("rgbdd", lambda folder: seeds.unit("test_data_sets").write_frame("rgbdd", folder),
           _dataset("rgbdd", "RGBDD", real=True, scenes="found"), 2),
    Reader("ddrnet", lambda folder: seeds.unit("test_data_sets").write_frame("ddrnet", folder),
           _dataset("ddrnet_frames", "DDRNetFrames"), 1),
    Reader("lu", lambda folder: seeds.unit("test_format_eight_bit").pair(folder),
           _dataset("eight_bit", "EightBit", benchmark="lu", scenes="found")),
    Reader("arkitscenes", lambda folder: seeds.unit("test_format_arkitscenes").frame(folder),
           _dataset("arkitscenes", "ARKitScenes"), 1),
    Reader("cleargrasp", lambda folder: seeds.unit("test_format_cleargrasp").capture(folder),
           _dataset("cleargrasp", "ClearGrasp", synthetic=False)),
    Reader("cleargrasp synthetic", lambda folder: seeds.unit("test_format_cleargrasp").rendering(folder),
           _dataset("cleargrasp", "ClearGrasp", synthetic=True)),
    Reader("ibims", lambda folder: seeds.unit("test_format_ibims").matrices(folder),
           _dataset("ibims", "IBims", scenes="found"), 1),
    Reader("ibims pictures", lambda folder: seeds.unit("test_format_ibims").pictures(folder),
           _dataset("ibims", "IBims", scenes="found"), 1),
    Reader("hammer", lambda folder: seeds.unit("test_data_sets").write_frame("hammer", folder),
           _dataset("hammer", "Hammer", sensor="tof")),
    Reader("archives", seeds.archives, _unpack),
    Reader("checksums", seeds.checksums, _verify),
    Reader("weights", seeds.dsr_weights, _weights, 2),
    Reader("msg torch", seeds.torch_weights, _published("voynov.pth", "earlier.pth"), 2),
    Reader("msg caffe", seeds.caffe_weights, _published("hui.caffemodel")),
    Reader("peers", seeds.peer_weights, _peers, 2),
    Reader("lpips", seeds.peer_weights, _lpips, 2),
    Reader("report", run_seeds.runs, _report("tables", "metrics"), 1),
    Reader("report page", run_seeds.runs, _report("figures", "page"), 1),
    Reader("report study", run_seeds.study_table, _report_with_study, 2),
    Reader("study build", run_seeds.runs,
           lambda place: command("study", "build", place.input, "-o", place.out / "study", "--light", "e1"), 2),
    Reader("study collect", run_seeds.study, _collect),
    Reader("eval again", run_seeds.evaluation, _eval_again, 1),
    Reader("eval run", run_seeds.training, _eval_run, 1),
    Reader("train resume", run_seeds.interrupted_training, _resume, 1),
    Reader("train weights", run_seeds.training_without_weights, _resume, 1),
    Reader("checkpoint", run_seeds.training, _checkpoint, 2),
    Reader("foreground", seeds.foreground, _foreground),
    Reader("view", run_seeds.results,
           lambda place: command("view", place.input / "out", "--no-open", "-o", place.out / "view.html")),
    Reader("fuse", run_seeds.results,
           lambda place: command("fuse", place.input / "out", "-o", place.out / "mesh.ply", "--voxel", "0.05"), 2),
    Reader("upsample again", run_seeds.kept_results,
           lambda place: command("upsample", *run_seeds.upsample_again(place.input)), 2),
    Reader("upsample more", run_seeds.kept_results,
           lambda place: command("upsample", *run_seeds.more_of_results(place.input)), 1),
    Reader("configuration", run_seeds.user_configuration, _configured, 2),
    Reader("configurations", run_seeds.user_configuration, _composed, 1),
)  # fmt: skip
_ROUND = tuple(reader for turn in range(4) for reader in READERS if reader.weight > turn)
"""The readers of consecutive cases."""


def reader_of(number: int) -> Reader:
    """Return the reader of a case."""
    return _ROUND[number % len(_ROUND)]


def numbers_of(reader: Reader, count: int) -> list[int]:
    """Return the numbers of the first cases of a reader."""
    rounds = range(count)
    numbers = [turn * len(_ROUND) + place for turn in rounds for place, each in enumerate(_ROUND) if each is reader]
    return numbers[:count]

"""Valid files of every kind, small and made here, from which cases are made."""

import functools
import importlib.util
import json
import shutil
import tarfile
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import captures
import cv2
import numpy as np
import OpenEXR
import scipy.io
import torch
from PIL import Image

UNIT_TESTS = Path(__file__).resolve().parents[1] / "unit"
PHOTO, MAP = captures.SIZE, captures.SIZE_LR
CAMERA = {"width": 64, "height": 48, "fx": 50.0, "fy": 51.0, "cx": 31.0, "cy": 24.0}


@functools.cache
def unit(name: str) -> ModuleType:
    """Return the module of a unit test, for what it writes files with."""
    spec = importlib.util.spec_from_file_location(f"fuzz_{name}", UNIT_TESTS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def written(path: Path, content: bytes | str) -> Path:
    """Write a file, and the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def photo(path: Path, number: int = 0, **more: Any) -> Path:
    """Write a photo of 48 x 64."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(captures.photo(number)).save(path, **more)
    return path


def foreground(folder: Path) -> None:
    """Write a mask of 48 x 64 whose left half is white."""
    captures.save(folder / "mask.png", np.uint8(255) * (np.indices((48, 64))[1] < 32))


def pair(folder: Path, suffix: str) -> None:
    """Write a photo and a depth map of 12 x 16 in a format."""
    photo(folder / "photo.png")
    values = captures.depth().astype(np.float32)
    path = folder / f"depth{suffix}"
    if suffix == ".png":
        captures.save(path, captures.millimetres())
    elif suffix == ".tiff":
        cv2.imwrite(str(path), values)
    elif suffix == ".npy":
        np.save(path, values)
    elif suffix == ".npz":
        np.savez_compressed(path, depth=values, other=np.arange(5))
    elif suffix == ".pfm":
        written(path, b"Pf\n16 12\n-1.0\n" + values[::-1].astype("<f4").tobytes())
    elif suffix == ".exr":
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"Z": values}) as file:
            file.write(str(path))


def jpeg_with_exif(folder: Path) -> None:
    """Write a JPEG whose EXIF data say the focal length, and a depth map."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    exif[0x0112] = 1
    photo(folder / "photo.jpg", exif=exif, quality=90)
    captures.save(folder / "depth.png", captures.millimetres())


def photos(folder: Path) -> None:
    """Write photos of all formats, with depth maps."""
    for number, suffix in enumerate((".jpg", ".tiff", ".bmp", ".webp", ".ppm", ".png")):
        photo(folder / "rgb" / f"{number}{suffix}", number)
        captures.save(folder / "depth" / f"{number}.png", captures.millimetres(number))


def icl_depth(folder: Path) -> None:
    """Write a photo of 480 x 640 and distances as text."""
    Image.fromarray(np.full((480, 640, 3), 99, np.uint8)).save(folder / "photo.png")
    rows = np.mgrid[0:480, 0:640][0]
    written(folder / "photo.depth", " ".join(map(str, (100 + rows).ravel())) + " ")


def rig(folder: Path) -> None:
    """Write a pair whose depth camera is elsewhere."""
    pair(folder, ".png")
    written(folder / "camera.json", json.dumps(CAMERA))
    written(folder / "ir.json", json.dumps({**CAMERA, "width": 16, "height": 12, "fx": 12.5, "fy": 12.7, "cx": 7.4,
                                            "cy": 5.6, "depth_unit": 0.001, "range_type": "orthogonal"}))  # fmt: skip
    written(folder / "extrinsics.txt", "1 0 0 0.01\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")


def open3d_camera(folder: Path) -> None:
    """Write a pair with a camera of Open3D."""
    pair(folder, ".npy")
    fx, fy, cx, cy = captures.INTRINSICS
    entries = {"width": 64, "height": 48, "intrinsic_matrix": [fx, 0, 0, 0, fy, 0, cx, cy, 1]}
    written(folder / "camera.json", json.dumps(entries))
    written(folder / "extrinsics.json", json.dumps({"matrix": np.eye(4).tolist()}))


def matrix_camera(folder: Path) -> None:
    """Write a pair with a mask, confidence, and a matrix as text."""
    pair(folder, ".tiff")
    written(folder / "matrix.txt", "50 0 31\n0 51 24\n0 0 1\n")
    captures.save(folder / "mask.png", np.full(MAP, 255, np.uint8))
    captures.save(folder / "confidence.png", captures.levels())


def tum(folder: Path) -> None:
    """Write a sequence in TUM's layout, with poses."""
    lines: dict[str, list[str]] = {"rgb": [], "depth": []}
    poses = ["# time tx ty tz qx qy qz qw"]
    for number in range(captures.FRAMES):
        time = f"{1305031102 + number / 30:.6f}"
        photo(folder / "rgb" / f"{time}.png", number)
        captures.save(folder / "depth" / f"{time}.png", (5 * captures.millimetres(number)).astype(np.uint16))
        for kind, each in lines.items():
            each.append(f"{time} {kind}/{time}.png")
        poses.append(f"{time} {0.1 * number} 0.2 -0.3 0 0 0 1")
    for kind, each in lines.items():
        written(folder / f"{kind}.txt", "\n".join(("# list", *each)) + "\n")
    written(folder / "groundtruth.txt", "\n".join(poses) + "\n")


def poses_of_lines(folder: Path) -> None:
    """Write frames with poses of matrices: each in a line, and in the form of Open3D's logs."""
    for number in range(captures.FRAMES):
        photo(folder / "frames" / f"frame-{number:06}.color.png", number)
        captures.save(folder / "frames" / f"frame-{number:06}.depth.png", captures.millimetres(number))
    matrices = [captures.pose(number) for number in range(captures.FRAMES)]
    written(folder / "kitti.txt", "\n".join(" ".join(f"{v:.9f}" for v in each[:3].ravel()) for each in matrices))
    blocks = [f"{i} {i} {i + 1}\n" + "\n".join(" ".join(f"{v:.9f}" for v in row) for row in each)
              for i, each in enumerate(matrices)]  # fmt: skip
    written(folder / "trajectory.log", "\n".join(blocks) + "\n")


def colmap(folder: Path, *, binary: bool = True, depth: bool = True) -> None:
    """Write photos with a sparse model of COLMAP, with depth maps or with points alone."""
    models = unit("test_format_colmap")
    for number in range(models.FRAMES):
        photo(folder / "images" / f"{number:03}.png", number)
        if depth:
            captures.save(folder / "depth" / f"{number:03}.png", captures.millimetres(number))
    write = models.write_binary if binary else models.write_text
    write(folder / "sparse" / "0", "OPENCV", models.NAMES, points=not depth)


def confidence_folder(folder: Path) -> None:
    """Write frames with confidence maps in many formats."""
    for number, suffix in enumerate((".png", ".npy", ".npz", ".pfm", ".bmp")):
        photo(folder / "rgb" / f"{number}.png", number)
        captures.save(folder / "depth" / f"{number}.png", captures.millimetres(number))
        path = folder / "conf" / f"{number}{suffix}"
        values = captures.levels() > 0
        path.parent.mkdir(exist_ok=True)
        if suffix == ".npy":
            np.save(path, values.astype(np.float32))
        elif suffix == ".npz":
            np.savez(path, confidence=values.astype(np.float32))
        elif suffix == ".pfm":
            written(path, b"Pf\n16 12\n-1.0\n" + values[::-1].astype("<f4").tobytes())
        else:
            captures.save(path, values.astype(np.uint8))


def dsr_scenes(folder: Path) -> None:
    """Write two scenes of dsr's own layout: depth with a mask and a measured map, and disparity."""
    captures.save(folder / "kitchen" / "rgb.png", captures.photo())
    captures.save(folder / "hall" / "rgb.png", captures.photo(1))
    rows = np.mgrid[0:48, 0:64][0]
    np.save(folder / "kitchen" / "depth.npy", (1.5 + rows / 40).astype(np.float32))
    np.save(folder / "kitchen" / "depth_lr4.npy", captures.depth().astype(np.float32))
    captures.save(folder / "kitchen" / "mask.png", np.full(PHOTO, 255, np.uint8))
    values = (6 + rows / 9).astype("<f4")
    written(folder / "hall" / "disparity.pfm", b"Pf\n64 48\n-1.0\n" + values[::-1].tobytes())
    written(folder / "kitchen" / "camera.json", json.dumps({**CAMERA, "depth_unit": "m", "hole_value": 0.0}))
    written(folder / "hall" / "camera.json", json.dumps({**CAMERA, "baseline": 80.0, "baseline_unit": "mm"}))


def middlebury(folder: Path) -> None:
    """Write scenes of 2014, and of 2006 and 2001."""
    tests = unit("test_format_middlebury")
    place = folder / "Recycle-perfect"
    tests.picture(place / "im0.png", 4, 6, 51)
    written(place / "calib.txt", tests.CALIBRATION)
    tests.pfm(place / "disp0.pfm", [[10.0 + 10 * row + column for column in range(6)] for row in range(4)])


def middlebury_levels(folder: Path) -> None:
    """Write a scene of 2006."""
    tests = unit("test_format_middlebury")
    tests.picture(folder / "Aloe" / "view1.png", 370, 60, 51)
    tests.levels(folder / "Aloe" / "disp1.png", np.full((370, 60), 90) + np.arange(60) // 9)
    written(folder / "Aloe" / "dmin.txt", "180\n")


def icl(folder: Path) -> None:
    """Write a frame of ICL-NUIM as text, and one in TUM's layout."""
    Image.fromarray(np.full((480, 640, 3), 99, np.uint8)).save(folder / "scene_00_0001.png")
    rows = np.mgrid[0:480, 0:640][0]
    written(folder / "scene_00_0001.depth", " ".join(map(str, (100 + rows).ravel())) + " ")
    (folder / "b" / "rgb").mkdir(parents=True)
    Image.fromarray(np.full((480, 640, 3), 99, np.uint8)).save(folder / "b" / "rgb" / "10.png")
    captures.save(folder / "b" / "depth" / "10.png", (5000 + rows).astype(np.uint16))


def sunrgbd(folder: Path) -> None:
    """Write a scene of SUN RGB-D."""
    tests = unit("test_format_sunrgbd")
    place = folder / "kv2/align_kv2/000065"
    written(place / "image/0000065.jpg", tests.jpg())
    written(place / "depth/0000065.png", tests.png(tests.turned(tests.MILLIMETRES)))
    written(place / "depth_bfx/0000065.png", tests.png(tests.turned(tests.MILLIMETRES + 1)))
    written(place / "intrinsics.txt", tests.MATRIX)


def tofmark_old(folder: Path) -> None:
    """Write a scene of ToFMark as a MATLAB 5 file, and one as pictures."""
    tests = unit("test_format_tofmark")
    variables = {"intensity": tests.GREY / 255, "depth_gt": tests.TRUTH, "depth_tof": tests.SPARSE}
    scipy.io.savemat(folder / "benchmarking_dataset_devil.mat", variables, do_compression=True)
    levels = np.zeros(tests.SIZE)
    levels[1::6, 2::6] = np.arange(4)[:, None] * 60 + np.arange(7) + 1
    written(folder / "books.bmp", tests.bmp(tests.GREY))
    written(folder / "books_depth.bmp", tests.bmp(levels))


def tofmark_new(folder: Path) -> None:
    """Write a scene of ToFMark as a MATLAB 7.3 file."""
    tests = unit("test_format_tofmark")
    variables = {"intensity": tests.GREY / 255, "depth_gt": tests.TRUTH, "depth_tof": tests.SPARSE}
    tests.new(folder / "benchmarking_dataset_shark.mat", variables)


def nyu(folder: Path) -> None:
    """Write the labelled file of NYU with one frame."""
    tests = unit("test_format_nyu")
    raw = tests.RAW[:1].swapaxes(1, 2)
    arrays = {"images": tests.IMAGES[:1].swapaxes(2, 3), "rawDepths": raw, "depths": raw}
    tests.official(folder / "nyu_depth_v2_labeled.mat", **arrays)


def nyu_files(folder: Path) -> None:
    """Write the test images of NYU as files."""
    path = folder / "RGB" / "1000.jpg"
    path.parent.mkdir(parents=True)
    Image.fromarray(np.full((480, 640, 3), 99, np.uint8)).save(path)
    (folder / "Depth").mkdir()
    np.save(folder / "Depth" / "1000.npy", np.full((480, 640), 2.5, np.float32))


def tartanair(folder: Path) -> None:
    """Write a frame of TartanAir."""
    tests = unit("test_format_tartanair")
    written(folder / "office/Easy/P000/image_left/000000_left.png", tests.photo())
    written(folder / "office/Easy/P000/depth_left/000000_left_depth.npy", tests.npy())


def dsr_weights(folder: Path) -> None:
    """Write weights of a training: of a small network, and a file that shares its tensors."""
    from dsr.methods.networks.msg_net import MSGNet  # noqa: PLC0415
    from dsr.methods.networks.weight_files import save_network  # noqa: PLC0415

    net = MSGNet(2, "dsr")
    save_network(folder / "base.safetensors", net, "msg_v", {"steps": 4})
    save_network(
        folder / "weights.safetensors", net, "msg_v", {"steps": 4}, links={"shared": folder / "base.safetensors"}
    )


def torch_weights(folder: Path) -> None:
    """Write the authors' file of MSG-Net: of torch's present and earlier format."""
    from dsr.methods.networks.msg_net import MSGNet  # noqa: PLC0415

    values = MSGNet(2, "voynov").state_dict()
    layers = [name.removesuffix(".conv.weight") for name in values if name.endswith(".conv.weight")]
    guidance = ("feature_extraction_Y.0", "feature_extraction_Y.1", "feature_extraction_X")
    theirs = dict(zip(layers, (*guidance, *(f"upsampling_X.{i}" for i in range(5))), strict=True))
    state = {f"{theirs[layer]}{name.removeprefix(layer)}": value
             for name, value in values.items() for layer in layers if name.startswith(f"{layer}.")}  # fmt: skip
    torch.save({"model_state_dict": state, "epoch": 3}, folder / "voynov.pth")
    torch.save({"model_state_dict": state}, folder / "earlier.pth", _use_new_zipfile_serialization=False)


def caffe_weights(folder: Path) -> None:
    """Write a Caffe model of a few layers."""

    def message(number: int, content: bytes) -> bytes:
        tag = number << 3 | 2
        head = bytes([tag]) if tag < 128 else bytes([tag & 127 | 128, tag >> 7])
        size = len(content)
        length = b""
        while size > 127:
            length, size = length + bytes([size & 127 | 128]), size >> 7
        return head + length + bytes([size]) + content

    blob = message(5, np.arange(6, dtype="<f4").tobytes()) + message(7, message(1, b"\2\3"))
    layers = [(b"conv", b"Convolution"), (b"relu", b"PReLU"), (b"up", b"Deconvolution")]
    content = b"".join(
        message(100, message(1, name) + message(2, kind) + message(7, blob) + message(7, blob)) for name, kind in layers
    )
    written(folder / "hui.caffemodel", content)


def peer_weights(folder: Path) -> None:
    """Write a network's tensors by name, in torch's formats."""
    state = {f"module.layer{i}.weight": torch.ones(3, 3) for i in range(4)}
    torch.save(state, folder / "peer.pth")
    torch.save(state, folder / "peer_old.pth", _use_new_zipfile_serialization=False)


def archives(folder: Path) -> None:
    """Write archives as data sets are published in."""
    with zipfile.ZipFile(folder / "set.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("set/a.txt", "set/b/c.txt"):
            archive.writestr(name, "content " * 40)
    for kind, suffix in (("gz", ".tar.gz"), ("", ".tar")):
        with tarfile.open(folder / f"set{suffix}", f"w:{kind}") as tar:  # type: ignore[call-overload]
            tar.add(folder / "set.zip", "set/inner.zip")
            link = tarfile.TarInfo("set/link")
            link.type, link.linkname = tarfile.SYMTYPE, "inner.zip"
            tar.addfile(link)


def checksums(folder: Path) -> None:
    """Write a record of downloaded files, and one of them."""
    written(folder / "books" / "b.txt", "content")
    digest = "ed7002b439e9ac845f22357d822bac1444730fbdb6016d3ec9432297b9ec9f73"
    entries = {"books/b.txt": {"sha256": digest, "size": 7}, "a.zip": {"sha256": None, "size": 9, "files": {"x": 1}}}
    written(folder / "checksums.json", json.dumps(entries))


def ros2(folder: Path) -> None:
    """Write a recording of ROS 2."""
    captures.ros(folder / "recording", 2)


def ros2_packed(folder: Path) -> None:
    """Write a recording of ROS 2 whose file is packed whole."""
    captures.ros(folder / "recording", 2, packed=True)


def kinect(folder: Path) -> None:
    """Write a recording of an Azure Kinect."""
    captures.kinect(folder / "scan.mkv", [captures.photo()] * 2, [np.full(captures.KINECT_DEPTH, 1000, np.uint16)] * 2)


def heic_beside_depth(folder: Path) -> None:
    """Write a HEIC photo and a depth map of its own file."""
    heic(folder)
    np.save(folder / "depth.npy", captures.depth())


def heic(folder: Path) -> None:
    """Write a HEIC photo with a depth map."""
    captures.heic(folder / "photo.heic", np.full(captures.HEIC_MAP, 99, np.uint8), text=captures.apple_text())


def ros2_alone(folder: Path) -> None:
    """Write a file of ROS 2 without the folder that it is of."""

    whole = captures.ros(folder.parent / "whole", 2, plugin="MCAP")
    (whole / "whole.mcap").rename(folder / "scan.mcap")
    shutil.rmtree(whole)


def r3d(folder: Path) -> None:
    """Write an archive of Record3D."""
    captures.record3d(folder / "scan.r3d")


def sens(folder: Path) -> None:
    """Write recordings of ScanNet, compressed in all ways."""
    captures.sens(folder / "a.sens", lost=(1,))
    captures.sens(folder / "b.sens", colour="raw", depth="raw", scale=5000.0)


def zipped(folder: Path) -> None:
    """Write a ZIP file of an export of 3D Scanner App."""
    captures.scanner_app(folder / "scan")
    with zipfile.ZipFile(folder / "scan.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted((folder / "scan").iterdir()):
            archive.write(path, f"scan/{path.name}")
    shutil.rmtree(folder / "scan")


def record3d_folder(folder: Path) -> None:
    """Write an unpacked archive of Record3D."""
    captures.record3d(folder.parent / "packed.r3d")
    with zipfile.ZipFile(folder.parent / "packed.r3d") as archive:
        archive.extractall(folder)
    (folder.parent / "packed.r3d").unlink()


def record3d_export(folder: Path) -> None:
    """Write an export of Record3D."""
    captures.record3d_export(folder)


def sintel(folder: Path) -> None:
    """Write a frame of MPI Sintel."""
    picture, *_ = unit("test_format_sintel").frame(folder)
    written(folder / "training/clean/alley_1/frame_0001.png", picture.read_bytes())

"""``dsr upsample``: depth super-resolution for your own photos and depth maps."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any, get_args

from rich.console import Console

from dsr.app.upsample.parts import MORE_PARTS, PARTS
from dsr.inference.options import DEFAULT, SIZES, WIDEST, Fill
from dsr.utils.limits import MOST_FACES, MOST_POINTS

_DESCRIPTION = """\
Upsample the depth maps of your own photos to the photos' resolution.

Give --rgb and --depth, or folders that hold both. The depth map has to be registered to the photo: the same view, the
same field of view, any size up to the photo's. What is not given is read from the files or assumed, and reported."""
_EXAMPLES = """\
examples:
  dsr upsample --rgb photo.jpg --depth depth.png -o out
  dsr upsample --rgb photo.jpg --depth depth.png --camera camera.json -o out
  dsr upsample --rgb photo.jpg --depth depth.exr --fov 70 --format exr --only depth,mesh -o out
  dsr upsample --rgb a.jpg b.jpg --depth a.png b.png --intrinsics 615 615 319.5 239.5 -o out
  dsr upsample --rgb rgb/ --depth depth/ --depth-unit 1/5000 -o out
  dsr upsample rgbd_dataset_freiburg1_xyz -o out
  dsr upsample scan.r3d --min-confidence 0.5 -o out
  dsr upsample --rgb photo.jpg --depth depth.png --method tgv --set data_weight=30 -o out
  dsr upsample recordings --with nerfstudio,open3d -o out
  dsr upsample --rgb photo.jpg --depth depth.png --depth-camera ir.json --extrinsics ir_to_rgb.txt -o out
  dsr upsample recording --poses groundtruth.txt --neighbours 4 -o out
  dsr upsample recordings --shard 3/16 -o out    the third of 16 parts, for a task of an array
  dsr upsample recordings --dry-run -o out       what would be done, and what would be assumed

The results of a single pair are in OUT, those of several in OUT/NAME: depth.* as the input is stored, depth_metres.npy,
renderings/, normals.png, cloud.ply, mesh.ply, mesh.glb, before_after.png, confidence.png, confidence.npz,
input.npz, and info.json with all settings and assumptions. Look at them with `dsr view OUT`. Run the same command again
to continue after an interruption. More in docs/upsample.md.
"""


def add(commands: Any) -> None:
    """Add the command to the parser's commands."""
    parser = commands.add_parser(
        "upsample",
        help="upsample the depth of your own photos",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    what = parser.add_argument_group("what to work on")
    what.add_argument(
        "folders", nargs="*", type=Path, metavar="FOLDER", help="folders of photos and depth maps, or captures"
    )
    what.add_argument("--rgb", nargs="+", type=Path, default=[], metavar="PHOTO", help="photos, or a folder of them")
    what.add_argument("--depth", nargs="+", type=Path, default=[], metavar="MAP", help="depth maps, one for each photo")
    what.add_argument(
        "--mask", nargs="+", type=Path, default=[], metavar="MASK", help="pictures, 0 where depth is missing"
    )
    what.add_argument(
        "--confidence", nargs="+", type=Path, default=[], metavar="MAP", help="confidence maps, or a folder of them"
    )
    what.add_argument(
        "--shard",
        metavar="K/N",
        help="only the K-th of N blocks of the frames, for a task of an array; see docs/sequences.md",
    )
    _add_reading(parser)
    _add_method(parser)
    _add_results(parser)
    parser.set_defaults(run=_run)


def _add_reading(parser: argparse.ArgumentParser) -> None:
    """Add the options of how to read the files."""
    reading = parser.add_argument_group(
        "how to read the files (if not given: read from the files, or assumed and reported)"
    )
    camera = reading.add_mutually_exclusive_group()
    camera.add_argument("--camera", type=Path, metavar="FILE", help="camera.json, Open3D's JSON, or a 3 x 3 matrix")
    camera.add_argument("--fov", type=float, metavar="DEGREES", help="horizontal field of view of the photo")
    camera.add_argument("--intrinsics", nargs=4, type=float, metavar=("FX", "FY", "CX", "CY"), help="photo pixels")
    reading.add_argument("--depth-unit", metavar="UNIT", help="m, cm, mm, metres per value: 0.0002, 1/5000; sunrgbd")
    types = ("orthogonal", "perspective", "disparity")
    reading.add_argument(
        "--range-type", choices=types, help="depth along the axis (default), along the ray, or disparity"
    )
    reading.add_argument("--baseline", type=float, metavar="METRES", help="between the cameras, for disparity")
    reading.add_argument("--depth-camera", type=Path, metavar="FILE", help="camera file of a depth camera elsewhere")
    reading.add_argument(
        "--extrinsics", type=Path, metavar="FILE", help="matrix from the depth camera to the photo's, metres"
    )
    reading.add_argument(
        "--register", action="store_true", help="move the depth map to the photo's edges, if it lies beside them"
    )
    reading.add_argument("--hole-value", type=float, metavar="VALUE", help="another value that marks missing depth")
    reading.add_argument(
        "--min-confidence",
        type=float,
        metavar="0..1",
        help="less confident pixels count as holes; levels 0, 1, 2 are 0, 0.5, 1",
    )


def _add_method(parser: argparse.ArgumentParser) -> None:
    """Add the options of the method."""
    method = parser.add_argument_group("method")
    method.add_argument(
        "--method",
        default=DEFAULT,
        metavar="NAME",
        help="facets (default), for clean and noisy depth; or another: tgv, guided_filter, dip_v, ...",
    )
    method.add_argument(
        "--noise", type=float, metavar="METRES", help="standard deviation of the depth map's noise (default: estimated)"
    )
    method.add_argument(
        "--smooth", type=float, metavar="0..2", help="0 keeps what may be noise, 2 smooths more; 1 is neutral"
    )
    method.add_argument(
        "--set",
        action="append",
        default=[],
        dest="settings",
        metavar="KEY=VALUE",
        help="an argument of the method, as in its file in conf/method: data_weight=30; may be repeated",
    )
    method.add_argument(
        "--config-dir",
        action="append",
        type=Path,
        default=[],
        metavar="DIR",
        help="a folder with a method/ of your own YAML files; may be repeated",
    )
    method.add_argument("--scale", type=int, metavar="N", help="upsampling factor (default: from the sizes)")
    method.add_argument(
        "--neighbours",
        type=int,
        default=0,
        metavar="N",
        help="frames of a folder that vote on each frame's depth, 4 for two on either side; needs poses",
    )
    method.add_argument("--poses", type=Path, metavar="FILE", help="camera poses: TUM's format, or 4 x 4 matrices")
    method.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="pictures at a time, each in its own process (default: 1)",
    )
    method.add_argument("--device", default="auto", metavar="DEVICE", help="auto (default), cpu, cuda, cuda:1, ...")
    method.add_argument("--fill", choices=get_args(Fill), default="small", help="which of the input's holes are filled")
    method.add_argument(
        "--max-hole",
        type=float,
        default=WIDEST,
        metavar="DEGREES",
        help="width of the widest hole that --fill small fills, degrees of view (default: 2)",
    )
    method.add_argument(
        "--working-size",
        choices=("auto", *map(str, SIZES)),
        default="auto",
        help="by what facets divides the map's size first; auto: as its noise suggests",
    )
    method.add_argument(
        "--sensor",
        default="auto",
        metavar="auto|none|NAME",
        help="what measured the depth, such as 'RealSense D435'; auto: as the depth values or the files tell",
    )


def _add_results(parser: argparse.ArgumentParser) -> None:
    """Add the options of the results."""
    results = parser.add_argument_group("what is written")
    results.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder of the results")
    results.add_argument("--format", metavar="FORMAT", help="of the depth: png, tiff, npy, npz, pfm, exr (the input's)")
    parts, more = ",".join(PARTS), ",".join(MORE_PARTS)
    chosen = results.add_mutually_exclusive_group()
    chosen.add_argument("--only", type=_words, metavar="PARTS", help=f"some of {parts},{more}")
    chosen.add_argument("--without", type=_words, default=(), metavar="PARTS", help="all but these")
    results.add_argument(
        "--max-error",
        type=float,
        default=2.0,
        metavar="PERCENT",
        help="leave pixels out of cloud and mesh whose depth is expected to be off by more (default: 2)",
    )
    results.add_argument(
        "--with", type=_words, default=(), dest="more", metavar="PARTS", help=f"also these: {more}; see docs/export.md"
    )
    for name, what, default in (
        ("faces", "simplify the mesh beyond N triangles", MOST_FACES),
        ("points", "thin the cloud beyond N points", MOST_POINTS),
    ):
        text = f"{what} (default: {default // 10**6} million)"
        results.add_argument(f"--max-{name}", type=int, default=default, metavar="N", help=text)
    results.add_argument("--overwrite", action="store_true", help="redo existing results, replace other ones")
    results.add_argument("--dry-run", action="store_true", help="read the files and say what would be done")


def _words(text: str) -> tuple[str, ...]:
    """Return the words between commas."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def _settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return the method's settings, those with an option of their own among them."""
    from dsr.app.upsample.request import SHORTCUTS  # noqa: PLC0415 - it is needed for this command alone
    from dsr.app.upsample.settings import parse_settings  # noqa: PLC0415

    settings = parse_settings(options.settings)
    for name in SHORTCUTS:
        value = getattr(options, name)
        if value is not None and name in settings:
            raise ValueError(f"--{name}: expected it once, got --set {name}={settings[name]}, too")
        if value is not None:
            settings[name] = value
    return settings


def _rig(options: argparse.Namespace) -> Any:
    """Return the files of a depth camera elsewhere than the photo's; None if there are none."""
    from dsr.io.reading import RigFiles  # noqa: PLC0415 - it is needed for this command alone

    if (options.depth_camera is None) != (options.extrinsics is None):
        given, missing = (
            ("--extrinsics", "--depth-camera") if options.extrinsics else ("--depth-camera", "--extrinsics")
        )
        raise ValueError(f"{given}: expected {missing} with it")
    return None if options.depth_camera is None else RigFiles(options.depth_camera, options.extrinsics)


def _run(options: argparse.Namespace, console: Console, _: object) -> list[str]:
    """Upsample, and return the problems."""
    from dsr.app.upsample.request import UpsampleRequest  # noqa: PLC0415 - they are needed for this command alone
    from dsr.io.reading import SUNRGBD_BITS, CameraChoice, Reading, parse_unit  # noqa: PLC0415
    from dsr.io.shards import parse_shard  # noqa: PLC0415

    intrinsics = None if options.intrinsics is None else tuple(options.intrinsics)
    unit = None if options.depth_unit is None else parse_unit(options.depth_unit)
    if options.baseline is not None and not 0 < options.baseline < float("inf"):
        raise ValueError(f"--baseline: expected a positive number of metres, got {options.baseline:g}")
    if options.hole_value is not None and math.isnan(options.hole_value):  # NaN always marks missing depth
        options.hole_value = None
    choice = CameraChoice(options.camera, options.fov, intrinsics)
    bits = SUNRGBD_BITS if options.depth_unit == "sunrgbd" else 0
    reading = Reading(
        choice,
        unit,
        options.range_type,
        options.baseline,
        options.hole_value,
        rig=_rig(options),
        min_confidence=options.min_confidence,
        turned_bits=bits,
    )
    unknown = [part for part in options.without if part not in PARTS]
    parts = options.only if options.only is not None else tuple(part for part in PARTS if part not in options.without)
    wanted = UpsampleRequest(
        output=options.output,
        folders=tuple(options.folders),
        rgb=tuple(options.rgb),
        depth=tuple(options.depth),
        mask=tuple(options.mask),
        confidence=tuple(options.confidence),
        reading=reading,
        method=options.method,
        settings=_settings(options),
        directories=tuple(options.config_dir),
        scale=options.scale,
        device=options.device,
        fill=options.fill,
        max_hole=options.max_hole,
        working_size=None if options.working_size == "auto" else int(options.working_size),
        sensor=options.sensor,
        max_error=options.max_error / 100,
        depth_format=options.format,
        max_faces=options.max_faces,
        max_points=options.max_points,
        shard=None if options.shard is None else parse_shard(options.shard),
        workers=options.workers,
        register=options.register,
        neighbours=options.neighbours,
        poses=options.poses,
        parts=tuple(dict.fromkeys((*parts, *options.more, *unknown))),
        overwrite=options.overwrite,
        dry_run=options.dry_run,
    )
    from dsr.app.upsample.run import run  # noqa: PLC0415 - it takes seconds to import: after all values are checked

    return run(wanted, console)

"""``dsr upsample``: depth super-resolution for your own photos and depth maps."""

from __future__ import annotations

from rich.console import Console

from dsr.app.upsample.request import UpsampleRequest
from dsr.cli.command import Command

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


def _run(request: UpsampleRequest, console: Console, _: object) -> list[str]:
    """Upsample, and return the problems."""
    from dsr.app.upsample.run import run  # noqa: PLC0415 - it takes seconds to import: after the values are checked

    return run(request, console)


add = Command("upsample", "upsample the depth of your own photos", UpsampleRequest, _run, _EXAMPLES, _DESCRIPTION).add

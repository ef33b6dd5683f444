"""Readers of a single file: what writes a valid one, and what reads it."""

import json

import captures
import cv2
import numpy as np
import torch
from scipy.io import savemat

from dsr.data.matlab import read_variables
from dsr.evaluation.results import load_prediction
from dsr.io.cameras import read_any_camera, read_camera
from dsr.io.captures.record3d import read_archive
from dsr.io.depth_files import DEPTH_SUFFIXES, read_depth_file, write_depth_file
from dsr.io.exports import read_input, write_input
from dsr.io.images import read_mask
from dsr.io.photos import read_photo
from dsr.io.trajectories import read_poses, read_transform
from dsr.methods.networks.msg_net import MSGNet
from dsr.methods.networks.trained import NETWORKS
from dsr.methods.networks.weight_files import load_network, save_network
from dsr.report.study.files import Candidate, Key, Trial, read_key, write_key
from dsr.utils.arrays import read_torch_file

DEPTH = np.linspace(1, 2, 48 * 64, dtype=np.float32).reshape(48, 64)
NOISE = np.random.default_rng(0).integers(1, 60_000, (48, 64, 3)).astype(np.uint16)
INTRINSICS = {"width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5}
CANDIDATES = {name: Candidate(name, name, "runs") for name in ("a", "b")}
KEY = Key("0123", "e4", 1, 0, {"s1": Trial("simgeo", "cube", 4, "box", CANDIDATES)})


def depth_file(path):
    write_depth_file(path, NOISE[..., 0] if path.suffix == ".png" else DEPTH)


def picture(path):
    cv2.imwrite(str(path), NOISE.astype(np.uint8))


def text(content):
    return lambda path: path.write_text(content)


def read_picture_file(path):
    return read_photo(path, (8, 8))


def read_capture(path):
    return [pair.capture.photo.read() for pair in read_archive(path).pairs]


READERS = {
    **{f"depth{suffix}": (depth_file, read_depth_file) for suffix in DEPTH_SUFFIXES},
    **{f"photo{suffix}": (picture, read_picture_file) for suffix in (".png", ".jpg", ".webp")},
    "mask.png": (picture, read_mask),
    "input.npz": (lambda path: write_input(path, torch.rand(3, 48, 64), torch.from_numpy(DEPTH)[None]), read_input),
    "prediction.npz": (lambda path: np.savez(path, depth=DEPTH, config="{}", seconds=1.0), load_prediction),
    "camera.json": (text(json.dumps(INTRINSICS)), read_camera),
    "camera.txt": (text("60 0 31\n0 60 24\n0 0 1"), read_any_camera),
    "transform.txt": (text("1 0 0 0 0 1 0 0 0 0 1 0"), read_transform),
    "poses.txt": (text("1 0 0 0 0 1 0 0 0 0 1 0"), read_poses),
    "weights.pth": (lambda path: torch.save({"weight": torch.rand(2000)}, path), read_torch_file),
    "weights.safetensors": (
        lambda path: save_network(path, MSGNet(2, "dsr"), "msg_v"), lambda path: load_network(path, NETWORKS)
    ),
    "x.mat": (lambda path: savemat(path, {"depth": DEPTH}, do_compression=True), read_variables),
    "scan.r3d": (captures.record3d, read_capture),
    "key.json": (lambda path: write_key(path, KEY), read_key),
}  # fmt: skip

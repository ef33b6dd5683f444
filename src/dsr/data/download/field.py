"""The part of the catalogue that guided depth super-resolution has been evaluated on since 2019."""

from __future__ import annotations

from collections.abc import Sequence

from dsr.data.download.collection import CITE_2001, CITE_2006, MIDDLEBURY, RESEARCH, Collection, Item

_DDRNET = "https://github.com/neycyanshi/DDRNet"
_DDRNET_FILES = "https://raw.githubusercontent.com/neycyanshi/DDRNet/28771990f22ad5b5a917f911058e1304b8d2697d/dataset"
_DDRNET_FOLDERS = ("color_map", "depth_map", "high_quality_depth")
_DCTNET = "https://github.com/Zhaozixiang1228/GDSR-DCTNet"
_DCTNET_FILES = (
    "https://raw.githubusercontent.com/Zhaozixiang1228/GDSR-DCTNet/5243875223398fd7996bca2e54dc2792bb96862a/RawDatasets"
)
"""Test images of the field, at the commit of which the files are known."""
_RGBDD = "https://github.com/lingzhi96/RGB-D-D-Dataset"
_RGBDD_TERMS = "For non-commercial research; its owners ask for a signed agreement."
_CITE_RGBDD = (
    "L. He, H. Zhu, F. Li, H. Bai, R. Cong, C. Zhang, C. Lin, M. Liu, Y. Zhao: Towards fast and accurate real-world "
    "depth super-resolution: benchmark dataset and baseline. CVPR 2021."
)
_CITE_LU = "S. Lu, X. Ren, F. Liu: Depth enhancement via low-rank matrix completion. CVPR 2014."


def _levels(folder: str, source: str, names: Sequence[str], spelling: str) -> tuple[Item, ...]:
    """Return the photos and maps of an 8-bit benchmark."""
    paths = [path for name in names for path in (f"RGB/{name}_{spelling}_color.png", f"Depth/{name}_output_depth.png")]
    return tuple(Item(f"{folder}/{path}", (f"{_DCTNET_FILES}/{source}/{path}",)) for path in paths)


def _ddrnet() -> tuple[Item, ...]:
    """Return the frames that DDRNet's authors publish."""
    frames = [f"20170907/group1/{{}}/frame_{number:06d}.png" for number in range(1, 21)]
    frames += [f"20170907/group2/{{}}/frame_{number:06d}.png" for number in range(1, 3)]
    paths = [frame.format(folder) for frame in frames for folder in _DDRNET_FOLDERS]
    return tuple(Item(f"ddrnet/{path}", (f"{_DDRNET_FILES}/{path}",)) for path in paths)


FIELD = (
    Collection(
        "lu",
        "Lu's six pairs of a structured-light sensor, 8 bits, as the field evaluates on them",
        _DCTNET,
        RESEARCH,
        _CITE_LU,
        ("lu",),
        1.9e6,
        _levels("lu", "Lu", [f"RGBD_{number:02d}" for number in range(1, 7)], "ouput"),
    ),
    Collection(
        "middlebury8",
        "Thirty pairs of Middlebury 2001 to 2006, 8 bits, as the field evaluates on them",
        _DCTNET,
        MIDDLEBURY,
        f"{CITE_2001} {CITE_2006} {_CITE_LU}",
        ("middlebury8",),
        8.8e6,
        _levels("middlebury8", "Middlebury", [f"Middlebury_{number:02d}" for number in range(1, 31)], "output"),
    ),
    Collection(
        "ddrnet",
        "22 frames of a structured-light camera with fused depth",
        _DDRNET,
        "MIT licence.",
        "S. Yan, C. Wu, L. Wang, F. Xu, L. An, K. Guo, Y. Liu: DDRNet: depth map denoising and refinement for consumer "
        "depth cameras using cascaded CNNs. ECCV 2018.",
        ("ddrnet",),
        12.3e6,
        _ddrnet(),
    ),
    Collection(
        "rgbdd",
        "RGB-D-D, photos with a time-of-flight sensor's depth",
        _RGBDD,
        _RGBDD_TERMS,
        _CITE_RGBDD,
        ("rgbdd",),
        None,
        manual="get the set from its owners (an agreement has to be signed), or RawDatasets/RGBDD, the 405 test "
        f"images, from {_DCTNET}, and put RGB and Depth, or models, plants and portraits, anywhere below {{folder}}",
        patterns=("**/*_RGB.jpg", "**/*_HR_gt.png"),
    ),
    Collection(
        "rgbdd_real",
        "RGB-D-D, photos with a time-of-flight sensor's depth and a phone's",
        _RGBDD,
        _RGBDD_TERMS,
        _CITE_RGBDD,
        ("rgbdd_real",),
        None,
        manual="get the set from its owners (an agreement has to be signed), or RawDatasets/RGBDD_Test_Realscene, "
        f"3 images of it, from {_DCTNET}, and put RGB, Depth and DepthLR, or models, plants and portraits, anywhere "
        "below {folder}",
        patterns=("**/*_RGB.jpg", "**/*_HR_gt.png", "**/*_LR_fill_depth.png"),
    ),
    Collection(
        "arkitscenes",
        "ARKitScenes, a tablet's lidar beside a laser scanner's depth",
        "https://github.com/apple/ARKitScenes",
        "Its owners' own licence, for non-commercial use: see the homepage.",
        "G. Baruch, Z. Chen, A. Dehghan, T. Dimry, Y. Feigin, P. Fu, T. Gebauer, B. Joffe, D. Kurz, A. Schwartz, "
        "E. Shulman: ARKitScenes: a diverse real-world dataset for 3D indoor scene understanding using mobile RGB-D "
        "data. NeurIPS Datasets and Benchmarks 2021.",
        ("arkitscenes",),
        None,
        manual="fetch videos with its download_data.py (data set upsampling) and put Training and Validation anywhere "
        "below {folder}",
        patterns=("**/highres_depth/*.png", "**/lowres_depth/*.png"),
    ),
    Collection(
        "diml",
        "DIML/CVL RGB-D, rooms before a Kinect v2",
        "https://dimlrgbd.github.io/",
        RESEARCH,
        "J. Cho, D. Min, Y. Kim, K. Sohn: DIML/CVL RGB-D dataset: 2M RGB-D images of natural indoor and outdoor "
        "scenes. arXiv 2110.11590, 2021.",
        ("diml",),
        None,
        manual="fetch the indoor sample data from its homepage and put test and train, with HR or LR in each, anywhere "
        "below {folder}",
        patterns=("**/color/*_c.png", "**/depth_filled/*_depth_filled.png"),
    ),
)
"""The collections."""

"""The data sets that ``dsr data`` knows: who made them, on which terms, where they are, what they consist of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dsr.utils.guards import did_you_mean

MIDDLEBURY = "Its owners permit using and publishing the images and disparity maps, and ask for the citation."
RESEARCH = "Its owners state no licence: for research, see the homepage."
CITE_2006 = "H. Hirschmüller, D. Scharstein: Evaluation of cost functions for stereo matching. CVPR 2007."
CITE_2001 = (
    "D. Scharstein, R. Szeliski: A taxonomy and evaluation of dense two-frame stereo correspondence algorithms. "
    "IJCV 47, 2002."
)

_DDRNET = "https://github.com/neycyanshi/DDRNet"
_DDRNET_FILES = "https://raw.githubusercontent.com/neycyanshi/DDRNet/28771990f22ad5b5a917f911058e1304b8d2697d/dataset"
_DDRNET_FOLDERS = ("color_map", "depth_map", "high_quality_depth")
_DCTNET = "https://github.com/Zhaozixiang1228/GDSR-DCTNet"
_DCTNET_FILES = (
    "https://raw.githubusercontent.com/Zhaozixiang1228/GDSR-DCTNet/5243875223398fd7996bca2e54dc2792bb96862a/RawDatasets"
)
"""Test images of the field, at the commit of which the files are known."""
_BOARD = "https://github.com/alr-internship/self-supervised-depth-denoising"
_BOARD_FILES = (
    "https://raw.githubusercontent.com/alr-internship/self-supervised-depth-denoising/"
    "c73b3566db0188a0961f382509db0df424510f98"
)
"""At a commit of 2021; later ones keep these files elsewhere."""
_CLEARGRASP = "https://github.com/Shreeyak/cleargrasp"
_CLEARGRASP_FILES = (
    "https://raw.githubusercontent.com/Shreeyak/cleargrasp/0688647e49380139e440bacbe8562132bb2afbd7/data/sample_dataset"
)
_CITE_CLEARGRASP = (
    "S. S. Sajjan, M. Moore, M. Pan, G. Nagaraja, J. Lee, A. Zeng, S. Song: ClearGrasp: 3D shape estimation of "
    "transparent objects for manipulation. ICRA 2020."
)
_RGBDD = "https://github.com/lingzhi96/RGB-D-D-Dataset"
_RGBDD_TERMS = "For non-commercial research; its owners ask for a signed agreement."
_CITE_RGBDD = (
    "L. He, H. Zhu, F. Li, H. Bai, R. Cong, C. Zhang, C. Lin, M. Liu, Y. Zhao: Towards fast and accurate real-world "
    "depth super-resolution: benchmark dataset and baseline. CVPR 2021."
)
_CITE_LU = "S. Lu, X. Ren, F. Liu: Depth enhancement via low-rank matrix completion. CVPR 2014."


@dataclass(frozen=True)
class Item:
    """A file to fetch.

    Args:
        path: below the directory of the data sets, with slashes; a mirror has the file under the same path.
        urls: where it is, tried in order; ``ADDRESS#NAME`` is the member NAME of a zip archive.
        unpack_to: the directory, below that of the data sets, that the archive is unpacked into; None for a file that
            stays as it is.
        contains: what there must be in ``unpack_to`` afterwards, such as ``training/final``.
        sha256: of the file, where it is known beforehand.

    """

    path: str
    urls: tuple[str, ...]
    unpack_to: str | None = None
    contains: tuple[str, ...] = ()
    sha256: str | None = None


@dataclass(frozen=True)
class Collection:
    """Files that go together.

    Args:
        name: as it is typed.
        title: what it is, a few words.
        homepage: address of its page.
        licence: its terms, as far as its owners state them.
        citation: authors, title, venue, year.
        folders: its directories below that of the data sets.
        size: of the downloads in bytes, about; None where that is not known.
        items: what is fetched; empty where nobody but the user can.
        manual: how to get it by hand, with ``{folder}`` for its directory; None where ``items`` are all there is.
        patterns: of the files that the user puts into the first of ``folders``, as for :meth:`pathlib.Path.glob`.

    """

    name: str
    title: str
    homepage: str
    licence: str
    citation: str
    folders: tuple[str, ...]
    size: float | None
    items: tuple[Item, ...] = field(default=(), repr=False)
    manual: str | None = None
    patterns: tuple[str, ...] = ()

    def instruction(self, root: Path) -> str:
        """Return how to get it by hand."""
        return (self.manual or "").format(folder=root / self.folders[0])


_PINNED = {
    path: digest
    for digest, _, path in (
        line.partition("  ") for line in Path(__file__).with_name("pinned.sha256").read_text("utf-8").splitlines()
    )
}
"""SHA-256 of files that never change, by their paths, as ``sha256sum`` writes them.

Those are files of a commit of git, whose number vouches for their content; they were computed from these commits.
"""


def _levels(folder: str, source: str, names: Sequence[str], spelling: str) -> tuple[Item, ...]:
    """Return the photos and maps of an 8-bit benchmark."""
    paths = [path for name in names for path in (f"RGB/{name}_{spelling}_color.png", f"Depth/{name}_output_depth.png")]
    return _of_commit(folder, f"{_DCTNET_FILES}/{source}", paths)


def _ddrnet() -> tuple[Item, ...]:
    """Return the frames that DDRNet's authors publish."""
    frames = [f"20170907/group1/{{}}/frame_{number:06d}.png" for number in range(1, 21)]
    frames += [f"20170907/group2/{{}}/frame_{number:06d}.png" for number in range(1, 3)]
    paths = [frame.format(folder) for frame in frames for folder in _DDRNET_FOLDERS]
    return _of_commit("ddrnet", _DDRNET_FILES, paths)


def _cleargrasp() -> tuple[Item, ...]:
    """Return the captures that ClearGrasp's authors publish with their code."""
    kinds = ("transparent-rgb-img.jpg", "transparent-depth-img.exr", "opaque-depth-img.exr", "mask.png")
    files = [f"{number:09d}-{kind}" for number in (80, 123, 130, 153) for kind in kinds]
    paths = [f"real-val/d435/{file}" for file in (*files, "camera_intrinsics.yaml")]
    return _of_commit("cleargrasp", _CLEARGRASP_FILES, paths)


def _cleargrasp_synthetic() -> tuple[Item, ...]:
    """Return the renderings that they publish with it."""
    kinds = (
        "rgb-imgs/{:09d}-rgb.jpg", "depth-imgs-rectified/{:09d}-depth-rectified.exr",
        "segmentation-masks/{:09d}-segmentation-mask.png",
    )  # fmt: skip
    paths = [f"synthetic-val/square-plastic-bottle-val/{kind.format(n)}" for n in (0, 2, 4) for kind in kinds]
    return _of_commit("cleargrasp_synthetic", _CLEARGRASP_FILES, paths)


def _of_commit(folder: str, base: str, paths: Sequence[str]) -> tuple[Item, ...]:
    """Return files of a commit, whose checksums are pinned."""
    return tuple(Item(f"{folder}/{path}", (f"{base}/{path}",), sha256=_PINNED[f"{folder}/{path}"]) for path in paths)


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
        "stereo_board",
        "Five pairs of a stereo camera before a board, an exact plane",
        _BOARD,
        "MIT licence.",
        "C. Kienle, D. Petri: Multi-object self-supervised depth denoising. arXiv 2305.05778, 2023.",
        ("stereo_board",),
        17e6,
        _of_commit(
            "stereo_board",
            f"{_BOARD_FILES}/resources/images/uncalibrated/realsense",
            [f"{folder}/{number}.png" for number in (8, 14, 19, 25, 31) for folder in ("color", "depth")],
        ),
    ),
    Collection(
        "cleargrasp",
        "ClearGrasp, glass before a stereo camera and painted twins: the 4 captures that come with its code",
        _CLEARGRASP,
        "Apache License 2.0, as the code that they come with.",
        _CITE_CLEARGRASP,
        ("cleargrasp",),
        3.0e6,
        _cleargrasp(),
    ),
    Collection(
        "cleargrasp_synthetic",
        "ClearGrasp, rendered glass: the 3 scenes that come with its code",
        _CLEARGRASP,
        "Apache License 2.0, as the code that they come with.",
        _CITE_CLEARGRASP,
        ("cleargrasp_synthetic",),
        3.2e6,
        _cleargrasp_synthetic(),
    ),
    Collection(
        "ibims",
        "iBims-1, 100 rooms before a laser scanner, with their planes and edges marked",
        "https://doi.org/10.14459/2018mp1455541",
        "Its terms are on its homepage.",
        "T. Koch, L. Liebel, F. Fraundorfer, M. Körner: Evaluation of CNN-based single-image depth estimation methods. "
        "ECCV Workshops 2018.",
        ("ibims",),
        None,
        manual="fetch ibims1_core_mat.zip or ibims1_core_raw.zip from its homepage and unpack it below {folder}",
        patterns=("**/*_[0-9]*.*",),
    ),
    Collection(
        "hammer",
        "HAMMER, glass and metal before three depth cameras, with a scanner's truth",
        "https://github.com/Junggy/HAMMER-dataset",
        RESEARCH,
        "H. Jung, P. Ruhkamp, G. Zhai, N. Brasch, Y. Li, Y. Verdie, J. Song, Y. Zhou, A. Armagan, S. Ilic, A. "
        "Leonardis, N. Navab, B. Busam: On the importance of accurate geometry data for dense 3D vision tasks. CVPR "
        "2023.",
        ("hammer",),
        None,
        manual="fetch _dataset_processed.zip by the link in its README and unpack it, or its scenes 12 to 14 to "
        "evaluate on, below {folder}",
        patterns=("**/polarization/_gt/*.png", "**/polarization/depth_d435/*.png"),
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
)


def find(names: Iterable[str], catalogue: Mapping[str, Collection]) -> list[Collection]:
    """Return the collections of these names, each once."""
    unknown = [name for name in names if name not in catalogue]
    if unknown:
        expected = f"expected some of {', '.join(catalogue)}{did_you_mean(unknown[0], catalogue)}"
        raise ValueError(f"{', '.join(unknown)}: unknown data set; {expected}")
    return [catalogue[name] for name in dict.fromkeys(names)]


_STEREO = "https://vision.middlebury.edu/stereo/data"

EVALUATION_2014 = ("Vintage", "Recycle", "Umbrella", "Classroom1", "Playroom", "Backpack", "Jadeplant")
"""The scenes of Middlebury 2014 that Voynov et al. (ICCV 2019) evaluate on."""
TRAINING_2014 = (
    "Adirondack", "Bicycle1", "Cable", "Couch", "Flowers", "Mask", "Motorcycle", "Piano", "Pipes", "Playtable",
    "Shelves", "Shopvac", "Sticks", "Storage", "Sword1", "Sword2",
)  # fmt: skip
"""The others of Middlebury 2014 whose disparity is public."""
SCENES_2006 = (
    "Aloe", "Baby1", "Baby2", "Baby3", "Bowling1", "Bowling2", "Cloth1", "Cloth2", "Cloth3", "Cloth4", "Flowerpots",
    "Lampshade1", "Lampshade2", "Midd1", "Midd2", "Monopoly", "Plastic", "Rocks1", "Rocks2", "Wood1", "Wood2",
)  # fmt: skip
SCENES_2005 = ("Art", "Books", "Dolls", "Laundry", "Moebius", "Reindeer")
SCENES_2003 = ("cones", "teddy")
SCENES_2001 = ("barn1", "barn2", "bull", "poster", "sawtooth", "venus")


def _files(folder: str, scenes: Sequence[str], base: str, names: Sequence[str]) -> tuple[Item, ...]:
    """Return single files, the same ones of each scene."""
    return tuple(Item(f"{folder}/{scene}/{name}", (f"{base}/{scene}/{name}",)) for scene in scenes for name in names)


def _full_size(folder: str, scenes: Sequence[str], base: str) -> tuple[Item, ...]:
    """Return the files of scenes of 2005 or 2006, which the archives of two views have, too."""
    return tuple(
        Item(item.path, (*item.urls, f"{base}/zip-2views/{scene}-2views.zip#{scene}/{Path(item.path).name}"))
        for scene in scenes
        for item in _files(folder, (scene,), base, ("view1.png", "disp1.png", "dmin.txt"))
    )


def _perfect(scenes: Sequence[str]) -> tuple[Item, ...]:
    """Return the files of scenes of 2014, of those with perfectly rectified cameras."""
    folders = [f"{scene}-perfect" for scene in scenes]
    return _files("middlebury2014", folders, f"{_STEREO}/scenes2014/datasets", ("im0.png", "calib.txt", "disp0.pfm"))


_ITEMS_2006 = _full_size("middlebury2006", SCENES_2006, f"{_STEREO}/scenes2006/FullSize")
_ITEMS_2001 = _files("middlebury2001", SCENES_2001, f"{_STEREO}/scenes2001/data", ("im2.ppm", "disp2.pgm"))
_CITE_2014 = (
    "D. Scharstein, H. Hirschmüller, Y. Kitajima, G. Krathwohl, N. Nešić, X. Wang, P. Westling: High-resolution stereo "
    "datasets with subpixel-accurate ground truth. GCPR 2014."
)


def _icl(room: str, archive: str) -> tuple[Item, ...]:
    """Return the four trajectories of a room; the office's archives do not say that they are the office's."""
    return tuple(
        Item(
            f"icl_nuim/{room}_traj{number}_frei_png.tar.gz",
            (f"https://www.doc.ic.ac.uk/~ahanda/{archive}traj{number}_frei_png.tar.gz",),
            unpack_to=f"icl_nuim/{room}_traj{number}",
            contains=("rgb", "depth"),
        )
        for number in range(4)
    )


def _sintel(path: str, contains: tuple[str, ...]) -> Item:
    name = path.rpartition("/")[2]
    hosts = ("https://files.is.tue.mpg.de", "http://files.is.tue.mpg.de")
    return Item(f"sintel/{name}", tuple(f"{host}/{path}" for host in hosts), unpack_to="sintel", contains=contains)


_COLLECTIONS = (
    Collection(
        "middlebury",
        f"Middlebury 2014, the paper's {len(EVALUATION_2014)} evaluation scenes",
        f"{_STEREO}/scenes2014/",
        MIDDLEBURY,
        _CITE_2014,
        ("middlebury2014",),
        0.25e9,
        _perfect(EVALUATION_2014),
    ),
    Collection(
        "middlebury_train",
        "Middlebury 2014 (the other 16 scenes), 2006 and 2001",
        f"{_STEREO}/",
        MIDDLEBURY,
        f"{_CITE_2014} {CITE_2006} {CITE_2001}",
        ("middlebury2014", "middlebury2006", "middlebury2001"),
        0.65e9,
        _perfect(TRAINING_2014) + _ITEMS_2006 + _ITEMS_2001,
    ),
    Collection(
        "middlebury2006",
        f"Middlebury 2006, {len(SCENES_2006)} scenes",
        f"{_STEREO}/scenes2006/",
        MIDDLEBURY,
        CITE_2006,
        ("middlebury2006",),
        50e6,
        _ITEMS_2006,
    ),
    Collection(
        "middlebury2005",
        f"Middlebury 2005, {len(SCENES_2005)} scenes",
        f"{_STEREO}/scenes2005/",
        MIDDLEBURY,
        f"D. Scharstein, C. Pal: Learning conditional random fields for stereo. CVPR 2007. {CITE_2006}",
        ("middlebury2005",),
        15e6,
        _full_size("middlebury2005", SCENES_2005, f"{_STEREO}/scenes2005/FullSize"),
    ),
    Collection(
        "middlebury2003",
        "Middlebury 2003, cones and teddy",
        f"{_STEREO}/scenes2003/",
        MIDDLEBURY,
        "D. Scharstein, R. Szeliski: High-accuracy stereo depth maps using structured light. CVPR 2003.",
        ("middlebury2003",),
        1e6,
        _files("middlebury2003", SCENES_2003, f"{_STEREO}/scenes2003/newdata", ("im2.png", "disp2.png")),
    ),
    Collection(
        "middlebury2001",
        f"Middlebury 2001, {len(SCENES_2001)} planar scenes",
        f"{_STEREO}/scenes2001/",
        MIDDLEBURY,
        CITE_2001,
        ("middlebury2001",),
        4e6,
        _ITEMS_2001,
    ),
    Collection(
        "icl",
        "ICL-NUIM, rendered living room and office, 4 trajectories each",
        "https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html",
        "Creative Commons Attribution 3.0 (CC BY 3.0).",
        "A. Handa, T. Whelan, J. McDonald, A. J. Davison: A benchmark for RGB-D visual odometry, 3D reconstruction and "
        "SLAM. ICRA 2014.",
        ("icl_nuim",),
        4.4e9,
        _icl("living_room", "living_room_") + _icl("office_room", ""),
    ),
    Collection(
        "sunrgbd",
        "SUN RGB-D, four kinds of depth camera",
        "https://rgbd.cs.princeton.edu/",
        RESEARCH,
        "S. Song, S. P. Lichtenberg, J. Xiao: SUN RGB-D: a RGB-D scene understanding benchmark suite. CVPR 2015. Parts "
        "of it are NYU Depth v2, Berkeley B3DO and SUN3D: its homepage asks to cite these, too.",
        ("sunrgbd",),
        6.4e9,
        (
            Item(
                "sunrgbd/SUNRGBD.zip",
                ("https://rgbd.cs.princeton.edu/data/SUNRGBD.zip",),
                unpack_to="sunrgbd",
                contains=("SUNRGBD",),
            ),
        ),
    ),
    Collection(
        "tofmark",
        "ToFMark, time-of-flight depth with measured ground truth",
        "https://rvlab.icg.tugraz.at/tofmark/",
        RESEARCH,
        "D. Ferstl, C. Reinbacher, R. Ranftl, M. Rüther, H. Bischof: Image guided depth upsampling using anisotropic "
        "total generalized variation. ICCV 2013.",
        ("tofmark",),
        None,
        manual="get the set from its homepage or its authors and put benchmarking_dataset_*.mat into {folder}",
        patterns=("benchmarking_dataset_*.mat",),
    ),
    Collection(
        "sintel",
        "MPI Sintel, training images with depth and cameras",
        "http://sintel.is.tue.mpg.de/",
        "Made from the film Sintel, (c) Blender Foundation, CC BY 3.0; terms of the data set: see the homepage.",
        "D. J. Butler, J. Wulff, G. B. Stanley, M. J. Black: A naturalistic open source movie for optical flow "
        "evaluation. ECCV 2012. J. Wulff, D. J. Butler, G. B. Stanley, M. J. Black: Lessons and insights from creating "
        "a synthetic optical flow benchmark. ECCV workshops 2012.",
        ("sintel",),
        3.4e9,
        (
            _sintel("sintel/MPI-Sintel-training_images.zip", ("training/final", "training/clean")),
            _sintel(
                "jwulff/sintel/MPI-Sintel-depth-training-20150305.zip", ("training/depth", "training/camdata_left")
            ),
        ),
    ),
    Collection(
        "nyu",
        "NYU Depth v2, the 1449 labelled frames",
        "https://cs.nyu.edu/~fergus/datasets/nyu_depth_v2.html",
        RESEARCH,
        "N. Silberman, D. Hoiem, P. Kohli, R. Fergus: Indoor segmentation and support inference from RGBD images. "
        "ECCV 2012.",
        ("nyu_v2",),
        2.8e9,
        (
            Item(
                "nyu_v2/nyu_depth_v2_labeled.mat",
                ("http://horatio.cs.nyu.edu/mit/silberman/nyu_depth_v2/nyu_depth_v2_labeled.mat",),
            ),
        ),
    ),
    Collection(
        "tartanair",
        "TartanAir, rendered flights through many scenes",
        "https://theairlab.org/tartanair-dataset/",
        "Its terms are on its homepage.",
        "W. Wang, D. Zhu, X. Wang, Y. Hu, Y. Qiu, C. Wang, Y. Hu, A. Kapoor, S. Scherer: TartanAir: a dataset to push "
        "the limits of visual SLAM. IROS 2020.",
        ("tartanair",),
        None,
        manual="fetch any environment with the tool of its homepage and put its trajectories, such as "
        "P000/image_left/*.png and P000/depth_left/*.npy, anywhere below {folder}",
        patterns=("**/image_left/*.png", "**/depth_left/*.npy"),
    ),
)
CATALOGUE: dict[str, Collection] = {collection.name: collection for collection in (*_COLLECTIONS, *FIELD)}

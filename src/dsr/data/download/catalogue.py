"""The data sets that ``dsr data`` knows: who made them, on which terms, where they are, what they consist of."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from dsr.data.download.collection import CITE_2001, CITE_2006, MIDDLEBURY, RESEARCH, Collection, Item
from dsr.data.download.field import FIELD


def find(names: Iterable[str], catalogue: Mapping[str, Collection]) -> list[Collection]:
    """Return the collections of these names, each once.

    Raises:
        ValueError: a name is unknown.

    """
    unknown = [name for name in names if name not in catalogue]
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: unknown data set; expected some of {', '.join(catalogue)}")
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

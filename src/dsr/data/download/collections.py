"""The data sets that ``dsr data`` knows: ``collections.yaml`` describes them, and this module lists their files."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from dsr.utils.guards import did_you_mean

_STEREO = "https://vision.middlebury.edu/stereo/data"
_COMMITS = "https://raw.githubusercontent.com"
_DDRNET = f"{_COMMITS}/neycyanshi/DDRNet/28771990f22ad5b5a917f911058e1304b8d2697d/dataset"
_DCTNET = f"{_COMMITS}/Zhaozixiang1228/GDSR-DCTNet/5243875223398fd7996bca2e54dc2792bb96862a/RawDatasets"
_BOARD = (  # of 2021; later commits keep these files elsewhere
    f"{_COMMITS}/alr-internship/self-supervised-depth-denoising/c73b3566db0188a0961f382509db0df424510f98"
    "/resources/images/uncalibrated/realsense"
)
_CLEARGRASP = f"{_COMMITS}/Shreeyak/cleargrasp/0688647e49380139e440bacbe8562132bb2afbd7/data/sample_dataset"

# Scenes of Middlebury: those of 2014 that Voynov et al. (ICCV 2019) evaluate on, and the others with public disparity
EVALUATION_2014 = ("Vintage", "Recycle", "Umbrella", "Classroom1", "Playroom", "Backpack", "Jadeplant")
TRAINING_2014 = (
    "Adirondack", "Bicycle1", "Cable", "Couch", "Flowers", "Mask", "Motorcycle", "Piano", "Pipes", "Playtable",
    "Shelves", "Shopvac", "Sticks", "Storage", "Sword1", "Sword2",
)  # fmt: skip
SCENES_2006 = (
    "Aloe", "Baby1", "Baby2", "Baby3", "Bowling1", "Bowling2", "Cloth1", "Cloth2", "Cloth3", "Cloth4", "Flowerpots",
    "Lampshade1", "Lampshade2", "Midd1", "Midd2", "Monopoly", "Plastic", "Rocks1", "Rocks2", "Wood1", "Wood2",
)  # fmt: skip
SCENES_2005 = ("Art", "Books", "Dolls", "Laundry", "Moebius", "Reindeer")
SCENES_2003 = ("cones", "teddy")
SCENES_2001 = ("barn1", "barn2", "bull", "poster", "sawtooth", "venus")


@dataclass(frozen=True)
class Item:
    """A file to fetch."""

    path: str  # below the directory of the data sets, with slashes; a mirror has the file under the same path
    urls: tuple[str, ...]  # tried in order; ADDRESS#NAME is the member NAME of a zip archive
    unpack_to: str | None = None  # directory that an archive is unpacked into, below that of the data sets
    contains: tuple[str, ...] = ()  # what there must be in it afterwards, such as "training/final"
    sha256: str | None = None  # where it is known beforehand


@dataclass(frozen=True)
class Collection:
    """Files that go together."""

    name: str  # as it is typed
    title: str
    homepage: str
    licence: str  # its terms, as far as its owners state them
    citation: str
    folders: tuple[str, ...]  # below the directory of the data sets
    size: float | None  # of the downloads in bytes, about
    items: tuple[Item, ...] = field(default=(), repr=False)  # empty where nobody but the user can fetch it
    manual: str | None = None  # how to get it by hand, with {folder} for its directory
    patterns: tuple[str, ...] = ()  # of the files that the user puts into the first of the folders


# SHA-256 of files that never change, by their paths: those of a commit of git, whose number vouches for their content
_PINNED = {
    path: digest
    for digest, _, path in (
        line.partition("  ") for line in Path(__file__).with_name("pinned.sha256").read_text("utf-8").splitlines()
    )
}


def _of_commit(folder: str, base: str, paths: Iterable[str]) -> tuple[Item, ...]:
    """Return files of a commit, whose checksums are pinned."""
    return tuple(Item(f"{folder}/{path}", (f"{base}/{path}",), sha256=_PINNED[f"{folder}/{path}"]) for path in paths)


def _levels(folder: str, source: str, name: str, count: int, spelling: str) -> tuple[Item, ...]:
    """Return the photos and maps of an 8-bit benchmark."""
    kinds = (f"RGB/{name}_{{:02d}}_{spelling}_color.png", f"Depth/{name}_{{:02d}}_output_depth.png")
    paths = [kind.format(number) for number in range(1, count + 1) for kind in kinds]
    return _of_commit(folder, f"{_DCTNET}/{source}", paths)


def _ddrnet() -> tuple[Item, ...]:
    """Return the frames that DDRNet's authors publish."""
    frames = [f"20170907/group1/{{}}/frame_{number:06d}.png" for number in range(1, 21)]
    frames += [f"20170907/group2/{{}}/frame_{number:06d}.png" for number in range(1, 3)]
    folders = ("color_map", "depth_map", "high_quality_depth")
    return _of_commit("ddrnet", _DDRNET, [frame.format(folder) for frame in frames for folder in folders])


def _cleargrasp() -> tuple[Item, ...]:
    """Return the captures that ClearGrasp's authors publish with their code."""
    kinds = ("transparent-rgb-img.jpg", "transparent-depth-img.exr", "opaque-depth-img.exr", "mask.png")
    files = [f"{number:09d}-{kind}" for number in (80, 123, 130, 153) for kind in kinds]
    paths = [f"real-val/d435/{file}" for file in (*files, "camera_intrinsics.yaml")]
    return _of_commit("cleargrasp", _CLEARGRASP, paths)


def _cleargrasp_synthetic() -> tuple[Item, ...]:
    """Return the renderings that they publish with it."""
    kinds = (
        "rgb-imgs/{:09d}-rgb.jpg", "depth-imgs-rectified/{:09d}-depth-rectified.exr",
        "segmentation-masks/{:09d}-segmentation-mask.png",
    )  # fmt: skip
    paths = [f"synthetic-val/square-plastic-bottle-val/{kind.format(n)}" for n in (0, 2, 4) for kind in kinds]
    return _of_commit("cleargrasp_synthetic", _CLEARGRASP, paths)


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


_ITEMS_2006 = _full_size("middlebury2006", SCENES_2006, f"{_STEREO}/scenes2006/FullSize")
_ITEMS_2001 = _files("middlebury2001", SCENES_2001, f"{_STEREO}/scenes2001/data", ("im2.ppm", "disp2.pgm"))
_SUNRGBD = "https://rgbd.cs.princeton.edu/data/SUNRGBD.zip"
_NYU = "http://horatio.cs.nyu.edu/mit/silberman/nyu_depth_v2/nyu_depth_v2_labeled.mat"
_ITEMS: Mapping[str, tuple[Item, ...]] = {
    "middlebury": _perfect(EVALUATION_2014),
    "middlebury_train": _perfect(TRAINING_2014) + _ITEMS_2006 + _ITEMS_2001,
    "middlebury2006": _ITEMS_2006,
    "middlebury2005": _full_size("middlebury2005", SCENES_2005, f"{_STEREO}/scenes2005/FullSize"),
    "middlebury2003": _files("middlebury2003", SCENES_2003, f"{_STEREO}/scenes2003/newdata", ("im2.png", "disp2.png")),
    "middlebury2001": _ITEMS_2001,
    "icl": _icl("living_room", "living_room_") + _icl("office_room", ""),
    "sunrgbd": (Item("sunrgbd/SUNRGBD.zip", (_SUNRGBD,), unpack_to="sunrgbd", contains=("SUNRGBD",)),),
    "sintel": (
        _sintel("sintel/MPI-Sintel-training_images.zip", ("training/final", "training/clean")),
        _sintel("jwulff/sintel/MPI-Sintel-depth-training-20150305.zip", ("training/depth", "training/camdata_left")),
    ),
    "nyu": (Item("nyu_v2/nyu_depth_v2_labeled.mat", (_NYU,)),),
    "lu": _levels("lu", "Lu", "RGBD", 6, "ouput"),
    "middlebury8": _levels("middlebury8", "Middlebury", "Middlebury", 30, "output"),
    "ddrnet": _ddrnet(),
    "stereo_board": _of_commit(
        "stereo_board", _BOARD, [f"{kind}/{n}.png" for n in (8, 14, 19, 25, 31) for kind in ("color", "depth")]
    ),
    "cleargrasp": _cleargrasp(),
    "cleargrasp_synthetic": _cleargrasp_synthetic(),
}


def _catalogue() -> dict[str, Collection]:
    """Return the collections by name, in the order of the file that describes them."""
    text = Path(__file__).with_name("collections.yaml").read_text("utf-8")
    catalogue = {}
    for name, entries in yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)).items():  # noqa: S506
        lists: dict[str, Any] = {key: tuple(entries.pop(key)) for key in ("folders", "patterns") if key in entries}
        catalogue[name] = Collection(name, items=_ITEMS.get(name, ()), **entries, **lists)
    return catalogue


CATALOGUE = _catalogue()


def find(names: Iterable[str], catalogue: Mapping[str, Collection]) -> list[Collection]:
    """Return the collections of these names, each once."""
    unknown = [name for name in names if name not in catalogue]
    if unknown:
        expected = f"expected some of {', '.join(catalogue)}{did_you_mean(unknown[0], catalogue)}"
        raise ValueError(f"{', '.join(unknown)}: unknown data set; {expected}")
    return [catalogue[name] for name in dict.fromkeys(names)]

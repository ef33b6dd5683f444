"""Options of the commands, checked before the modules that carry them out are imported, which takes seconds.

The docstring of a record is the text of its command's ``--help`` before the options.
"""

from dataclasses import dataclass
from pathlib import Path

from dsr.app.upsample.parts import EXPECTED_ERROR
from dsr.geometry.lights import FIGURE_LIGHT, LIGHT_CHOICES, LIGHT_NAMES
from dsr.report.study import Choice
from dsr.utils.configuration import config_directories, list_choices
from dsr.utils.options import Options, Rule, at_least, group, one_of, option, positive

SHELLS = ("bash", "zsh", "fish")
REPORT_PARTS = ("tables", "metrics", "figures", "page")


@dataclass(frozen=True, kw_only=True)
class RunsRequest(Options):
    """Which runs are shown, and where."""

    runs: tuple[Path, ...] = option(..., "directories of runs, or with runs below them", "DIR", flags="runs")
    output: Path = option(..., "where the page and its files go", "DIR", flags="-o --output", writes="folder")
    methods: tuple[str, ...] = option((), "these alone, as the tables name them", "NAME")
    datasets: tuple[str, ...] = option((), "these alone", "NAME")
    scales: tuple[float, ...] = option((), "these alone", "N", flags="--scale")


@dataclass(frozen=True, kw_only=True)
class ReportRequest(RunsRequest):
    """Make tables, figures, the metric study and a page from runs of eval.py.

    All runs in and below the directories are read; no other files are needed.
    """

    study: Path | None = option(None, "what `dsr study collect` wrote", "CSV")
    light: str = option(
        FIGURE_LIGHT, f"of the figures: {LIGHT_CHOICES}; {FIGURE_LIGHT}", "NAME", rule=one_of(LIGHT_NAMES)
    )
    intervals: bool = option(False, "averages with 95 % intervals, and a test of the best against the second best")
    leaderboard: bool = option(False, "the page begins with one row a method, by mean rank")
    strict: bool = option(False, "refuse runs with a warning; see docs/checks.md")
    title: str = option("Depth super-resolution", "of the page")
    page_px: int | None = option(
        None,
        "maximum longer side of a picture of the page, pixels (default: 1024, less if it has more than 48 surfaces)",
        "N",
        rule=at_least(16),
    )
    parts: tuple[str, ...] = option(
        REPORT_PARTS,
        "these parts alone, of tables, metrics, figures, page",
        "A,B",
        flags="--only",
        rule=Rule(
            f"some of {', '.join(REPORT_PARTS)}", lambda part: part in REPORT_PARTS, each=True, known=REPORT_PARTS
        ),
        parse=lambda text: tuple(part.strip() for part in text.split(",")),
    )
    workers: int | None = option(
        None,
        "processes that draw and encode (default: one per core, at most 8)",
        "N",
        rule=Rule("1..256", lambda count: 1 <= count <= 256),
    )


@dataclass(frozen=True, kw_only=True)
class LeaderboardRequest(RunsRequest):
    """Make a static page that ranks the methods of all runs over all data sets, scales and metrics.

    The runs are those in and below the directories. The page has their surfaces under any light, and a click on a
    method shows it beside another.
    """

    title: str = option("Depth super-resolution: leaderboard", "of the page")


@dataclass(frozen=True, kw_only=True)
class FuseRequest(Options):
    """Fuse the results of a sequence with poses into one mesh, weighted by the expected errors."""

    folders: tuple[Path, ...] = option(..., "folders of results of dsr upsample", "OUT", flags="folders")
    output: Path = option(
        ...,
        "the mesh, a .ply or .glb file",
        "FILE",
        flags="-o --output",
        rule=Rule("a file that ends in .ply or .glb", lambda path: path.suffix.lower() in (".ply", ".glb")),
        writes="file",
    )
    strict: bool = option(False, "refuse poses that can hardly be right; see docs/checks.md")
    voxel: float | None = option(
        None,
        "size of a voxel (default: the width of a pixel on the surfaces)",
        "METRES",
        rule=positive("number of metres"),
    )
    max_error: float = option(
        2.0, "leave pixels out whose depth is expected to be off by more (default: 2)", "PERCENT", rule=EXPECTED_ERROR
    )
    score: bool = option(False, "say how far results differ under their poses, too (OPW, RSD); see docs/metrics.md")


@dataclass(frozen=True, kw_only=True)
class ViewRequest(Options):
    """Look at results of `dsr upsample` in the browser, on one page.

    It has the surface to turn, a light to drag, before and after, the photo and the expected errors as its colours. The
    page is a single file that needs no network and can be sent as it is.
    """

    output: Path = option(..., "a result of `dsr upsample`, or a folder of several", "OUT", flags="output")
    page: Path | None = option(None, "the page (default: OUT/view.html)", "FILE", flags="-o --page", writes="file")
    open_page: bool = option(True, "only write the page", flags="--no-open")
    most: int = option(24, "show at most N results, taken at equal distances (24)", "N", rule=at_least(1))
    vertices: int = option(
        500_000,
        "at most N vertices in a surface, and 6 N in the page; larger maps are reduced (500000)",
        "N",
        rule=at_least(1000),
    )


@dataclass(frozen=True, kw_only=True)
class BrowserRequest(Options):
    """Upsample in the browser: drop files, look at the surfaces, download the results.

    A page of this machine alone is served and opened. The library is an extra: pip install -e '.[app]' in a checkout.
    More in docs/view.md.
    """

    port: int = option(
        8765, "of this machine; 0: a free one (8765)", "PORT", rule=Rule("0..65535", lambda port: 0 <= port <= 65535)
    )
    open_page: bool = option(True, "only serve the page", flags="--no-open")
    max_upload: float = option(
        512.0, "largest size of an uploaded file (512)", "MB", rule=positive("number of megabytes")
    )
    max_seconds: float = option(300.0, "longest time of a computation (300)", "SECONDS", rule=positive("time"))
    max_memory: float | None = option(
        None, "memory of a computation (default: what is free)", "GB", rule=positive("number of gigabytes")
    )


@dataclass(frozen=True, kw_only=True)
class ExportRequest(Options):
    """Write a method's network as an ONNX file, and check it with onnxruntime.

    The file takes a photo and a depth map of any size. The libraries are an extra: pip install -e '.[onnx]' in a
    checkout.
    """

    path: Path = option(..., "the file to write", "FILE", flags="--onnx", writes="file")
    method: str = option("facets", "facets (default), msg_v, pdn, ddrnet, ...", "NAME")
    scale: int = option(4, "upsampling factor (default: 4)", "N", rule=at_least(1))
    weights: Path | None = option(None, "of a training (default: those of the method)", "FILE")
    directories: tuple[Path, ...] = option(
        (),
        "a folder with a method/ of your own YAML files; may be repeated",
        "DIR",
        flags="--config-dir",
        repeated=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_method(self.method, self.directories)


def check_method(method: str, directories: tuple[Path, ...]) -> None:
    """Raise OptionError if there is no such method in the project's or the user's directories."""
    one_of(list_choices("method", config_directories(directories))).expect("method", method)


@dataclass(frozen=True, kw_only=True)
class FormatsRequest(Options):
    """Show what is read of which device or program."""

    names: tuple[str, ...] = option((), "those with one of these words; none for all", "WORD", flags="names")


@dataclass(frozen=True, kw_only=True)
class DoctorRequest(Options):
    """Check what is installed, or a directory of your own scenes."""

    directory: Path | None = option(
        None, "a scene, or a directory of scenes; without one, what is installed is checked", "DIR", flags="directory"
    )
    most: int | None = option(
        None, "examine at most N scenes, taken at equal distances from all", "N", rule=at_least(1)
    )


@dataclass(frozen=True, kw_only=True)
class StudyRequest(Options):
    """Make a page of questions that needs no network, from runs of eval.py."""

    runs: tuple[Path, ...] = option(..., "runs, or directories with runs below", "RUNS", flags="runs")
    output: Path = option(..., "where to", "DIR", flags="-o --output", writes="folder")
    choice: Choice = group(Choice)
    strict: bool = option(False, "refuse runs with a warning; see docs/checks.md")
    overwrite: bool = option(False, "replace another study, whose answers can then no longer be collected")


@dataclass(frozen=True, kw_only=True)
class AnswersRequest(Options):
    """Turn the files that people saved into a table.

    Files that are damaged, incomplete or of another study are named and left out. If one person sent several files,
    only the one finished first counts. The exit code is 2 if no file is left.
    """

    study: Path = option(..., "the study's directory, with key.json", "DIR", flags="study")
    answers: tuple[Path, ...] = option(..., "files, or directories of them", "ANSWERS", flags="answers")
    output: Path | None = option(
        None, "the table; DIR/study.csv by default", "FILE", flags="-o --output", writes="file"
    )


_NAME_OF_DATA = "a data set, as in `dsr data list`"


@dataclass(frozen=True, kw_only=True)
class DataListRequest(Options):
    """List all data sets, and which of them are on this machine."""


@dataclass(frozen=True, kw_only=True)
class DataWhereRequest(Options):
    """Print the directory of the data sets, or the folders of some."""

    names: tuple[str, ...] = option((), _NAME_OF_DATA, "NAME", flags="names")


@dataclass(frozen=True, kw_only=True)
class DataVerifyRequest(Options):
    """Check every file against its recorded size and checksum."""

    names: tuple[str, ...] = option(..., _NAME_OF_DATA, "NAME", flags="names")


@dataclass(frozen=True, kw_only=True)
class DataGetRequest(DataVerifyRequest):
    """Fetch what is missing. Run the same command again to continue an interrupted download."""

    mirror: str | None = option(None, "a server to try first, see docs/data.md", "URL")
    yes: bool = option(False, "do not ask", flags="--yes -y")
    keep_archives: bool = option(False, "keep archives after unpacking")


@dataclass(frozen=True, kw_only=True)
class DataPrepareRequest(Options):
    """Resize and keep the scenes of a data set, and draw a contact sheet."""

    name: str = option(..., "a data set, as in `eval.py dataset=NAME`", "NAME", flags="name")
    settings: tuple[str, ...] = option((), "as for eval.py, such as dataset.size=256", "KEY=VALUE", flags="settings")
    config_dir: Path | None = option(None, "a directory of your own with dataset/NAME.yaml", "DIR")


@dataclass(frozen=True, kw_only=True)
class CompletionRequest(Options):
    """Print what your shell runs at its start to complete the commands and options of `dsr`."""

    shell: str = option(..., ", ".join(SHELLS), "SHELL", flags="shell", rule=one_of(SHELLS))
    line: str | None = option(None, "print what may stand at the end of a line, instead of the script", "LINE")

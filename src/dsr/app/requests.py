"""What the commands are asked: checked without what answers it, which takes seconds to import."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dsr.utils.config_files import config_directories, list_choices

REPORT_PARTS = ("tables", "metrics", "figures", "page")
_MOST_WORKERS = 256


@dataclass(frozen=True)
class ReportRequest:
    """What the report contains.

    Args:
        methods, datasets, scales: the ones to show; empty for all.
        parts: some of tables, metrics, figures, page.
        light: the figures' light.
        title: the page's title.
        page_mb: the maximum size of the page in MB.
        workers: number of worker processes; None for one per core if there is enough to do.

    """

    methods: tuple[str, ...]
    datasets: tuple[str, ...]
    scales: tuple[float, ...]
    parts: tuple[str, ...]
    light: str
    title: str
    page_mb: float
    workers: int | None = None

    def __post_init__(self) -> None:
        """Check the values, but for the light's name."""
        for part in self.parts:
            if part not in REPORT_PARTS:
                raise ValueError(f"--only: expected some of {', '.join(REPORT_PARTS)}, got {part}")
        if self.workers is not None and not 1 <= self.workers <= _MOST_WORKERS:
            raise ValueError(f"--workers: expected 1..{_MOST_WORKERS}, got {self.workers}")
        if not self.page_mb > 0:
            raise ValueError(f"--page-mb: expected a positive number, got {self.page_mb:g}")


@dataclass(frozen=True)
class FuseRequest:
    """What to fuse.

    Args:
        folders: results of ``dsr upsample``, or folders of them.
        output: the mesh, a ``.ply`` file.
        voxel: edge length of a voxel in metres; None for the median width of a pixel on the surfaces.
        max_error: expected relative error of the depth from which a pixel is left out.

    Raises:
        ValueError: a value is out of range.

    """

    folders: tuple[Path, ...]
    output: Path
    voxel: float | None = None
    max_error: float = 0.02

    def __post_init__(self) -> None:
        """Check the values."""
        if self.output.suffix.lower() != ".ply":
            raise ValueError(f"-o: expected a file that ends in .ply, got {self.output}")
        if self.voxel is not None and not 0 < self.voxel < float("inf"):
            raise ValueError(f"--voxel: expected a positive number of metres, got {self.voxel:g}")
        if not self.max_error > 0:
            raise ValueError(f"--max-error: expected a positive percentage of the depth, got {100 * self.max_error:g}")


@dataclass(frozen=True)
class ViewRequest:
    """What to look at.

    Args:
        output: a result, or a folder of results.
        page: the HTML file.
        most: maximum number of results.
        vertices: maximum number of vertices of a surface.
        open_page: whether to open the page in the browser.

    """

    output: Path
    page: Path
    most: int
    vertices: int
    open_page: bool

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.most < 1:
            raise ValueError(f"--most: expected at least 1, got {self.most}")
        if self.vertices < 1000:
            raise ValueError(f"--vertices: expected at least 1000, got {self.vertices}")


@dataclass(frozen=True)
class ExportRequest:
    """Which network to write, and where.

    Args:
        path: the file.
        method: the method's name.
        scale: the upsampling factor.
        weights: a file of weights; None for those that the method names.
        directories: the user's configuration directories.

    """

    path: Path
    method: str
    scale: int
    weights: Path | None = None
    directories: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        """Check what does not depend on files."""
        if self.scale < 1:
            raise ValueError(f"--scale: expected a factor of 1 or more, got {self.scale}")
        if self.path.is_dir():
            raise ValueError(f"--onnx: expected a file, got the folder {self.path}")
        methods = list_choices("method", config_directories(self.directories))
        if self.method not in methods:
            raise ValueError(f"--method: expected one of {', '.join(methods)}, got {self.method!r}")

"""The command behind ``dsr data prepare``: prepare a data set, and draw its scenes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from dsr.app.entry import explain
from dsr.app.schema import EvalConfig, compose, plain_config
from dsr.data.scene_source import SceneSource, as_source, prepare_scenes
from dsr.pictures.sheets import save_contact_sheet
from dsr.sample import Scene
from dsr.utils.configuration import ConfigError
from dsr.utils.console import ConsoleProgress, one_line, show


def prepare_dataset(name: str, overrides: Sequence[str], console: Console, config_dirs: Sequence[Path] = ()) -> None:
    """Prepare every scene of a data set and draw the contact sheet, ``outputs/data/NAME/sheet.png`` or its pages.

    The overrides are those of the command line of ``eval.py``, such as ``dataset.size=256``.
    """
    source = _source(name, overrides, config_dirs)
    progress = ConsoleProgress(console)
    prepare_scenes(source, source.scenes(), progress)
    failures: dict[str, str] = {}
    scenes = _loaded(source, progress.track(source.scenes(), "draw"), failures)
    folder = Path("outputs", "data", name)
    before = set(folder.glob("sheet*.png"))
    pages = save_contact_sheet(folder / "sheet.png", scenes, f"{name}, as prepared")
    for path in before - set(pages):
        path.unlink()
    for path in pages:
        show(console, f"contact sheet: {path}")
    if failures:
        lines = "; ".join(failures.values())
        raise ConfigError(f"{len(failures)} of {len(source.scenes())} scenes cannot be read: {lines}")


def _source(name: str, overrides: Sequence[str], config_dirs: Sequence[Path]) -> SceneSource:
    """Build the data set that a configuration describes."""
    try:
        plain = plain_config(compose("eval", [f"dataset={name}", *overrides], config_dirs))
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(explain(error)) from error
    if "parts" in plain["dataset"]:
        parts = ", ".join(plain["dataset"]["parts"])
        raise ConfigError(f"dataset={name}: expected one data set, it has the parts {parts}")
    return as_source(EvalConfig.of(plain).build("dataset"))


def _loaded(source: SceneSource, names: Iterator[str], failures: dict[str, str]) -> Iterator[Scene]:
    """Yield the scenes that can be read, and record the errors of the others in ``failures``."""
    for name in names:
        try:
            yield source.load(name)
        except (ValueError, OSError) as error:
            failures[name] = one_line(error)

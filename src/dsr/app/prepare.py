"""The command behind ``dsr data prepare``: a data set made ready, and pictures of what that led to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import hydra
from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

import dsr
from dsr.app.entry import explain
from dsr.app.schema import plain_config, register
from dsr.data.base import SceneSource, prepare_scenes
from dsr.sample import Scene
from dsr.utils.builder import ConfigError, build
from dsr.utils.console import ConsoleProgress, one_line, show
from dsr.viz.sheets import save_contact_sheet


def prepare_dataset(name: str, overrides: Sequence[str], console: Console) -> None:
    """Prepare every scene of a data set and draw the contact sheet, ``outputs/data/NAME/sheet.png`` or its pages.

    Args:
        name: of a file in ``conf/dataset``.
        overrides: as on the command line of ``eval.py``, such as ``dataset.size=256``.
        console: where progress is shown.

    Raises:
        ConfigError: there is no such data set, it is not there, or a scene of it cannot be read (the others are drawn).

    """
    source = _source(name, overrides)
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


def _source(name: str, overrides: Sequence[str]) -> SceneSource:
    """Return the data set that a configuration describes."""
    register()
    conf = next((path for path in (Path("conf").resolve(), _beside_package()) if (path / "dataset").is_dir()), None)
    if conf is None:
        raise ConfigError("conf: expected the directory of the configuration files; run the command in a checkout")
    arguments = [f"dataset={name}", *overrides]
    try:
        with hydra.initialize_config_dir(str(conf), version_base="1.3"):
            node = plain_config(hydra.compose("eval", arguments))["dataset"]
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(explain(error, conf, "eval", arguments)) from error
    if "parts" in node:
        raise ConfigError(f"dataset={name}: expected one data set, it has the parts {', '.join(node['parts'])}")
    source: SceneSource = build("dataset", node)
    return source


def _beside_package() -> Path:
    return Path(dsr.__file__).resolve().parents[2] / "conf"


def _loaded(source: SceneSource, names: Iterator[str], failures: dict[str, str]) -> Iterator[Scene]:
    """Yield the scenes that can be read; say of the others why not."""
    for name in names:
        try:
            yield source.load(name)
        except (ValueError, OSError) as error:
            failures[name] = one_line(error)

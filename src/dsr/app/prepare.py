"""The command behind ``dsr data prepare``: prepare a data set, and draw its scenes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from dsr.app.entry import explain
from dsr.app.requests import DataPrepareRequest
from dsr.app.schema import EvalConfig, compose, plain_config
from dsr.data.scene_source import as_source, prepare_scenes
from dsr.pictures.sheets import save_contact_sheet
from dsr.sample import Scene
from dsr.utils.configuration import ConfigError
from dsr.utils.console import ConsoleProgress, one_line, show


def prepare_dataset(request: DataPrepareRequest, console: Console) -> list[str]:
    """Prepare every scene of a data set and draw the contact sheet, ``outputs/data/NAME/sheet.png`` or its pages."""
    name, directories = request.name, [] if request.config_dir is None else [request.config_dir]
    try:
        plain = plain_config(compose("eval", [f"dataset={name}", *request.settings], directories))
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(explain(error)) from error
    if "parts" in plain["dataset"]:
        parts = ", ".join(plain["dataset"]["parts"])
        raise ConfigError(f"dataset={name}: expected one data set, it has the parts {parts}")
    source = as_source(EvalConfig.of(plain).build("dataset"))
    progress, failures = ConsoleProgress(console), list[str]()
    prepare_scenes(source, source.scenes(), progress)

    def loaded() -> Iterator[Scene]:
        for scene in progress.track(source.scenes(), "draw"):
            try:
                yield source.load(scene)
            except (ValueError, OSError) as error:
                failures.append(one_line(error))

    folder = Path("outputs", "data", name)
    before = set(folder.glob("sheet*.png"))
    pages = save_contact_sheet(folder / "sheet.png", loaded(), f"{name}, as prepared")
    for path in before - set(pages):
        path.unlink()
    for path in pages:
        show(console, f"contact sheet: {path}")
    if failures:
        raise ConfigError(f"{len(failures)} of {len(source.scenes())} scenes cannot be read: {'; '.join(failures)}")
    return []

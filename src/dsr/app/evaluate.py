"""The command behind ``eval.py``."""

from __future__ import annotations

import functools
import hashlib
import math
import random
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from dsr.app import run_directory as rundir
from dsr.app.metrics import check_metrics, chosen_metrics, metric_collection
from dsr.app.multirun import Plan, runs_here
from dsr.app.schema import Config, EvalConfig, Identity, given_keys, plain_config, raw_group, user_directories
from dsr.data.folder import Folder
from dsr.data.scene_source import SceneSource, prepare_scenes, regions_of
from dsr.degradation.downsampling import Downsampling, Measured, make_sample
from dsr.evaluation.predict import Evaluation, Outcome, StalePredictionError, failure_line, predict
from dsr.evaluation.run_files import read_run
from dsr.evaluation.score import score
from dsr.evaluation.sharing import Workers, can_fork, choose_workers
from dsr.evaluation.store import load_errors, prediction_path
from dsr.inference.selection import select
from dsr.methods.base import WORKSPACE, Method
from dsr.methods.networks.weight_files import files_of_weights
from dsr.methods.recipe import Known, Recipe, Run
from dsr.metrics.formats import HEADLINES, Formats
from dsr.report.table_layouts import score_tables
from dsr.sample import DepthSample, slope
from dsr.utils.compute_device import fast_precision, pick_device
from dsr.utils.configuration import ConfigError
from dsr.utils.console import ConsoleProgress, note_once, open_console, print_error, show
from dsr.utils.ratios import NATIVE, match_ratio
from dsr.utils.versions import hash_once

_OBJECTIVE = "RMSE_v"


def evaluate(config: DictConfig) -> pd.DataFrame:
    """Evaluate one method on one data set: write predictions, scores and pictures, print a table.

    ``run=RUN_DIR`` evaluates the network of a training, on its own validation scenes unless a data set is given.

    Args:
        config: composed from ``conf/eval.yaml``.

    Returns:
        The content of ``scores.csv``; if a run was validated with several data sets, their tables concatenated.

    Raises:
        ConfigError: the configuration cannot be run, or a scene failed (the others' results are written).

    """
    scores = [_run(_prepare(*study)) for study in _studies(config)]
    return pd.concat(scores, ignore_index=True)


def plan(config: DictConfig) -> list[Plan]:
    """Check what :func:`evaluate` would run as a job of a multirun; nothing is computed or written.

    Args:
        config: composed from ``conf/eval.yaml``.

    Raises:
        ConfigError: the configuration cannot be run.

    """
    return [_plan(_prepare(*study, here=runs_here())) for study in _studies(config)]


def objective(scores: pd.DataFrame) -> float:
    """Return the objective of sweepers: the mean over the scenes of RMSE_v, or of the first metric without it.

    Args:
        scores: the content of ``scores.csv``.

    """
    worst = scores[scores["variant"].isin(HEADLINES)]
    means = worst.groupby("metric", sort=False)["value"].mean()
    if means.empty:
        return math.nan
    return float(means.get(_OBJECTIVE, means.iloc[0]))


def _studies(config: DictConfig) -> Iterator[tuple[dict[str, Any], Any, SceneSource | None]]:
    """Yield what to evaluate: configurations, their methods' nodes, data sets (None for the configuration's own)."""
    plain = plain_config(config)
    if plain["run"] is None:
        yield plain, raw_group(config, "method"), None
        return
    from dsr.app.training_runs import studies_of_run  # noqa: PLC0415 - it imports Lightning, which takes seconds

    for study, source in studies_of_run(plain, given_keys()):
        yield study, study["method"], source


@dataclass(frozen=True)
class _Prepared:
    """An evaluation that can be run, in the directory of its run."""

    settings: EvalConfig
    plain: Config
    identity: Identity
    folder: Path
    study: Evaluation
    workers: Workers
    progress: ConsoleProgress


def _prepare(plain: Config, node: Any, source: SceneSource | None, *, here: bool = True) -> _Prepared:
    """Check and build all that an evaluation needs, and write nothing."""
    settings = EvalConfig.of(plain)
    source = source or _source(settings)
    name, scale = settings.names["method"], _scale(settings, source)
    recipe = Recipe(name, OmegaConf.create(node), user_directories(), plain)
    device = pick_device(settings.device, recipe.abilities.fast_on) if here else torch.device("cpu")
    own = {key: value for key, value in plain["method"].items() if key not in recipe.of_run}
    plain = {**plain, "method": own, "precision": _precision(settings, recipe, device), "scale": scale}
    settings = EvalConfig.of(plain)
    selected = select(recipe, scale, _weights(settings, recipe), measured=settings.measured)
    identity = rundir.identity_of(plain, _hash_weights(selected.files()), device, recipe.targets())
    folder = rundir.folder_of(settings.output_dir or rundir.default_directory("eval", plain, identity))
    progress = ConsoleProgress(open_console())
    downsampling = settings.build("downsampling")
    assumes = recipe.abilities.assumes_downsampling
    if "downsampling.assumed" in given_keys() and not assumes:
        raise ConfigError(f"downsampling.assumed: method={name} assumes no downsampling model; leave it out")
    label = settings.label or name
    degradation = rundir.degradation_of(vars(settings), assumes=assumes)
    run = Run(
        device=device,
        precision=settings.precision,
        seed=settings.seed,
        downsampling=downsampling.assumed_model(),
        known=_known_of_maps(settings, downsampling, source),
        alignment=settings.metrics.alignment,
        metrics=functools.partial(metric_collection, settings.metrics),
        workspace=folder,
        display=progress,
        about={"method": label, "degradation": degradation},
        lpips_trunk=settings.metrics.lpips_trunk,
    )
    method = selected.build(run)
    if method.name is not None and label == name:
        label = method.name
    study = Evaluation(
        source,
        downsampling,
        degradation,
        scale,
        method,
        _flagged(name, method, "_{}"),
        settings.seed,
        identity,
        device,
        noise=settings.build("noise"),
        holes=settings.build("holes"),
        label=_flagged(label, method, " ({})"),
    )
    check_metrics(settings.metrics)
    workers = _workers(settings, device, len(source.scenes()), alone=recipe.abilities.optimises)
    rundir.expect_free(folder, plain, identity, () if here else ("device", "precision"))
    return _Prepared(settings, plain, identity, folder, study, workers, progress)


def _plan(prepared: _Prepared) -> Plan:
    """Return what an evaluation will do."""
    study, folder = prepared.study, prepared.folder
    scenes = study.source.scenes()
    done = 0 if prepared.settings.overwrite else sum(prediction_path(folder, scene).is_file() for scene in scenes)
    left = len(scenes) - done

    def seconds(_: set[str]) -> float:
        example = _example(prepared)
        if example is None:
            return math.nan
        return left * study.method.seconds(example)

    measured = runs_here() and study.method.abilities.optimises
    return Plan(folder, prepared.identity, "scene", left, done, seconds if measured else None)


def _example(prepared: _Prepared) -> DepthSample | None:
    """Return a sample as large as the first scene's; None if its size is not known before the scenes are prepared."""
    study, size = prepared.study, prepared.settings.dataset.get("size")
    if isinstance(study.downsampling, Measured):
        return None
    if isinstance(size, int):
        scene = slope(size)
    elif isinstance(study.source, Folder):
        scene = study.source.load(study.source.scenes()[0])
    else:
        return None
    return make_sample(
        scene, study.scale, study.downsampling, study.method.range_type, study.noise, study.seed, study.holes
    )


def _run(prepared: _Prepared) -> pd.DataFrame:
    """Evaluate, and return the scores."""
    with rundir.at_work(prepared.folder, prepared.plain, prepared.identity):
        return _run_claimed(prepared)


def _run_claimed(prepared: _Prepared) -> pd.DataFrame:
    """Evaluate in a directory where no command with other settings is at work."""
    settings, folder, study = prepared.settings, prepared.folder, prepared.study
    workers, progress = prepared.workers, prepared.progress
    console = open_console()
    rundir.claim(folder, prepared.plain, prepared.identity)
    if settings.overwrite:
        shutil.rmtree(folder / WORKSPACE, ignore_errors=True)
    _seed(settings.seed)
    prepare_scenes(study.source, study.source.scenes(), progress)
    for remark in study.method.remarks(study.source.name, study.source.scenes(), study.scale):
        note_once(remark)
    try:
        outcome = predict(study, folder, progress, overwrite=settings.overwrite, workers=workers)
    except StalePredictionError as error:
        raise ConfigError(str(error)) from error
    metrics = chosen_metrics(settings.metrics, regions_of(study.source))
    formats = {metric.name: metric.format for metric in metrics}
    illustrate = functools.partial(_illustrate, folder, study.label, formats)
    alignment = settings.metrics.alignment
    scores = score(study, folder, metrics, outcome, progress, illustrate, alignment=alignment, workers=workers)
    _save_dashboard(folder)
    _report(console, folder, scores, outcome, formats)
    if outcome.failures:
        total = len(study.source.scenes())
        rest = f"; the others are in {folder}" if len(outcome.failures) < total else ""
        raise ConfigError(f"{len(outcome.failures)} of {total} scenes failed: {', '.join(outcome.failures)}{rest}")
    return scores


def _workers(settings: EvalConfig, device: torch.device, scenes: int, *, alone: bool) -> Workers:
    """Return the worker processes that the configuration describes; ``alone`` for one scene at a time."""
    count, threads = (None if value == "auto" else int(value) for value in (settings.workers, settings.threads))
    forks = device.type == "cpu" and can_fork()
    if count is not None and count > 1 and not forks:
        raise ConfigError(
            f"workers: expected 1 with device={device}, got {count}; "
            "start the command once per device, with the same output_dir"
        )
    return choose_workers(count, threads, scenes, torch.get_num_threads(), together=forks and not alone)


def _save_dashboard(folder: Path) -> None:
    """Write the run's TensorBoard log."""
    from dsr.report.dashboard import save_dashboard  # noqa: PLC0415 - slow to import

    save_dashboard(folder)


def _source(settings: EvalConfig) -> SceneSource:
    """Build the data set that the configuration describes."""
    if "parts" in settings.dataset:
        name = settings.names["dataset"]
        raise ConfigError(f"dataset={name}: several data sets are for training; name one of them")
    source: SceneSource = settings.build("dataset")
    return source


def _scale(settings: EvalConfig, source: SceneSource) -> float:
    """Return the upsampling factor; where it is not whole, the exact ratio of the first scene's measured map."""
    if settings.scale != NATIVE and float(settings.scale).is_integer():
        return int(settings.scale)
    first = source.scenes()[0]
    try:
        return match_ratio(settings.scale, source.load(first).measured)
    except (ValueError, OSError) as error:
        raise ConfigError(failure_line(first, error)) from error


def _weights(settings: EvalConfig, recipe: Recipe) -> Path | None:
    """Return the file or directory of weights that the configuration names, if the method takes one."""
    given = None if settings.weights is None else Path(settings.weights).expanduser()
    if given is not None and recipe.abilities.needs is None:
        if not given.is_dir():  # a directory serves all methods of a multirun
            note_once(f"method={recipe.name} has no weights; weights={given} is not used")
        return None
    return given


def _hash_weights(files: list[Path]) -> str | None:
    """Return the SHA-256 of a file of weights, or of those of several and of those that they need; None without any."""
    try:
        hashes = [hash_once(each) for file in files for each in files_of_weights(file)]
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from error
    if len(hashes) < 2:
        return next(iter(hashes), None)
    return hashlib.sha256("".join(hashes).encode()).hexdigest()


def _known_of_maps(settings: EvalConfig, downsampling: Downsampling | Measured, source: SceneSource) -> Known:
    """Return what is known of low-resolution maps, for methods that take it; nothing of those of a sensor."""
    if not isinstance(downsampling, Downsampling):
        return Known()
    soft = getattr(source, "soft_edges", False)
    return Known(
        downsampling.assumed_model().kernel, "soft" if soft else "sharp", clean=settings.names["noise"] == "none"
    )


def _flagged(name: str, method: Method, form: str) -> str:
    """Return the name of a method, with the flag that its scores have to be marked with, if any."""
    return name + form.format(method.flag) if method.flag else name


def _precision(settings: EvalConfig, recipe: Recipe, device: torch.device) -> str:
    """Return the precision; ``auto`` is float32, or for an optimisation the device's fast one."""
    if settings.precision != "auto":
        return settings.precision
    return fast_precision(device) if recipe.abilities.optimises else "float32"


def _seed(seed: int) -> None:
    """Seed every global generator; dsr itself uses explicit ones."""
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 - the legacy generator, for libraries that use it
    torch.manual_seed(seed)


def _illustrate(
    folder: Path, label: str, formats: Formats, sample: DepthSample, depth: torch.Tensor, scores: Mapping[str, float]
) -> None:
    """Draw the result of a scene, and its expected errors if there are any."""
    from dsr.pictures.expected_errors import write_confidence  # noqa: PLC0415 - slow to import
    from dsr.pictures.panels import save_picture  # noqa: PLC0415

    save_picture(folder / "pictures" / f"{sample.scene}.png", sample, depth, scores, label, formats)
    errors = load_errors(prediction_path(folder, sample.scene))
    if errors is not None:
        path = folder / "confidence" / f"{sample.scene}.png"
        write_confidence(path, depth, *errors, sample.depth, sample.camera)


def _report(console: Console, folder: Path, scores: pd.DataFrame, outcome: Outcome, formats: Formats) -> None:
    """Print the table of scores, notes and failures."""
    if not scores.empty:
        for table in score_tables(read_run(folder), formats):
            console.print(table)
    scenes_by_note: dict[str, list[str]] = {}
    for scene, notes in outcome.notes.items():
        scenes_by_note.setdefault("; ".join(notes), []).append(scene)
    for note, scenes in scenes_by_note.items():
        show(console, f"note: {', '.join(scenes)}: {note}")
    if outcome.unscored:
        unscored = ", ".join(outcome.unscored)
        show(console, f"note: no ground truth to score against: {unscored}")
    for message in outcome.unsolved.values():
        show(console, f"no solution: {message}")
    if outcome.reused:
        console.print(
            f"predictions re-used: {len(outcome.reused)} (overwrite=true computes them again)", highlight=False
        )
    show(console, f"results: {folder}")
    for message in outcome.failures.values():
        print_error(message)

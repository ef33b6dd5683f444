"""The commands behind ``eval.py`` and ``dsr data prepare``: ``python eval.py -m dataset=simgeo,icl method=dip_v``."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import math
import random
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import torch
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.console import Console

from dsr.app import run_directory as rundir
from dsr.app.entry import explain
from dsr.app.metrics import check_metrics, chosen_metrics, metric_collection
from dsr.app.requests import DataPrepareRequest
from dsr.app.schema import (
    Config,
    EvalConfig,
    Identity,
    compose,
    given_keys,
    given_overrides,
    plain_config,
    runs_here,
    user_directories,
)
from dsr.data.scene_source import SceneSource, as_source, prepare_scenes
from dsr.degradation.downsampling import Downsampling, Measured
from dsr.degradation.holes import Holes
from dsr.degradation.noise import Noise
from dsr.evaluation.results import Run as StoredRun
from dsr.evaluation.run_files import read_run
from dsr.evaluation.scenes import (
    Evaluation,
    SceneResult,
    evaluate_scene,
    failure_line,
    headline_means,
    write_tables,
)
from dsr.inference.any_ratio import Selection, select
from dsr.methods.base import WORKSPACE, Method
from dsr.methods.networks.weight_files import files_of_weights
from dsr.methods.recipe import Known, Recipe, Run
from dsr.metrics.formats import Formats
from dsr.report.table_layouts import score_tables
from dsr.sample import DepthSample, Scene
from dsr.utils.compute_device import fast_precision, pick_device
from dsr.utils.configuration import ConfigError
from dsr.utils.console import ConsoleProgress, note_once, one_line, open_console, print_error, show
from dsr.utils.guards import free_memory
from dsr.utils.processes import Pool, computing_threads, free_first
from dsr.utils.progress import SILENT, Progress
from dsr.utils.ratios import NATIVE, match_ratio, round_ratio
from dsr.utils.versions import hash_once

_OBJECTIVE = "RMSE_v"
_MEMORY = 1 << 30  # bytes of free memory that the automatic number of workers leaves to each
_BESIDE = 3  # scenes of a GPU: one is predicted while others are read, written and scored
_WORTH_WORKERS = 30.0  # seconds of work from which workers are started, which take some to begin


def evaluate(config: DictConfig) -> float:
    """Evaluate one method on one data set: write predictions, scores and pictures, and print a table.

    ``run=RUN_DIR`` evaluates the network of a training, on its own validation scenes unless a data set is given. If a
    scene fails, the others' results are written before the error. Returns the mean over all scenes of RMSE_v, or of the
    first metric without it, for sweepers.
    """
    scores = [_run(*study) for study in _studies(config)]
    means = headline_means(pd.concat(scores, ignore_index=True))
    return means.get(_OBJECTIVE, next(iter(means.values()), math.nan))


def check(config: DictConfig) -> Iterator[tuple[Path, Identity]]:
    """Check what :func:`evaluate` would do as a job of a multirun, and write nothing; yield directory and identity."""
    for prepared, _, _ in _studies(config, here=runs_here()):
        yield prepared.folder, prepared.identity


def _studies(config: DictConfig, *, here: bool = True) -> Iterator[tuple[_Prepared, Method, ConsoleProgress]]:
    """Prepare what to evaluate: one method on one data set, or a training's network on its validation scenes."""
    plain = plain_config(config)
    if plain["run"] is None:
        raw: Any = OmegaConf.to_container(config, resolve=False)  # for scales other than the run's
        yield _prepare(plain, raw["method"], None, here=here)
        return
    from dsr.app.training_runs import studies_of_run  # noqa: PLC0415 - it imports Lightning, which takes seconds

    for study, source in studies_of_run(plain, given_keys()):
        yield _prepare(study, study["method"], source, here=here)


@dataclass(frozen=True)
class _Prepared:
    """An evaluation that can be run, in the directory of its run; worker processes get it."""

    settings: EvalConfig
    plain: Config
    selected: Selection
    source: SceneSource
    downsampling: Downsampling | Measured
    degradation: str  # its name, that of the noise and the holes included
    noise: Noise
    holes: Holes
    device: torch.device
    identity: Identity
    folder: Path


def _prepare(
    plain: Config, node: Any, source: SceneSource | None, *, here: bool
) -> tuple[_Prepared, Method, ConsoleProgress]:
    """Check all that an evaluation needs, and write nothing; without a data set, it is that of the configuration."""
    settings = EvalConfig.of(plain)
    source = _source(settings) if source is None else source
    scale = _scale(settings, source)
    recipe = Recipe(settings.names["method"], OmegaConf.create(node), user_directories(), plain)
    if "downsampling.assumed" in given_keys() and not recipe.abilities.assumes_downsampling:
        raise ConfigError(f"downsampling.assumed: method={recipe.name} assumes no downsampling model; leave it out")
    device = pick_device(settings.device, recipe.abilities.fast_on, settings.precision) if here else torch.device("cpu")
    precision = settings.precision
    if precision == "auto":
        precision = fast_precision(device) if recipe.abilities.optimises else "float32"
    own = {key: value for key, value in plain["method"].items() if key not in recipe.of_run}
    plain = {**plain, "method": own, "precision": precision, "scale": scale}
    settings = replace(settings, method=own, precision=precision, scale=scale)
    weights = None if settings.weights is None else Path(settings.weights).expanduser()
    if weights is not None and recipe.abilities.needs is None:
        if not weights.is_dir():  # a directory serves all methods of a multirun
            note_once(f"method={recipe.name} has no weights; weights={weights} is not used")
        weights = None
    selected = select(recipe, scale, weights, measured=settings.measured)
    try:
        hashes = [hash_once(each) for file in selected.files() for each in files_of_weights(file)]
    except (ValueError, OSError) as error:
        raise ConfigError(str(error)) from error
    weights_hash = next(iter(hashes), None)
    if len(hashes) > 1:
        weights_hash = hashlib.sha256("".join(hashes).encode()).hexdigest()
    identity = rundir.identity_of(plain, weights_hash, device, recipe.targets())
    folder = rundir.directory_of("eval", plain, identity, given_overrides())
    downsampling, noise, holes = (settings.build(group) for group in ("downsampling", "noise", "holes"))
    degradation = rundir.degradation_of(plain, assumes=recipe.abilities.assumes_downsampling)
    prepared = _Prepared(
        settings, plain, selected, source, downsampling, degradation, noise, holes, device, identity, folder
    )
    progress = ConsoleProgress(open_console())
    check_metrics(settings.metrics)
    method = _method(prepared, progress)
    _workers(prepared)
    rundir.expect_free(folder, plain, identity, () if here else ("device", "precision"))
    return prepared, method, progress


def _source(settings: EvalConfig) -> SceneSource:
    if "parts" in settings.dataset:
        name = settings.names["dataset"]
        raise ConfigError(f"dataset={name}: several data sets are for training; name one of them")
    return as_source(settings.build("dataset"))


def _scale(settings: EvalConfig, source: SceneSource) -> float:
    """Return the upsampling factor; where it is not whole, the exact ratio of the first scene's measured map."""
    if settings.scale != NATIVE and float(settings.scale).is_integer():
        return int(settings.scale)
    first = source.scenes()[0]
    try:
        return match_ratio(settings.scale, source.load(first).measured)
    except (ValueError, OSError) as error:
        raise ConfigError(failure_line(first, error)) from error


def _workers(prepared: _Prepared) -> tuple[int, int]:
    """Return how many scenes are worked on at a time, and with how many threads each."""
    settings, scenes, cores = prepared.settings, len(prepared.source.scenes()), torch.get_num_threads()
    count, threads = (None if value == "auto" else int(value) for value in (settings.workers, settings.threads))
    on_cpu = prepared.device.type == "cpu"
    if count is not None and count > 1 and not on_cpu:
        raise ConfigError(
            f"workers: expected 1 with device={prepared.device}, got {count}; "
            "start the command once per device, with the same output_dir"
        )
    together = on_cpu and not prepared.selected.recipe.abilities.optimises  # else one scene at a time has all cores
    if threads is None:  # does not depend on the number of workers, which changes no bit of the results
        threads = max(1, cores // max(1, scenes)) if together else cores
    if count is None:
        count = min(max(1, cores // threads), max(1, free_memory() // _MEMORY)) if together else 1
    return max(1, min(count, scenes)), threads


def _method(prepared: _Prepared, progress: Progress) -> Method:
    settings, downsampling, known = prepared.settings, prepared.downsampling, Known()
    if isinstance(downsampling, Downsampling):  # nothing is known of the maps of a sensor
        edges: Literal["soft", "sharp"] = "soft" if prepared.source.soft_edges else "sharp"
        known = Known(downsampling.assumed_model().kernel, edges, clean=settings.names["noise"] == "none")
    run = Run(
        device=prepared.device,
        precision=settings.precision,
        seed=settings.seed,
        downsampling=downsampling.assumed_model(),
        known=known,
        alignment=settings.metrics.alignment,
        metrics=functools.partial(metric_collection, settings.metrics),
        workspace=prepared.folder,
        display=progress,
        about={"method": settings.label or prepared.selected.recipe.name, "degradation": prepared.degradation},
        lpips_trunk=settings.metrics.lpips_trunk,
    )
    return prepared.selected.build(run)


def _study(prepared: _Prepared, method: Method) -> Evaluation:
    """Return what evaluates the scenes of a run, with its metrics, of which LPIPS's weights may be fetched."""
    settings, folder, name = prepared.settings, prepared.folder, prepared.selected.recipe.name
    label = settings.label or name
    if method.name is not None and label == name:
        label = method.name
    if method.flag:  # marks scores
        name, label = f"{name}_{method.flag}", f"{label} ({method.flag})"
    metrics = chosen_metrics(settings.metrics, prepared.source.regions)
    formats = {metric.name: metric.format for metric in metrics}

    def illustrate(
        sample: DepthSample,
        depth: torch.Tensor,
        errors: tuple[torch.Tensor, torch.Tensor] | None,
        scores: Mapping[str, float],
    ) -> None:
        """Draw the result of a scene, and its expected errors if there are any."""
        from dsr.pictures.panels import save_picture, write_confidence  # noqa: PLC0415 - slow to import

        save_picture(folder / "pictures" / f"{sample.scene}.png", sample, depth, scores, label, formats)
        if errors is not None:
            path = folder / "confidence" / f"{sample.scene}.png"
            write_confidence(path, depth, *errors, sample.depth, sample.camera)

    return Evaluation(
        folder,
        prepared.source,
        prepared.downsampling,
        prepared.degradation,
        settings.scale,
        method,
        name,
        settings.seed,
        prepared.identity,
        metrics,
        prepared.device,
        noise=prepared.noise,
        holes=prepared.holes,
        alignment=settings.metrics.alignment,
        label=label,
        illustrate=illustrate,
    )


def _run(prepared: _Prepared, method: Method, progress: ConsoleProgress) -> pd.DataFrame:
    """Evaluate each scene once, by this command or by another one of the same settings; return the scores."""
    from dsr.report.dashboard import save_dashboard  # noqa: PLC0415 - slow to import

    settings, folder, source = prepared.settings, prepared.folder, prepared.source
    with rundir.at_work(folder, prepared.plain, prepared.identity):
        if settings.overwrite:
            shutil.rmtree(folder / WORKSPACE, ignore_errors=True)
        _seed(settings.seed)
        named = settings.label or prepared.selected.recipe.name
        progress.say(f"method {named} x{round_ratio(settings.scale)}, {settings.precision} on {prepared.device}")
        prepare_scenes(source, source.scenes(), progress)
        study = _study(prepared, method)
        for remark in method.remarks(source.name, source.scenes(), study.scale):
            note_once(remark)
        results = _evaluate_scenes(prepared, study, progress)
        scores = write_tables(study, results)
        run = read_run(folder)
        save_dashboard(run)
    _report(run, results, {metric.name: metric.format for metric in study.metrics})
    failed = [scene for scene, each in results.items() if each.failure]
    if failed:
        rest = f"; the others are in {folder}" if len(failed) < len(results) else ""
        raise ConfigError(f"{len(failed)} of {len(results)} scenes failed: {', '.join(failed)}{rest}")
    return scores


def _evaluate_scenes(prepared: _Prepared, study: Evaluation, progress: Progress) -> dict[str, SceneResult]:
    """Return the results by scene: in this process, and in others where what is left is worth their start."""
    settings, scenes, (workers, threads) = prepared.settings, study.source.scenes(), _workers(prepared)
    since = time.time() if settings.overwrite else -math.inf
    found: dict[str, SceneResult] = {}
    left, begun = list(scenes), time.monotonic()
    overlap = prepared.device.type != "cpu" and not prepared.selected.recipe.abilities.optimises
    if overlap and settings.precision != "tf32":  # which scores switch off, for all threads
        with computing_threads(threads):
            results = _in_threads(study, scenes, since, progress)
            found.update(progress.track(results, "evaluate", len(scenes), label=itemgetter(0)))
        left = [scene for scene in scenes if scene not in found]
    if left and (workers == 1 or settings.workers == "auto"):
        with computing_threads(threads):
            waiting = free_first(study.folder, left)
            for scene in progress.track(waiting, "evaluate", len(scenes), done=len(found)):
                found[scene] = evaluate_scene(study, scene, since, progress)
                left.remove(scene)
                needed = len(left) * (time.monotonic() - begun) / len(found)
                if workers > 1 and needed > _WORTH_WORKERS:
                    break
    if left:
        with Pool(min(workers, len(left)), _begin, (prepared,), threads, progress.say) as pool:
            results = _in_workers(pool, left, since)
            for scene, result in progress.track(results, "evaluate", len(scenes), done=len(found), label=itemgetter(0)):
                found[scene] = result
    return {scene: found[scene] for scene in scenes}


def _in_threads(
    study: Evaluation, scenes: Sequence[str], since: float, progress: Progress
) -> Iterator[tuple[str, SceneResult]]:
    """Yield the scenes with their results, without those that other commands work on."""
    evaluate_one = functools.partial(_in_worker, study, wait=False, since=since, progress=progress)
    with ThreadPoolExecutor(_BESIDE) as beside:
        try:
            for scene, result in zip(scenes, beside.map(evaluate_one, scenes), strict=True):
                if result is not None:
                    yield scene, result
        except BaseException:  # no further prediction begins
            study.ended.set()
            beside.shutdown(cancel_futures=True)
            raise


def _in_workers(pool: Pool, left: list[str], since: float) -> Iterator[tuple[str, SceneResult]]:
    """Yield the scenes with their results; those that other commands work on come last."""
    try:
        for wait in (False, True):
            evaluate_one = functools.partial(_in_worker, wait=wait, since=since)
            for scene, result in pool.results(evaluate_one, tuple(left)):
                if result is not None:
                    left.remove(scene)
                    yield scene, result
    except ChildProcessError as error:
        yield from ((scene, SceneResult(failure=f"{scene}: {error}")) for scene in left)


def _begin(prepared: _Prepared) -> Evaluation:
    """Prepare a worker, which repeats no note of its parent."""
    _seed(prepared.settings.seed)
    with contextlib.redirect_stderr(io.StringIO()):
        return _study(prepared, _method(prepared, SILENT))


def _in_worker(
    study: Evaluation, scene: str, *, wait: bool, since: float, progress: Progress = SILENT
) -> SceneResult | None:
    """Evaluate a scene in a worker; None if another process works on it, unless its end is waited for."""
    for _ in free_first(study.folder, [scene], wait=wait):
        return evaluate_scene(study, scene, since, progress)
    return None


def _seed(seed: int) -> None:
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 - the legacy generator, for libraries that use it
    torch.manual_seed(seed)


def _report(run: StoredRun, results: Mapping[str, SceneResult], formats: Formats) -> None:
    console = open_console()
    if not run.scores.empty:
        for table in score_tables(run, formats):
            console.print(table)
    scenes_by_note: dict[str, list[str]] = {}
    for scene, result in results.items():
        scenes_by_note.setdefault("; ".join(result.notes), []).append(scene)
    lines = [f"note: {', '.join(scenes)}: {note}" for note, scenes in scenes_by_note.items() if note]
    if unscored := [scene for scene, result in results.items() if result.truth is None]:
        lines.append(f"note: no ground truth to score against: {', '.join(unscored)}")
    lines += [f"no solution: {result.unsolved}" for result in results.values() if result.unsolved]
    if reused := sum(result.reused for result in results.values()):
        lines.append(f"predictions re-used: {reused} (overwrite=true computes them again)")
    for line in (*lines, f"results: {run.folder}"):
        show(console, line)
    for result in results.values():
        if result.failure:
            print_error(result.failure)


def prepare_dataset(request: DataPrepareRequest, console: Console) -> list[str]:
    """Prepare every scene of a data set and draw the contact sheet, ``outputs/data/NAME/sheet.png`` or its pages."""
    from dsr.pictures.sheets import save_contact_sheet  # noqa: PLC0415 - slow to import

    name, directories = request.name, [] if request.config_dir is None else [request.config_dir]
    try:
        settings = EvalConfig.of(plain_config(compose("eval", [f"dataset={name}", *request.settings], directories)))
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(explain(error)) from error
    source = _source(settings)
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

"""Runs of evaluations for tables and rankings: some that lie in no file, and one whose names are all the same text."""

import json
from pathlib import Path

import pandas as pd

from dsr.evaluation.results import Run


def made_up_run(
    label, values, *, dataset="simgeo", scale=4, downsampling="box", seed=0, method=None, share=1.0, **more
):
    """Return a run of some scores in raw units, by scene and by metric, or ``metric[light]``; ``more`` is of Run."""
    method = method or label.lower().replace("-", "_")
    about = {"dataset": dataset, "scale": scale, "downsampling": downsampling, "seed": seed, "method": method}
    rows = []
    for scene, scores in values.items():
        for name, value in scores.items():
            metric, _, variant = name.rstrip("]").partition("[")
            rows.append({**about, "scene": scene, "metric": metric, "variant": variant, "value": value})
    scores = pd.DataFrame(rows).assign(valid_share=share)
    given = {"folder": Path("runs", f"{label}{seed}"), "seconds": {}, "settings": {}, "versions": {}} | more
    return Run(label=label, scores=scores, scenes=tuple(values), **about, **given)


def hostile_run(make_run, folder, name):
    """Write a run whose method, data set, scene and a metric have a name; that of the scene is without slashes."""
    make_run(folder, label=name, method=name, dataset=name, scenes=(name.replace("/", ""),))
    scores = pd.read_csv(folder / "scores.csv", keep_default_na=False)
    scores.replace({"metric": {"Bumpiness_d": name}}).to_csv(folder / "scores.csv", index=False)
    summary = json.loads((folder / "summary.json").read_text())
    summary["metrics"] = {name: {"heading": name, "unit": name, "digits": 1}}
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder

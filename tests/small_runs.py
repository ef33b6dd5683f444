"""Runs of evaluations that lie in no file, for tables and rankings."""

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

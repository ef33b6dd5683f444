"""All that ``dsr data`` fetches: the data sets, and the weights that do not come with a wheel."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, metadata

from dsr.data.download.collections import CATALOGUE, Collection, Item
from dsr.methods import weights
from dsr.utils.versions import DISTRIBUTION

_URL = "Weights"  # the label of the release's files in ``project.urls`` of pyproject.toml


def downloads() -> Mapping[str, Collection]:
    """Return the data sets, and the weights that this installation does not come with, by their names."""
    absent = weights.left_out()
    return {**CATALOGUE, weights.FOLDER: _weights(absent)} if absent else CATALOGUE


def _weights(names: list[str]) -> Collection:
    """Return weights to fetch from the release, or from a mirror."""
    try:
        stated = metadata(DISTRIBUTION).get_all("Project-URL") or []
    except PackageNotFoundError:
        stated = []
    address = dict(each.split(", ", 1) for each in stated).get(_URL, "").rstrip("/")
    items = (
        Item(
            f"{weights.FOLDER}/{name}.safetensors",
            (f"{address}/{name}.safetensors",) if address else (),
            sha256=weights.known()[name],
        )
        for name in names
    )
    return Collection(
        weights.FOLDER,
        "weights of networks for comparison, which a wheel leaves out",
        address or "a checkout has them in src/dsr/methods/weights",
        "Apache-2.0, as dsr.",
        "As of dsr, see docs/citation.md.",
        (weights.FOLDER,),
        None,
        tuple(items),
    )

"""Diverged trainings: their last checkpoint, and a note in the run's directory, by which a repetition is refused."""

from __future__ import annotations

import json
from pathlib import Path

from dsr.app.schema import Identity
from dsr.utils.checkpoints import DivergenceError
from dsr.utils.configuration import ConfigError
from dsr.utils.files import write_text
from dsr.utils.guards import parse_json, read_limited
from dsr.utils.torch_files import read_torch_file

NOTE = "diverged.json"
_ADVICE = (
    "a lower model.optimizer.lr or trainer.gradient_clip_val, or a longer model.scheduler.warmup, may help, with "
    "another output_dir or "
    "overwrite=true"
)


def note_divergence(folder: Path, last: Path, identity: Identity, error: DivergenceError) -> ConfigError:
    """Record that a training diverged, and return the error, which names the last checkpoint and possible remedies.

    Args:
        folder: the run's directory.
        last: path of its last checkpoint, which need not exist.
        identity: the run's, see :func:`dsr.app.run_directory.identity_of`.
        error: the divergence.

    """
    step = step_of(last)
    kept = "it has no earlier checkpoint" if step is None else f"{last} of step {step} is kept"
    write_text(folder / NOTE, json.dumps({"what": str(error), "identity": dict(identity)}, indent=1) + "\n")
    return ConfigError(f"{folder}: the training {error}; {kept}; {_ADVICE}")


def expect_no_divergence(folder: Path, identity: Identity) -> None:
    """Refuse a training that diverged before with the same settings, code and device, as it would again.

    Raises:
        ConfigError: it did.

    """
    note = folder / NOTE
    try:
        stored = parse_json(read_limited(note))
        what, before = str(stored["what"]), stored["identity"]
    except (OSError, ValueError, KeyError, TypeError):  # there is none, or not of this kind
        return
    if before == json.loads(json.dumps(dict(identity))):
        raise ConfigError(
            f"{folder}: the training {what}, and would again; {_ADVICE} (without {note} it continues from its last "
            "checkpoint)"
        )


def step_of(checkpoint: Path) -> int | None:
    """Return the step of a training's checkpoint, None if there is none."""
    try:
        return int(read_torch_file(checkpoint)["global_step"])
    except (ValueError, KeyError, TypeError, OSError, OverflowError):
        return None

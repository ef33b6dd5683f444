"""The LPIPS network of a command, or one line that says why there is none."""

from __future__ import annotations

import functools
import sys
from pathlib import Path

from dsr.metrics.lpips import LPIPS, TRUNK_URL, load_lpips
from dsr.utils.builder import ConfigError
from dsr.utils.console import one_line


@functools.cache
def perceptual_network(trunk: str | None) -> LPIPS | None:
    """Return the LPIPS network; without a trunk, None and one line that says what to do."""
    try:
        return load_lpips(None if trunk is None else Path(trunk).expanduser())
    except OSError as error:
        if trunk is not None:
            raise ConfigError(f"metrics.lpips_trunk: {error}") from error
        print(  # noqa: T201
            f"LPIPS_v is left out: AlexNet's weights {one_line(error)}; "
            f"get {TRUNK_URL} and set metrics.lpips_trunk=FILE or $DSR_LPIPS_TRUNK",
            file=sys.stderr,
        )
        return None
    except ValueError as error:
        raise ConfigError(f"metrics.lpips_trunk: {error}") from error

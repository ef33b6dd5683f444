"""``python -m dsr.cli``."""

from __future__ import annotations

from dsr.utils.interruption import start

start("dsr.cli", "main")

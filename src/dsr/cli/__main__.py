"""``python -m dsr.cli``."""

from __future__ import annotations

import sys

from dsr.cli import main

sys.exit(main())

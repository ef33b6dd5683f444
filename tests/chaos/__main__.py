"""Strike commands and run them at once, and compare with undisturbed results.

``make chaos ARGS="--kills 100 --seed 0"``, on Linux. Files of cases that are not clean are kept.
"""

import argparse
import itertools
import random
import shutil
import signal
import sys
import tempfile
from collections import Counter
from pathlib import Path

from chaos.campaign import Campaign, draw_strikes
from chaos.scenarios import ALL, AT_ONCE, STRUCK


def main() -> int:
    """Run the campaign, and return the exit code."""
    parser = argparse.ArgumentParser("chaos", description=__doc__, allow_abbrev=False)
    parser.add_argument("--kills", type=int, default=100, metavar="N", help="strikes that meet a living command; 100")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of scenarios, signals and moments; 0")
    parser.add_argument("--only", nargs="+", choices=[*STRUCK, *AT_ONCE], metavar="NAME", help=f"of {', '.join(ALL)}")
    parser.add_argument("--grace", type=float, default=5.0, metavar="S", help="seconds for the end after a signal; 5")
    parser.add_argument("--folder", type=Path, metavar="DIR", help="where to work; a temporary folder by default")
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # children of a background job would ignore it
    root = (options.folder or Path(tempfile.mkdtemp(prefix="dsr-chaos-"))).resolve()
    campaign, kills, unclean = Campaign(root, options.grace), Counter[str](), 0

    def conclude(case: str, problems: list[str]) -> None:
        nonlocal unclean
        print(f"{case}: {'UNCLEAN' if problems else 'clean'}", *problems, sep="\n    ", flush=True)
        if problems:
            unclean += 1
            shutil.copytree(campaign.work, root / "unclean" / case, symlinks=True, dirs_exist_ok=True)

    struck = [name for name in STRUCK if name in (options.only or STRUCK)]
    for number in itertools.count():
        for name in struck:
            if kills.total() < options.kills:
                hits, problems = campaign.kill(name, draw_strikes(random.Random(f"{options.seed} {number} {name}")))
                kills[name] += hits
                conclude(f"{name}-{number}", problems)
        if not struck or kills.total() >= options.kills:
            break
    pairs = [name for name in AT_ONCE if name in (options.only or AT_ONCE)]
    draw = random.Random(options.seed)
    for name in pairs:
        conclude(name, campaign.pair(name, draw.choice((0.0, draw.uniform(0, 0.9)))))
    print(f"{kills.total()} kills, {len(pairs)} pairs: {unclean} unclean", *([root / "unclean"] if unclean else []))
    if not unclean and options.folder is None:
        shutil.rmtree(root)
    return int(unclean > 0)


if __name__ == "__main__":
    sys.exit(main())

"""Shards: blocks of frames for tasks that know nothing of each other, such as those of a Slurm array."""

from __future__ import annotations

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Shard:
    """One of the blocks into which frames are split, in their order and as equally as possible.

    Args:
        number: which one, from 1.
        count: number of blocks.

    """

    number: int
    count: int

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def block(self, frames: int) -> range:
        """Return the places of the block's frames among ``frames``; empty if there are fewer of them than blocks."""
        return range((self.number - 1) * frames // self.count, self.number * frames // self.count)


def parse_shard(text: str) -> Shard:
    """Parse ``K/N``.

    Raises:
        ValueError: it is something else, or K is not from 1 to N.

    """
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text, re.ASCII)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise ValueError(f"expected K/N with K from 1 to N, such as 3/16, got {text!r:.40}")
    return Shard(int(match[1]), int(match[2]))

"""Limits of the cloud and the mesh of a result."""

from __future__ import annotations

from dataclasses import dataclass

from dsr.utils.limits import MOST_FACES, MOST_POINTS

LARGEST_ERROR = 0.02
"""Expected error of a pixel's depth, as a fraction of it, from which the pixel is left out of cloud and mesh."""

_FEWEST = 100
"""Smallest limit of triangles and points."""


@dataclass(frozen=True)
class Limits:
    """What cloud and mesh leave out.

    Args:
        error: expected relative error of the depth from which a pixel is left out of both.
        faces: triangles of the mesh, which is simplified beyond.
        points: points of the cloud, which is thinned beyond.

    """

    error: float = LARGEST_ERROR
    faces: int = MOST_FACES
    points: int = MOST_POINTS

    def check(self) -> None:
        """Check the limits, which have the names of options.

        Raises:
            ValueError: one is too small.

        """
        if not self.error > 0:
            raise ValueError(f"--max-error: expected a positive percentage of the depth, got {100 * self.error:g}")
        for name, count in (("--max-faces", self.faces), ("--max-points", self.points)):
            if count < _FEWEST:
                raise ValueError(f"{name}: expected at least {_FEWEST}, got {count}")

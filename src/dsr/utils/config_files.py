"""Find the configuration files: those of the package, and the user's own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parents[1]
_PLACES = (_PACKAGE / "conf", _PACKAGE.parents[1] / "conf")
"""Where the project's own files are: in an installed package, and in a checkout."""


def config_directories(more: Sequence[Path] = ()) -> tuple[Path, ...]:
    """Return the directories of configuration files in the order in which they are searched.

    Args:
        more: the user's own directories, as given by ``--config-dir``.

    Returns:
        The project's directory first, so that no file of the user's replaces one of the project's.

    Raises:
        ValueError: a directory does not exist.

    """
    own = next((place for place in _PLACES if (place / "eval.yaml").is_file()), None)
    if own is None:
        raise ValueError(f"{_PLACES[0]}: expected the configuration files of dsr; the installation is incomplete")
    for directory in more:
        try:
            there = directory.is_dir()
        except OSError:  # such as a name that is too long
            there = False
        if not there:
            raise ValueError(f"--config-dir: expected a directory, got {directory}")
        for path in directory.glob("*/*.yaml"):
            if path.exists() and not path.is_file():  # a pipe would be waited for
                raise ValueError(f"{path}: expected a file, got something else")
            try:
                with path.open("rb") as file:
                    file.read(1)
            except FileNotFoundError:  # a link to nowhere
                continue
            except OSError as error:  # whose own message does not always name the file
                raise ValueError(f"{path}: expected a readable file, got {error.strerror}") from error
    return (own, *more)


def list_choices(group: str, directories: Sequence[Path]) -> list[str]:
    """Return the sorted names of the files of a group, such as ``method``, in all directories."""
    return sorted({path.stem for directory in directories for path in (directory / group).glob("*.yaml")})


def list_groups(directories: Sequence[Path]) -> list[str]:
    """Return the sorted names of the groups in all directories, without those of Hydra's own settings."""
    names = {path.name for directory in directories for path in directory.iterdir() if path.is_dir()}
    return sorted(names - {"hydra"})

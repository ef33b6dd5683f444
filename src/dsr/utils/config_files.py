"""Find the configuration files: those of the package, and the user's own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import yaml

from dsr.utils.guards import TooLargeError, read_limited

_PACKAGE = Path(__file__).resolve().parents[1]
_LARGEST = 2**20
"""Bytes of a file of the user's."""
_MOST_VALUES = 100_000
"""Values of a file of the user's, where each alias counts as what it stands for."""
_PLACES = (_PACKAGE / "conf", _PACKAGE.parents[1] / "conf")
"""Where the project's own files are: in an installed package, and in a checkout."""


def config_directories(more: Sequence[Path] = ()) -> tuple[Path, ...]:
    """Return the directories of configuration files in the order in which they are searched.

    Returns:
        The project's directory first, so that no file of the user's replaces one of the project's.

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
                _expect_moderate(path)
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


def _expect_moderate(path: Path) -> None:
    """Refuse a file that is huge, or a short one whose aliases stand for something huge."""
    try:
        content = read_limited(path, _LARGEST)
        if b"*" not in content:
            return
        values = _count(yaml.compose(content, Loader=yaml.SafeLoader), {})
    except TooLargeError as error:
        raise ValueError(str(error)) from error
    except (ValueError, RecursionError, yaml.YAMLError):  # told where it is composed
        return
    if values > _MOST_VALUES:
        raise ValueError(f"{path}: expected at most {_MOST_VALUES} values, got more by its aliases")


def _count(node: yaml.Node | None, counted: dict[int, int]) -> int:
    """Return the number of values of a node, each node counted once but added wherever it stands."""
    if not isinstance(node, yaml.CollectionNode):
        return 1
    if id(node) not in counted:
        counted[id(node)] = 1
        parts = [part for pair in node.value for part in (pair if isinstance(pair, tuple) else (pair,))]
        counted[id(node)] += sum(_count(part, counted) for part in parts)
    return counted[id(node)]

"""Options of a command as fields of dataclasses: type, default, help and check of each are stated once.

The type says how an option is read: ``bool`` is a flag, ``Literal`` a choice, ``tuple[T, ...]`` one value or more,
``tuple[T, T]`` two values, and ``X | None`` may be left out. A field whose type is such a dataclass again is a group.
"""

from __future__ import annotations

import contextlib
import math
from argparse import SUPPRESS, Namespace
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from types import EllipsisType, MappingProxyType, NoneType
from typing import Any, Literal, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

from dsr.utils.files import obstacle
from dsr.utils.guards import did_you_mean

_KEY = "option"


class OptionError(ValueError):
    """A value is not what its option expects: ``max_hole: expected ...``; on the command line ``--max-hole: ...``."""

    def __init__(self, name: str, message: str) -> None:
        super().__init__(f"{name}: {message}")
        self.name, self.message = name, message


class Rule(NamedTuple):
    """What is expected of a value."""

    expected: str  # in words, which follow "expected"
    holds: Callable[[Any], bool]
    each: bool = False  # whether it is expected of each value of a tuple
    known: Collection[str] = ()  # names of which one is expected; an error line says which may be meant

    def expect(self, name: str, value: Any) -> None:
        """Raise OptionError if the value of an option is not as expected."""
        for one in value if self.each else (value,):
            holds = False
            with contextlib.suppress(TypeError):  # a value of another type, from Python
                holds = self.holds(one)
            if not holds:
                shown = " ".join(map(_shown, one if isinstance(one, tuple) else (one,)))
                raise OptionError(name, f"expected {self.expected}, got {shown}{did_you_mean(one, self.known)}")


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else repr(value) if isinstance(value, str) else str(value)


def at_least(least: int) -> Rule:
    """Return the rule of a number that is not smaller."""
    return Rule(f"at least {least}", lambda value: value >= least)


def positive(what: str) -> Rule:
    """Return the rule of a finite number above 0."""
    return Rule(f"a positive {what}", lambda value: 0 < value < math.inf)


def one_of(choices: Collection[str]) -> Rule:
    """Return the rule of a value that is one of some."""
    return Rule(f"one of {', '.join(choices)}", lambda value: value in choices, known=choices)


def some_of(choices: Collection[str]) -> Rule:
    """Return the rule of a tuple with values that are each one of some."""
    return Rule(f"some of {', '.join(choices)}", lambda value: value in choices, each=True, known=choices)


class _Stated(NamedTuple):
    """What is stated of an option.

    Args:
        flags: its flags, such as ``"-o --output"``, of which errors name the first; or a name without dashes for an
            argument by its place. By default the name of the field.
        rule: what is expected of the value; of a ``Literal`` by default that it is one of its values.
        parse: makes the value of the text on the command line, or of the list of texts if it is ``repeated``.
        alone: options of a record with the same word here exclude each other.
        repeated: whether the option is given once for each value.
        recorded: whether results depend on it, see :func:`recorded`.
        writes: what is written to the path that it is; nothing of another kind may be there.
        presets: of its values those that stand for others: their values, by their names in argparse's namespace. They
            may not be given as anything else.

    """

    help: str
    metavar: str | tuple[str, ...] | None = None
    flags: str = ""
    rule: Rule | None = None
    parse: Callable[[Any], Any] | None = None
    alone: str = ""
    repeated: bool = False
    recorded: bool = True
    writes: Literal["", "file", "folder"] = ""
    presets: Mapping[str, Mapping[str, Any]] = MappingProxyType({})


def option(default: Any, *stated: Any, **further: Any) -> Any:
    """Return a dataclass field that is an option: its default, ``...`` if it has to be given, and :class:`_Stated`."""
    metadata = {_KEY: _Stated(*stated, **further)}
    return field(metadata=metadata) if isinstance(default, EllipsisType) else field(default=default, metadata=metadata)


def group(record: Callable[[], Any] | None = None, title: str = "") -> Any:
    """Return a dataclass field that is a record of options, under a heading in ``--help`` or among those around it.

    Without ``record`` it may be left out: all options that it requires are given, or none of its options.
    """
    if record is None:
        return field(default=None, metadata={_KEY: title})
    return field(default_factory=record, metadata={_KEY: title})


class _Option(NamedTuple):
    """A field with what is stated of it; ``stated`` is the title of a group. ``kind`` is its type without None."""

    name: str
    kind: Any
    optional: bool
    required: bool
    default: Any
    stated: _Stated | str

    @property
    def flags(self) -> list[str]:
        """What it is given by, first what errors name."""
        return self.stated.flags.split() if isinstance(self.stated, _Stated) else []

    @property
    def by_place(self) -> bool:
        """Whether it is an argument without a flag."""
        return not self.flags[0].startswith("-")

    @property
    def key(self) -> str:
        """Where argparse keeps it."""
        long = [flag for flag in self.flags if flag.startswith("--")]
        return (long or self.flags)[0].lstrip("-").replace("-", "_")


def _options_of(record: type) -> Iterator[_Option]:
    """Yield the options and groups of a record, in order."""
    hints = get_type_hints(record)
    for each in fields(record):
        if _KEY not in each.metadata:
            continue
        stated, kinds = each.metadata[_KEY], get_args(hints[each.name])
        optional = NoneType in kinds
        kind = next(one for one in kinds if one is not NoneType) if optional else hints[each.name]
        required = each.default is MISSING and each.default_factory is MISSING
        if isinstance(stated, _Stated):
            rule = one_of(get_args(kind)) if stated.rule is None and get_origin(kind) is Literal else stated.rule
            stated = stated._replace(flags=stated.flags or f"--{each.name.replace('_', '-')}", rule=rule)
        yield _Option(each.name, kind, optional, required, each.default, stated)


def _with_those_of_groups(record: type) -> list[_Option]:
    """Return the options of a record, then those of its groups, without the groups."""
    own = list(_options_of(record))
    groups = [each for each in own if isinstance(each.stated, str)]
    return [each for each in own if each not in groups] + [
        inner for each in groups for inner in _with_those_of_groups(each.kind)
    ]


@dataclass(frozen=True)
class Options:
    """A record of options, which checks its values; dataclasses of options derive from it."""

    def __post_init__(self) -> None:
        """Raise OptionError for a value that is not as expected."""
        for each in _options_of(type(self)):
            value, stated = getattr(self, each.name), each.stated
            if value is None or isinstance(stated, str):
                continue
            found = obstacle(Path(value).expanduser(), folder=stated.writes == "folder") if stated.writes else None
            if found is not None:
                raise OptionError(each.name, f"expected a {stated.writes} to write, got {found}: {value}")
            if stated.rule is not None:
                stated.rule.expect(each.name, value)


Record = TypeVar("Record", bound=Options)


def add_options(place: Any, record: type[Options], *, needed: bool = True) -> None:
    """Add the options of a record, which are required only if it is ``needed``, to a parser or a group of it."""
    excluding: dict[str, Any] = defaultdict(place.add_mutually_exclusive_group)
    for each in _options_of(record):
        if isinstance(each.stated, str):
            inner = place.add_argument_group(each.stated) if each.stated else place
            add_options(inner, each.kind, needed=needed and not each.optional)
        else:
            where = excluding[each.stated.alone] if each.stated.alone else place
            where.add_argument(*each.flags, **_keywords(each, each.stated, needed=needed))


def _keywords(each: _Option, stated: _Stated, *, needed: bool) -> dict[str, Any]:
    """Return argparse's arguments of an option; an option that isn't given is absent from the namespace."""
    keywords: dict[str, Any] = {"help": stated.help.replace("%", "%%"), "default": SUPPRESS}
    if needed and each.required and not each.by_place:
        keywords["required"] = True
    if each.kind is bool:
        return {**keywords, "action": "store_false" if each.default is True else "store_true"}
    if stated.metavar is not None:
        keywords["metavar"] = stated.metavar
    if stated.repeated:
        keywords["action"] = "append"
    if stated.parse is not None:
        return keywords
    kinds = get_args(each.kind)
    if get_origin(each.kind) is Literal:
        return {**keywords, "choices": kinds}
    left_out = each.by_place and not each.required
    if get_origin(each.kind) is not tuple:
        if left_out:
            keywords |= {"nargs": "?", "default": each.default}  # of which argparse would make a path
        return {**keywords, "type": each.kind}
    if not stated.repeated:
        keywords["nargs"] = len(kinds) if kinds[-1] is not Ellipsis else "*" if left_out else "+"
    return {**keywords, "type": kinds[0]}


def build(record: type[Record], given: Namespace) -> Record:
    """Return a record of the options given on the command line; the message of an error begins with the flag."""
    options = _with_those_of_groups(record)
    values = dict(vars(given))
    for each in options:
        presets = each.stated.presets if isinstance(each.stated, _Stated) else {}
        for key, value in presets[values[each.key]].items() if presets and each.key in values else ():
            if values.setdefault(key, value) != value:
                flag = next(other.flags[0] for other in options if other.key == key)
                wrong = f"expected {flag} {value} or none with it, got {flag} {values[key]}"
                raise ValueError(f"{each.flags[0]} {values[each.key]}: {wrong}")
    try:
        return _built(record, values)
    except OptionError as error:
        flag = next((each.flags[0] for each in options if each.name == error.name), error.name)
        raise ValueError(f"{flag}: {error.message}") from error


def _built(record: type[Record], given: Mapping[str, Any]) -> Record:
    values: dict[str, Any] = {}
    for each in _options_of(record):
        if isinstance(each.stated, str):
            if not (each.optional and _is_absent(each.kind, given)):
                values[each.name] = _built(each.kind, given)
        elif each.key in given:
            came, parse = given[each.key], each.stated.parse or (tuple if get_origin(each.kind) is tuple else None)
            try:
                values[each.name] = came if parse is None else parse(came)
            except OptionError as error:
                raise ValueError(f"{each.flags[0]} {error}") from error
            except ValueError as error:
                raise ValueError(f"{each.flags[0]}: {error}") from error
    return record(**values)


def _is_absent(record: type[Options], given: Mapping[str, Any]) -> bool:
    """Return whether no option of a record is given; if one is, those that it requires have to be, too."""
    options = list(_options_of(record))
    there = [each for each in options if each.key in given]
    lacking = [each for each in options if each.required and each not in there]
    if there and lacking:
        raise ValueError(f"{there[0].flags[0]}: expected {lacking[0].flags[0]} with it")
    return not there


def recorded(record: Options) -> dict[str, Any]:
    """Return the options that results depend on, under the names of their flags, as values for JSON."""
    found: dict[str, Any] = {}
    for each in _options_of(type(record)):
        value = getattr(record, each.name)
        if isinstance(each.stated, str):
            found |= {} if value is None else recorded(value)
        elif each.stated.recorded:
            found[each.key] = list(value) if isinstance(value, tuple) else value
    return found

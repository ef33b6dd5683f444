"""Options of a command as fields of dataclasses: type, default, help and check of each are stated once.

The type says how an option is read: ``bool`` is a flag, ``Literal`` a choice, ``tuple[T, ...]`` one value or more,
``tuple[T, T]`` two values, and ``X | None`` may be left out. A field whose type is such a dataclass again is a group.
"""

import contextlib
import math
from argparse import SUPPRESS, ArgumentTypeError, Namespace
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from types import EllipsisType, NoneType
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
                shown = " ".join(
                    f"{each:g}" if isinstance(each, float) else repr(each) if isinstance(each, str) else str(each)
                    for each in (one if isinstance(one, tuple) else (one,))
                )
                raise OptionError(name, f"expected {self.expected}, got {shown}{did_you_mean(one, self.known)}")


def at_least(least: int) -> Rule:
    """Return the rule of a number that is not smaller."""
    return Rule(f"at least {least}", lambda value: value >= least)


def positive(what: str) -> Rule:
    """Return the rule of a finite number above 0."""
    return Rule(f"a positive {what}", lambda value: 0 < value < math.inf)


def one_of(choices: Collection[str]) -> Rule:
    """Return the rule of a value that is one of some."""
    return Rule(f"one of {', '.join(choices)}", lambda value: value in choices, known=choices)


@dataclass
class _Option:
    """What is stated of an option or of a group, and what its field says."""

    help: str = ""  # of a group its heading
    metavar: str | tuple[str, ...] | None = None
    flags: str = ""  # such as "-o --output", by default the field's name; without dashes it is an argument by its place
    rule: Rule | None = None  # by default that a value of a Literal is one of them
    parse: Callable[[Any], Any] | None = None  # of the text on the command line, or of the texts if it is ``repeated``
    alone: str = ""  # options of a record with the same word here exclude each other
    repeated: bool = False  # whether it is given once for each value
    recorded: bool = True  # whether results depend on it, see :func:`recorded`
    writes: Literal["", "file", "folder"] = ""  # what is written to the path; nothing of another kind may be there
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # what some of its values set, by ``key``
    group: bool = False
    name: str = ""
    kind: Any = None  # the type without None
    optional: bool = False
    required: bool = False
    default: Any = None

    @property
    def flag(self) -> str:
        """What errors name."""
        return self.flags.split()[0]

    @property
    def key(self) -> str:
        """Where argparse keeps it."""
        long = [flag for flag in self.flags.split() if flag.startswith("--")]
        return (long or [self.flag])[0].lstrip("-").replace("-", "_")


def option(default: Any, *stated: Any, **further: Any) -> Any:
    """Return a dataclass field that is an option: its default, ``...`` if it has to be given, and :class:`_Option`."""
    metadata = {_KEY: _Option(*stated, **further)}
    return field(metadata=metadata) if isinstance(default, EllipsisType) else field(default=default, metadata=metadata)


def group(record: Callable[[], Any] | None = None, title: str = "") -> Any:
    """Return a dataclass field that is a record of options, under a heading in ``--help`` or among those around it.

    Without ``record`` it may be left out: all options that it requires are given, or none of its options.
    """
    metadata = {_KEY: _Option(title, group=True)}
    if record is None:
        return field(default=None, metadata=metadata)
    return field(default_factory=record, metadata=metadata)


def _options_of(record: type) -> Iterator[_Option]:
    hints = get_type_hints(record)
    for each in fields(record):
        stated, kind = each.metadata[_KEY], hints[each.name]
        optional = NoneType in get_args(kind)
        if optional:
            kind = next(one for one in get_args(kind) if one is not NoneType)
        yield replace(
            stated,
            flags=stated.flags or f"--{each.name.replace('_', '-')}",
            rule=one_of(get_args(kind)) if stated.rule is None and get_origin(kind) is Literal else stated.rule,
            name=each.name,
            kind=kind,
            optional=optional,
            required=each.default is MISSING and each.default_factory is MISSING,
            default=each.default,
        )


def _with_those_of_groups(record: type) -> list[_Option]:
    own = list(_options_of(record))
    inner = [_with_those_of_groups(each.kind) for each in own if each.group]
    return sum(inner, [each for each in own if not each.group])


@dataclass(frozen=True)
class Options:
    """A record of options, which checks its values; dataclasses of options derive from it."""

    def __post_init__(self) -> None:
        for each in _options_of(type(self)):
            value = getattr(self, each.name)
            if value is None or each.group:
                continue
            if each.writes and (found := obstacle(Path(value).expanduser(), folder=each.writes == "folder")):
                raise OptionError(each.name, f"expected a {each.writes} to write, got {found}: {value}")
            if each.rule is not None:
                each.rule.expect(each.name, value)


Record = TypeVar("Record", bound=Options)


def add_options(place: Any, record: type[Options], *, needed: bool = True) -> None:
    """Add a record's options, required only if ``needed``, to a parser or a group; the namespace lacks others."""
    excluding: dict[str, Any] = defaultdict(place.add_mutually_exclusive_group)
    for each in _options_of(record):
        if each.group:
            inner = place.add_argument_group(each.help) if each.help else place
            add_options(inner, each.kind, needed=needed and not each.optional)
            continue
        keywords: dict[str, Any] = {"help": each.help.replace("%", "%%"), "default": SUPPRESS}
        if needed and each.required and each.flags.startswith("-"):
            keywords["required"] = True
        if each.kind is bool:
            keywords["action"] = "store_false" if each.default is True else "store_true"
        else:
            keywords |= _of_values(each)
        (excluding[each.alone] if each.alone else place).add_argument(*each.flags.split(), **keywords)


def _of_values(each: _Option) -> dict[str, Any]:
    keywords: dict[str, Any] = {} if each.metavar is None else {"metavar": each.metavar}
    if each.repeated:
        keywords["action"] = "append"
    if each.parse is not None:
        return keywords
    kinds, left_out = get_args(each.kind), not (each.flags.startswith("-") or each.required)
    if get_origin(each.kind) is Literal:
        return {**keywords, "choices": kinds}
    if get_origin(each.kind) is not tuple:
        if left_out:
            keywords |= {"nargs": "?", "default": each.default}  # of which argparse would make a path
        kinds = (each.kind,)
    elif not each.repeated:
        keywords["nargs"] = len(kinds) if kinds[-1] is not Ellipsis else "*" if left_out else "+"
    return {**keywords, "type": _path if kinds[0] is Path else kinds[0]}


def _path(text: str) -> Path:
    if not text.strip():  # which would be the current directory
        raise ArgumentTypeError("expected a path, got an empty text")
    return Path(text)


def build(record: type[Record], given: Namespace) -> Record:
    """Return a record of the options given on the command line; the message of an error begins with the flag."""
    options = _with_those_of_groups(record)
    values = dict(vars(given))
    for each in options:
        chosen = each.presets.get(values[each.key], {}) if each.presets and each.key in values else {}
        for key, value in chosen.items():
            if values.setdefault(key, value) != value:
                flag = next(other.flag for other in options if other.key == key)
                wrong = f"expected {flag} {value} or none with it, got {flag} {values[key]}"
                raise ValueError(f"{each.flag} {values[each.key]}: {wrong}")
    try:
        return _built(record, values)
    except OptionError as error:
        flag = next((each.flag for each in options if each.name == error.name), error.name)
        raise ValueError(f"{flag}: {error.message}") from error


def _built(record: type[Record], given: Mapping[str, Any]) -> Record:
    values: dict[str, Any] = {}
    for each in _options_of(record):
        if each.group:
            inner = list(_options_of(each.kind)) if each.optional else []
            there = [one for one in inner if one.key in given]
            lacking = [one for one in inner if one.required and one not in there]
            if there and lacking:
                raise ValueError(f"{there[0].flag}: expected {lacking[0].flag} with it")
            if there or not each.optional:
                values[each.name] = _built(each.kind, given)
        elif each.key in given:
            parse = each.parse or (tuple if get_origin(each.kind) is tuple else lambda value: value)
            try:
                values[each.name] = parse(given[each.key])
            except OptionError as error:
                raise ValueError(f"{each.flag} {error}") from error
            except ValueError as error:
                raise ValueError(f"{each.flag}: {error}") from error
    return record(**values)


def recorded(record: Options) -> dict[str, Any]:
    """Return the options that results depend on, under the names of their flags, as values for JSON."""
    found: dict[str, Any] = {}
    for each in _options_of(type(record)):
        value = getattr(record, each.name)
        if each.group:
            found |= {} if value is None else recorded(value)
        elif each.recorded:
            found[each.key] = list(value) if isinstance(value, tuple) else value
    return found

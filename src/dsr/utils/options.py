"""Options of a command as fields of dataclasses: type, default, help and check of each are stated once.

The type says how an option is read: ``bool`` is a flag, ``Literal`` a choice, ``tuple[T, ...]`` one value or more,
``tuple[T, T]`` two values, and ``X | None`` may be left out. A field whose type is such a dataclass again is a group.

Example:
    >>> from argparse import ArgumentParser
    >>> @dataclass(frozen=True, kw_only=True)
    ... class Frames(Options):
    ...     folder: str = option(..., "where they are", "DIR")
    ...     most: int = option(24, "at most N frames", "N", rule=at_least(1))
    >>> parser = ArgumentParser()
    >>> add_options(parser, Frames)
    >>> build(Frames, parser.parse_args(["--folder", "scans", "--most", "3"])).most
    3
    >>> build(Frames, parser.parse_args(["--folder", "scans", "--most", "0"]))
    Traceback (most recent call last):
    ...
    ValueError: --most: expected at least 1, got 0

"""

from __future__ import annotations

import math
from argparse import SUPPRESS, Namespace
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
        super().__init__(name, message)
        self.name, self.message = name, message

    def __str__(self) -> str:
        return f"{self.name}: {self.message}"


def _shown(value: Any) -> str:
    values = value if isinstance(value, tuple) else (value,)
    return " ".join(f"{each:g}" if isinstance(each, float) else str(each) for each in values)


class Rule(NamedTuple):
    """What is expected of a value.

    Args:
        expected: in words, which follow "expected".
        each: whether it is expected of each value of a tuple.
        shown: how an error line shows a value.
        known: names of which one is expected, if any are; an error line says which may be meant.

    """

    expected: str
    holds: Callable[[Any], bool]
    each: bool = False
    shown: Callable[[Any], str] = _shown
    known: Collection[str] = ()

    def expect(self, name: str, value: Any) -> None:
        """Raise OptionError if the value of an option is not as expected."""
        for one in value if self.each else (value,):
            try:
                fits = self.holds(one)
            except TypeError:  # of another type, which only Python gives
                fits = False
            if not fits:
                meant = did_you_mean(one, self.known)
                raise OptionError(name, f"expected {self.expected}, got {self.shown(one)}{meant}")


def at_least(least: int) -> Rule:
    """Return the rule of a number that is not smaller."""
    return Rule(f"at least {least}", lambda value: value >= least)


def positive(what: str) -> Rule:
    """Return the rule of a finite number above 0."""
    return Rule(f"a positive {what}", lambda value: 0 < value < math.inf)


def one_of(choices: Collection[str], shown: Callable[[Any], str] = repr) -> Rule:
    """Return the rule of a value that is one of some."""
    return Rule(f"one of {', '.join(choices)}", lambda value: value in choices, shown=shown, known=choices)


def some_of(choices: Collection[str], shown: Callable[[Any], str] = repr) -> Rule:
    """Return the rule of a tuple with values that are each one of some."""
    return Rule(f"some of {', '.join(choices)}", lambda value: value in choices, True, shown, choices)


class _Option(NamedTuple):
    help: str
    metavar: str | tuple[str, ...] | None
    flags: str
    rule: Rule | None
    parse: Callable[[Any], Any] | None
    alone: str
    repeated: bool
    recorded: bool
    writes: str
    presets: Mapping[str, Mapping[str, Any]]


def option(
    default: Any,
    help: str,  # noqa: A002 - as argparse names it
    metavar: str | tuple[str, ...] | None = None,
    *,
    flags: str = "",
    rule: Rule | None = None,
    parse: Callable[[Any], Any] | None = None,
    alone: str = "",
    repeated: bool = False,
    recorded: bool = True,
    writes: Literal["", "file", "folder"] = "",
    presets: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> Any:
    """Return a dataclass field that is an option.

    Args:
        default: the value where it is not given; ``...`` if it has to be given.
        flags: its flags, such as ``"-o --output"``, of which errors name the first; or a name without dashes for an
            argument by its place. By default the name of the field.
        rule: what is expected of the value; of a ``Literal`` by default that it is one of its values.
        parse: makes the value of the text on the command line, or of the list of texts if it is ``repeated``.
        alone: options of a record with the same word here exclude each other.
        repeated: whether the option is given once for each value.
        recorded: whether results depend on it, see :func:`recorded`.
        writes: what is written to the path that it is; nothing of another kind may be there, see
            :func:`dsr.utils.files.obstacle`.
        presets: of its values those that stand for others: their values, as argparse reads them, by their names there.
            They may not be given as anything else.

    """
    metadata = {_KEY: _Option(help, metavar, flags, rule, parse, alone, repeated, recorded, writes, presets)}
    return field(metadata=metadata) if isinstance(default, EllipsisType) else field(default=default, metadata=metadata)


def group(record: Callable[[], Any] | None = None, title: str = "") -> Any:
    """Return a dataclass field that is a record of options.

    Args:
        record: the record; None where it may be left out: then all that it needs is given, or nothing of it.
        title: its heading in ``--help``; without one its options are among those around it.

    """
    default = {"default": None} if record is None else {"default_factory": record}
    return field(**default, metadata={_KEY: title})


class _Stated(NamedTuple):
    """A field: its type without None, whether that is allowed, and what was stated of it as an option or a group."""

    name: str
    hint: Any
    optional: bool
    required: bool
    default: Any
    option: _Option | None
    title: str
    flags: list[str]  # the one that errors name first
    rule: Rule | None

    @property
    def by_place(self) -> bool:
        """Whether it is an argument without a flag."""
        return not self.flags[0].startswith("-")

    @property
    def key(self) -> str:
        """Where argparse keeps it."""
        long = [flag for flag in self.flags if flag.startswith("--")]
        return (long or self.flags)[0].lstrip("-").replace("-", "_")


def _stated(record: type) -> tuple[_Stated, ...]:
    """Return the options and groups of a record, in order."""
    hints, found = get_type_hints(record), []
    for each in fields(record):
        if _KEY not in each.metadata:
            continue
        stated, hint = each.metadata[_KEY], hints[each.name]
        optional = NoneType in get_args(hint)
        if optional:
            hint = next(kind for kind in get_args(hint) if kind is not NoneType)
        option, title = (stated, "") if isinstance(stated, _Option) else (None, stated)
        flags = ([] if option is None else option.flags.split()) or [f"--{each.name.replace('_', '-')}"]
        rule = None if option is None else option.rule
        if option is not None and rule is None and get_origin(hint) is Literal:
            rule = one_of(get_args(hint))
        required = each.default is MISSING and each.default_factory is MISSING
        found.append(_Stated(each.name, hint, optional, required, each.default, option, title, flags, rule))
    return tuple(found)


@dataclass(frozen=True)
class Options:
    """A record of options, which checks its values; dataclasses of options derive from it."""

    def __post_init__(self) -> None:
        """Raise OptionError for a value that is not as expected."""
        for each in _stated(type(self)):
            value = getattr(self, each.name)
            if value is None:
                continue
            if each.option is not None and each.option.writes:
                found = obstacle(Path(value).expanduser(), folder=each.option.writes == "folder")
                if found is not None:
                    raise OptionError(each.name, f"expected a {each.option.writes} to write, got {found}: {value}")
            if each.rule is not None:
                each.rule.expect(each.name, value)


Record = TypeVar("Record", bound=Options)


def add_options(place: Any, record: type[Options], *, needed: bool = True) -> None:
    """Add the options of a record, which are required only if it is ``needed``, to a parser or a group of it."""
    excluding: dict[str, Any] = {}
    for each in _stated(record):
        if each.option is None:
            inner = place.add_argument_group(each.title) if each.title else place
            add_options(inner, each.hint, needed=needed and not each.optional)
            continue
        where, alone = place, each.option.alone
        if alone:
            where = excluding[alone] = excluding.get(alone) or place.add_mutually_exclusive_group()
        where.add_argument(*each.flags, **_keywords(each, each.option, needed=needed))


def _keywords(each: _Stated, option: _Option, *, needed: bool) -> dict[str, Any]:
    """Return argparse's arguments of an option; what isn't given is absent from what it returns."""
    keywords: dict[str, Any] = {"help": option.help.replace("%", "%%"), "default": SUPPRESS}
    if needed and each.required and not each.by_place:
        keywords["required"] = True
    if each.hint is bool:
        return {**keywords, "action": "store_false" if each.default is True else "store_true"}
    if option.metavar is not None:
        keywords["metavar"] = option.metavar
    kinds = get_args(each.hint)
    if option.repeated:
        keywords["action"] = "append"
    if option.parse is not None:
        return keywords
    if get_origin(each.hint) is Literal:
        return {**keywords, "choices": kinds}
    if get_origin(each.hint) is not tuple:
        if each.by_place and not each.required:
            keywords |= {"nargs": "?", "default": each.default}  # of which argparse would make a path
        return {**keywords, "type": each.hint}
    if not option.repeated:
        several = "*" if each.by_place and not each.required else "+"
        keywords["nargs"] = several if kinds[-1] is Ellipsis else len(kinds)
    return {**keywords, "type": kinds[0]}


def build(record: type[Record], given: Namespace) -> Record:
    """Return a record of the options given on the command line; the message of an error begins with the flag."""
    given = _with_presets(record, given)
    values: dict[str, Any] = {}
    for each in _stated(record):
        if each.option is not None and hasattr(given, each.key):
            values[each.name] = _value(each, each.option, getattr(given, each.key))
        elif each.option is None and not (each.optional and _is_absent(each.hint, given)):
            values[each.name] = build(each.hint, given)
    try:
        return record(**values)
    except OptionError as error:  # of the record itself or of a group in it
        flag = next((each.flags[0] for each in _walk(record) if each.name == error.name), error.name)
        raise ValueError(f"{flag}: {error.message}") from error


def _with_presets(record: type[Options], given: Namespace) -> Namespace:
    """Return what was given with what presets among it stand for; a ValueError if something else was given for it."""
    found = Namespace(**vars(given))
    walked = list(_walk(record))
    flags = {each.key: each.flags[0] for each in walked}
    for each in walked:
        if each.option is None or not each.option.presets or not hasattr(given, each.key):
            continue
        chosen = getattr(given, each.key)
        for key, value in each.option.presets[chosen].items():
            if key in flags and getattr(given, key, value) != value:
                came = f"{flags[key]} {getattr(given, key)}"
                raise ValueError(f"{each.flags[0]} {chosen}: expected {flags[key]} {value} or none with it, got {came}")
            setattr(found, key, value)
    return found


def _value(each: _Stated, option: _Option, came: Any) -> Any:
    """Return the value that stands for what argparse read."""
    if option.parse is None:
        return tuple(came) if get_origin(each.hint) is tuple else came
    try:
        return option.parse(came)
    except OptionError as error:
        raise ValueError(f"{each.flags[0]} {error}") from error
    except ValueError as error:
        raise ValueError(f"{each.flags[0]}: {error}") from error


def _is_absent(record: type[Options], given: Namespace) -> bool:
    """Return whether no option of a record is given."""
    there = [each for each in _stated(record) if hasattr(given, each.key)]
    for each in _stated(record) if there else ():
        if each.required and each not in there:
            raise ValueError(f"{there[0].flags[0]}: expected {each.flags[0]} with it")
    return not there


def _walk(record: type[Options]) -> Iterator[_Stated]:
    """Yield the options of a record, then those of its groups."""
    stated = _stated(record)
    yield from (each for each in stated if each.option is not None)
    for each in stated:
        if each.option is None:
            yield from _walk(each.hint)


def recorded(record: Options) -> dict[str, Any]:
    """Return the options that results depend on, under the names of their flags, as values for JSON."""
    found: dict[str, Any] = {}
    for each in _stated(type(record)):
        value = getattr(record, each.name)
        if each.option is None:
            found |= {} if value is None else recorded(value)
        elif each.option.recorded:
            found[each.key] = list(value) if isinstance(value, tuple) else value
    return found

"""Mutations of text, JSON, YAML and tables."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import yaml

from fuzz import values

_LONGEST = 16 << 20  # Characters of a line that is made longer, and of all lines that are added
_HOLE = "\ue000hole\ue000"
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_YAML = (
    "!!python/object/apply:os.mkdir ['{canary}']", "!!python/object/apply:os.system ['mkdir {canary}']",
    "!!python/name:os.system", "!!python/module:os", "!!binary aGVsbG8=", "&a [*a]", "*nowhere", "!!float x", "!<x> 1",
    "${{oc.env:HOME}}", "${{oc.decode:'[1,2]'}}", "${{x.y}}", "${{", "{{? }}", "1:20", "2001-01-01", "0o17",
    "~", "<<: 1", "!!set {{a, b}}", "!!omap [a: 1]", "|\n  text", "???",
)  # fmt: skip
_BOMB = "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{b}: &{b} [{','.join(['*' + a] * 10)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)


def mutate_text(random: Random, text: str, canary: Path) -> bytes:
    """Return a text with something changed."""
    return random.choice(_TEXT)(random, text, canary)


def mutate_json(random: Random, text: str, canary: Path) -> bytes:
    """Return JSON with something changed: a value, a key, or the text."""
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return mutate_text(random, text, canary)
    if random.random() < 0.2:
        return mutate_text(random, text, canary)
    if random.random() < 0.3:
        changed = json.dumps(_replaced(random, content, _HOLE))
        return changed.replace(json.dumps(_HOLE), random.choice(values.RAW), 1).encode()
    return json.dumps(_changed(random, content, canary)).encode()


def mutate_yaml(random: Random, text: str, canary: Path) -> bytes:
    """Return YAML with something changed: a value, a key, a tag, or the text."""
    try:
        content = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError):
        return mutate_text(random, text, canary)
    pick = random.random()
    if pick < 0.15:
        return mutate_text(random, text, canary)
    if pick < 0.2:
        return (text + "\n" + _BOMB).encode()
    if pick < 0.45:
        changed = yaml.safe_dump(_replaced(random, content, _HOLE), sort_keys=False, allow_unicode=True)
        value = (
            random.choice((*_YAML, *values.RAW)).replace("{canary}", str(canary)).replace("{{", "{").replace("}}", "}")
        )
        return changed.replace(_HOLE, value, 1).encode(errors="surrogatepass")
    return yaml.safe_dump(_changed(random, content, canary), sort_keys=False).encode(errors="surrogatepass")


def _places(content: Any) -> list[tuple[Any, Any]]:
    """Return the containers in a content with each of their keys; long lists count with a few.

    A container that stands in several places, as by the aliases of a bomb from an earlier change, is counted once.
    """
    found: list[tuple[Any, Any]] = []
    seen: set[int] = set()
    containers = [(content, 0)]
    while containers:
        each, depth = containers.pop(0)
        if id(each) in seen or depth > 12 or not isinstance(each, dict | list):
            continue
        seen.add(id(each))
        keys = list(each) if isinstance(each, dict) else list(range(len(each)))
        keys = keys if len(keys) < 40 else [*keys[:10], *keys[-5:]]
        found += [(each, key) for key in keys]
        containers += [(each[key], depth + 1) for key in keys]
    return found


def _replaced(random: Random, content: Any, value: Any) -> Any:
    """Return a content with one of its values replaced."""
    places = _places(content)
    if not places or random.random() < 0.03:
        return value
    container, key = random.choice(places)
    container[key] = value
    return content


def _changed(random: Random, content: Any, canary: Path) -> Any:
    """Return a content with one or two things changed."""
    for _ in range(random.choice((1, 1, 1, 2))):
        places = _places(content)
        pick = random.random()
        if pick < 0.6 or not places:
            content = _replaced(random, content, values.plain(random, canary))
            continue
        container, key = random.choice(places)
        if pick < 0.72:
            del container[key]
        elif pick < 0.8 and isinstance(container, dict):
            container[random.choice(("", "x", "_target_", "__class__", "a" * 300, str(key) + " ", "\x1b[2J"))] = (
                container.pop(key)
            )
        elif pick < 0.9 and isinstance(container, dict):
            container[random.choice(("_target_", "extra", "__init__", "defaults", "root", "\u202e"))] = values.plain(
                random, canary
            )
        else:
            other, name = random.choice(places)
            if not isinstance(other[name], dict | list):
                container[key] = other[name]
    return content


def _number(random: Random, text: str, _: Path) -> bytes:
    found = list(_NUMBER.finditer(text))
    if not found:
        return b"1e400"
    each = random.choice(found)
    return (text[: each.start()] + random.choice(values.NUMBERS) + text[each.end() :]).encode(errors="replace")


def _word(random: Random, text: str, canary: Path) -> bytes:
    found = list(re.finditer(r"[^\s,;:\"'{}\[\]]+", text))
    if not found:
        return b"x"
    each = random.choice(found)
    value = random.choice(
        (*values.NUMBERS, *values.RAW, *values.OUTSIDE, str(canary), "\0", "\x1b[2J", "%00", "a" * 300)
    )
    return (text[: each.start()] + value + text[each.end() :]).encode(errors="replace")


def _lines(random: Random, text: str, _: Path) -> bytes:
    lines = text.splitlines() or [""]
    at = random.randrange(len(lines))
    kind = random.randrange(7)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(at, lines[random.randrange(len(lines))])
    elif kind == 2:
        lines[at : at + 2] = [" ".join(lines[at : at + 2])]
    elif kind == 3:
        lines[at] = lines[at][: random.randrange(len(lines[at]) + 1)]
    elif kind == 4:
        lines = lines[:at]
    else:  # a long line, or many lines, within what a worker can hold
        fits = max(2, _LONGEST // (len(lines[at]) + 1))
        if kind == 5:
            lines[at] = lines[at] * min(2000, fits)
        else:
            lines[at:at] = [lines[at]] * min(3000, fits)
    return "\n".join(lines).encode(errors="replace")


def _coding(random: Random, text: str, _: Path) -> bytes:
    return random.choice((
        lambda: text.encode("utf-16"), lambda: b"\xef\xbb\xbf" + text.encode(),
        lambda: text.replace("\n", "\r").encode(), lambda: b"\x80" + text.encode(),
        lambda: text.replace("\n", "\r\n").encode(), lambda: text.encode() + b"\xff\xfe\x80",
        lambda: text.encode().replace(b" ", b"\0"), lambda: text.replace(" ", "\u00a0").encode(),
        lambda: text.replace(",", ";").encode(), lambda: text.upper().encode(), lambda: text.encode("utf-32"),
        lambda: text.replace('"', "'").encode(), lambda: b'"' + text.encode(), lambda: text.replace("\n", "").encode(),
    ))()  # fmt: skip


def _cut(random: Random, text: str, _: Path) -> bytes:
    return text.encode()[: random.randrange(len(text) + 1)]


_Mutation = Callable[[Random, str, Path], bytes]
_TEXT: tuple[_Mutation, ...] = (_number, _number, _number, _word, _word, _lines, _lines, _coding, _cut)

"""Mutations of text, JSON and YAML: values of wrong types, out of range, huge, deep or malicious in place of others."""

import json
import os
import pickle
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

import yaml

from fuzz.guard import MARK

_DEEP = 10_000  # Levels of nested lists
_LONGEST = 16 << 20  # Characters of a line that is made longer, and of all lines that are added
_PLAIN: tuple[Any, ...] = (
    None, True, False, "", -1, 0, 1, 2, 0.5, -0.0, 1e-320, 1e19, 1e308, -1e308, 2**31, 2**63, -(2**63), 2**64, 10**30,
    [], {}, [[]], {"": {}}, [1, 2, 3], [1e6] * 100, {"a": 1}, "nan", "None", "0", "1/0", "abc", " ", "\n", "\0",
    "\x1b[31m", "é\u202e\ufeff", "../../etc/passwd", "/etc/passwd", "/dev/zero", "~", "a/b", ".", "..", "C:\\x",
    "a" * 300, "${oc.env:HOME}", "${now:%Y}", "%s%n{0}", "=1+1", "<script>alert(1)</script>",
    "\\input{/etc/passwd}", "x" * 10_000,
)  # fmt: skip
_RAW = (
    "1e400", "-1e400", "NaN", "Infinity", "-Infinity", "9" * 400, "-" + "9" * 400, "0." + "9" * 400, "1e-400",
    "1e999999", "9" * 5000, "[" * _DEEP + "]" * _DEEP, '{"a":' * _DEEP + "1" + "}" * _DEEP, "0x10", "01", "+1", "1_000",
    "'", "\\u0000", '"\\ud800"', "tru", "",
)  # fmt: skip
"""Texts in place of a value in JSON or another text."""
NUMBERS = (
    "nan", "inf", "-inf", "1e400", "-1e400", "1e308", "1e-320", "0", "-0", "-1", "1", "9" * 400, "9" * 5000, "abc", "",
    "1e19", "4294967296", "18446744073709551616", "0x1p3", "1_0", "1,5", "٣", "--1", "1e", "3.", ".", "x" * 10_000,
    "2147483647", "1e7",
)  # fmt: skip
_WORDS = (
    *NUMBERS, *_RAW, "../" * 9 + "etc/passwd", "../../etc/passwd", "..\\..\\etc\\passwd", "C:\\etc\\passwd", MARK, "\0",
    "\x1b[2J", "%00", "a" * 300,
)  # fmt: skip
_TARGETS = (
    "os.system", "os.mkdir", "subprocess.run", "builtins.exec", "builtins.eval", "shutil.rmtree", "pathlib.Path",
    f"{MARK}.run", f"{MARK}", "dsr.cli.main", "dsr.methods", "dsr.nowhere.X", "..", "a b.c", ".x", "x.", "json.loads",
    "dsr.utils.files.write_text", "dsr.utils.configuration.load_object", "torch.load",
)  # fmt: skip
_KEYS = ("", "x", "_target_", "__class__", "__init__", "defaults", "root", "a" * 300, "\x1b[2J", "\u202e")
_YAML = (
    f"!!python/object/apply:os.mkdir ['{MARK}']", f"!!python/object/apply:os.system ['mkdir {MARK}']",
    "!!python/name:os.system", "!!python/module:os", "!!binary aGVsbG8=", "&a [*a]", "*nowhere", "!!float x", "!<x> 1",
    "${oc.env:HOME}", "${oc.decode:'[1,2]'}", "${x.y}", "${", "{? }", "1:20", "2001-01-01", "0o17", "~", "<<: 1",
    "!!set {a, b}", "!!omap [a: 1]", "|\n  text", "???",
)  # fmt: skip
_HOLE = "dsr-hole"


class _Payload:
    """An object whose pickle makes a folder when it is read."""

    def __init__(self, what: int, canary: Path) -> None:
        self._what, self._canary = what, str(canary)

    def __reduce__(self) -> tuple[Any, ...]:
        code = f"import os\nos.makedirs({self._canary!r}, exist_ok=True)"
        return (
            (os.mkdir, (self._canary,)),
            (os.system, (f"mkdir -p '{self._canary}'",)),
            (exec, (code,)),
            (eval, (f"__import__('os').makedirs({self._canary!r})",)),
        )[self._what]


def pickled(random: Random, canary: Path) -> bytes:
    """Return a pickle that makes the canary, perhaps hidden among plain values."""
    payload: Any = _Payload(random.randrange(4), canary)
    content = random.choice((payload, {"model_state_dict": payload, "state_dict": {"a": payload}}))
    return pickle.dumps(content, protocol=random.choice((0, 2, 4, 5)))


def mutate_text(random: Random, text: str) -> bytes:
    """Return a text with something changed."""
    return random.choice(_TEXT)(random, text)


def mutate_structured(random: Random, text: str, *, of_yaml: bool) -> bytes:
    """Return JSON or YAML with something changed: a value, a key, a tag, or the text."""
    try:
        content = yaml.safe_load(text) if of_yaml else json.loads(text)
    except (yaml.YAMLError, ValueError, RecursionError):
        content = None
    places = _places(content)
    pick = random.random()
    if pick < 0.2 or not places:
        return mutate_text(random, text)
    (container, key), (other, name) = random.choice(places), random.choice(places)
    value: Any = random.choice((*_PLAIN, *_TARGETS, MARK))
    if pick < 0.25:
        value = {"_target_": random.choice(_TARGETS), "name": "x", "command": f"mkdir {MARK}", "path": MARK}
    raw = random.choice((*_YAML, *_RAW) if of_yaml else _RAW)
    if pick < 0.45:
        value = _HOLE
    if pick < 0.75:
        container[key] = value
    elif pick < 0.82:
        del container[key]
    elif pick < 0.92 and isinstance(container, dict):
        container[random.choice((*_KEYS, f"{key} "))] = random.choice((value, container.pop(key)))
    elif not isinstance(other[name], dict | list):
        container[key] = other[name]
    changed = yaml.safe_dump(content, sort_keys=False, allow_unicode=True) if of_yaml else json.dumps(content)
    return changed.replace(_HOLE if of_yaml else json.dumps(_HOLE), raw, 1).encode(errors="surrogatepass")


def _places(content: Any) -> list[tuple[Any, Any]]:
    """Return the containers in a content with each of their keys; long lists count with a few, aliases once."""
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


def _replace(pattern: str, values: Sequence[str]) -> Callable[[Random, str], bytes]:
    """Return a mutation that puts a value in the place of one match of a pattern."""

    def change(random: Random, text: str) -> bytes:
        found = list(re.finditer(pattern, text))
        value = random.choice(values)
        if found:
            each = random.choice(found)
            value = text[: each.start()] + value + text[each.end() :]
        return value.encode(errors="replace")

    return change


def _lines(random: Random, text: str) -> bytes:
    lines = text.splitlines() or [""]
    at = random.randrange(len(lines))
    fits = max(2, _LONGEST // (len(lines[at]) + 1))  # repetitions within what a worker can hold
    changes = (
        [],
        [lines[at], random.choice(lines)],
        [" ".join(lines[at : at + 2])],
        [lines[at][: random.randrange(len(lines[at]) + 1)]],
        [lines[at] * min(2000, fits)],
        [lines[at]] * min(3000, fits),
    )
    lines[at : at + 1] = random.choice(changes)
    if random.random() < 0.15:
        lines = lines[:at]
    return "\n".join(lines).encode(errors="replace")


def _coding(random: Random, text: str) -> bytes:
    content = text.encode()
    return random.choice((
        text.encode("utf-16"), text.encode("utf-32"), b"\xef\xbb\xbf" + content, b"\x80" + content,
        content + b"\xff\xfe\x80", content.replace(b"\n", b"\r"), content.replace(b"\n", b"\r\n"),
        content.replace(b"\n", b""), content.replace(b" ", b"\0"), text.replace(" ", "\u00a0").encode(),
        content.replace(b",", b";"), content.upper(), content.replace(b'"', b"'"), b'"' + content,
    ))  # fmt: skip


def _cut(random: Random, text: str) -> bytes:
    return text.encode()[: random.randrange(len(text) + 1)]


_NUMBER = _replace(r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?", NUMBERS)
_WORD = _replace(r"[^\s,;:\"'{}\[\]]+", _WORDS)
_TEXT = (_NUMBER, _NUMBER, _NUMBER, _WORD, _WORD, _lines, _lines, _coding, _cut)

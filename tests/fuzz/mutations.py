"""What happens to valid files in a case: their bytes, what they hold, and what lies in their place.

Attacks that somebody has thought of have unit tests: archives of gigabytes or with paths outside, headers of arrays.
"""

import io
import os
import pickle
import re
import struct
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

from bombs import npy_head

from fuzz.guard import MARK
from fuzz.judging import Place

_PICKLED = (".pth", ".ckpt", ".npy", ".npz", ".mat", ".safetensors", ".r3d", ".caffemodel", ".depth", ".exr", ".tiff")
_INTEGERS = (0, 1, 2, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xFFFFFFFE, 100000)
_ANOTHER = ("../../etc/passwd", "/etc/passwd", "/dev/zero", "/dev/stdin", "/proc/self/mem", ".", "nowhere")
_MEMBERS = ("../" * 6 + "tmp/x", f"{MARK}/x", "..\\x", "a" * 300, "%s\0", "./%s", "/%s", "extra.npy")
_TOKEN = r'"[^"\n]*"|[^\s,;:"\'{}\[\]]+'
_TOKENS = (
    "nan", "inf", "-Infinity", "1e400", "1e308", "1e-320", "0", "-0", "-1", "1", "0.5", "9" * 400, "9" * 5000, "1e19",
    "4294967296", "18446744073709551616", "0x1p3", "1_0", "1,5", "٣", "--1", "3.", ".", "2147483647", "1e999999",
    "null", "true", '""', "", "[]", "{}", "[1, 2, 3]", '{"a": 1}', "[" * 9000, '{"a":' * 9000, '"\\ud800"', "'", "\0",
    "\x1b[2J", "é\u202e\ufeff", "a" * 300, "x" * 10_000, "../../etc/passwd", "/dev/zero", "..\\..\\x", "%s%n{0}",
    "${oc.env:HOME}", "<script>alert(1)</script>", "\\input{/etc/passwd}", "_target_", "os.system", "builtins.exec",
    "dsr.cli.main", f"{MARK}.run", f"{{_target_: os.mkdir, path: {MARK}}}",
    f"!!python/object/apply:os.mkdir ['{MARK}']", "!!python/name:os.system", "!!binary aGVsbG8=", "&a [*a]",
    "*nowhere", "<<: 1", "1:20", "2001-01-01", "|\n  text",
)  # fmt: skip


class _Payload:
    """An object whose pickle makes a folder when it is read."""

    def __init__(self, what: int, canary: Path) -> None:
        self._what, self._canary = what, str(canary)

    def __reduce__(self) -> tuple[Any, ...]:
        code = f"import os\nos.makedirs({self._canary!r}, exist_ok=True)"
        return ((os.mkdir, (self._canary,)), (os.system, (f"mkdir -p '{self._canary}'",)), (exec, (code,)))[self._what]


def pickled(random: Random, canary: Path) -> bytes:
    """Return a pickle that makes the canary, perhaps hidden among plain values."""
    payload: Any = _Payload(random.randrange(3), canary)
    content = random.choice((payload, {"model_state_dict": payload, "state_dict": {"a": payload}}))
    return pickle.dumps(content, protocol=random.choice((0, 2, 4, 5)))


def mutate(random: Random, place: Place, other: Callable[[], bytes]) -> list[str]:
    """Change the files of a place, or put the content of another reader's in one, and return what was changed."""
    done = []
    for _ in range(random.choice((1, 1, 1, 1, 2, 3))):
        files = sorted(path for path in place.input.rglob("*") if path.is_file() and not path.is_symlink())
        if not files:
            break
        suffix = random.choice(sorted({path.suffix for path in files}))  # many pictures don't hide one description
        path = random.choice([path for path in files if path.suffix == suffix])
        pick = random.random()
        if pick < 0.12:
            done.append(_replace_in_folder(random, path))
            continue
        if pick < 0.16:
            kind, content = "a file of another kind", other()
        elif suffix in _PICKLED and pick < 0.2:
            head = npy_head((1,), "|O") if suffix == ".npy" else b""
            kind, content = "a pickle", head + pickled(random, place.canary)
        else:
            kind, content = _change(random, path.read_bytes(), place.canary)
        path.write_bytes(content)
        done.append(f"{path.name}: {kind}")
    return done


def _change(random: Random, content: bytes, canary: Path) -> tuple[str, bytes]:
    """Return the name of a mutation of a file's content, and its result."""
    if content[:4] == b"PK\3\4" and random.random() < 0.7:
        return "archive", _change_zip(random, content, canary)
    try:
        text = content.decode()
    except UnicodeDecodeError:
        text = ""
    if not text or "\0" in text or random.random() < 0.3:
        return _change_bytes(random, content)
    return "text", _change_text(random, text)


def _change_bytes(random: Random, content: bytes) -> tuple[str, bytes]:
    """Return the name of a mutation of bytes, and its result."""
    size = len(content)
    if not size:
        return "bytes", b"\0"
    at, other = random.randrange(min(size, random.choice((16, 64, 512, size)))), random.randrange(size)
    form = random.choice(("<I", ">I", "<H", ">H", "<Q"))
    number = struct.pack(form, random.choice(_INTEGERS) % (1 << 8 * struct.calcsize(form)))
    block = random.choice((b"\0", b"\xff", random.randbytes(1))) * min(random.choice((1, 4, 16, 200, size)), size - at)
    added = random.choice((random.randbytes(20), b"\0" * 300, content[:50], b"\xff" * 4))
    flipped = bytearray(content)
    for _ in range(random.choice((1, 1, 3, 30))):
        flipped[random.randrange(size)] ^= 1 << random.randrange(8)
    changes = {
        "cut off": content[:other],
        "flipped": bytes(flipped),
        "overwritten": content[:at] + block + content[at + len(block) :],
        "inserted": content[:at] + added + content[at:],
        "deleted": content[:at] + content[at + random.choice((1, 2, 9, 100, 1000)) :],
        "integer": content[:at] + number + content[at + len(number) :],
        "noise": random.choice((b"", random.randbytes(min(size, 5000)), content + b"\0" * 1000)),
    }
    kind = random.choice(list(changes))
    return f"{kind} at {at}", changes[kind]


def _change_text(random: Random, text: str) -> bytes:
    """Return a text, JSON or YAML with a number, word or value, a line, or the coding changed."""
    if random.random() < 0.7:
        found = list(re.finditer(_TOKEN, text))
        each = random.choice(found) if found else None
        start, end = (each.start(), each.end()) if each else (0, len(text))
        if text[start] == '"' and random.random() < 0.5:
            start, end = start + 1, end - 1
        return (text[:start] + random.choice(_TOKENS) + text[end:]).encode(errors="surrogatepass")
    lines, content = text.splitlines() or [""], text.encode()
    at = random.randrange(len(lines))
    changed = ([], [lines[at], random.choice(lines)], [lines[at][: len(lines[at]) // 2]], [lines[at]] * 300)
    lines[at : at + 1] = random.choice(changed)
    return random.choice((
        "\n".join(lines).encode(), "\n".join(lines[:at]).encode(), text.encode("utf-16"), b"\xef\xbb\xbf" + content,
        b"\x80" + content, content.replace(b"\n", b"\r\n"), content.replace(b"\n", b""), content.replace(b",", b";"),
        content.replace(b'"', b"'"), content.upper(),
    ))  # fmt: skip


def _change_zip(random: Random, content: bytes, canary: Path) -> bytes:
    """Return an archive with a member changed, renamed or left out, or with two of a name."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [(each.filename, archive.read(each)) for each in archive.infolist()]
    except Exception:  # it is damaged already
        members = []
    if not members:
        return content[: len(content) // 2]
    at = random.randrange(len(members))
    name, inner = members[at]
    pickles = name.endswith(("data.pkl", ".npy")) and random.random() < 0.3
    changed = pickled(random, canary) if pickles else _change(random, inner, canary)[1]
    members[at : at + 1] = random.choice((
        [(name, changed)], [(name, changed)], [(random.choice(_MEMBERS).replace("%s", name), inner)], [],
        [(name, inner), (name, changed)],
    ))  # fmt: skip
    file = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w") as archive:
        warnings.simplefilter("ignore")  # of names that are there twice
        for name, inner in members:
            archive.writestr(zipfile.ZipInfo(name), inner, zipfile.ZIP_DEFLATED)
    return file.getvalue()


def _replace_in_folder(random: Random, path: Path) -> str:
    """Put something else in a file's place."""
    kind = random.choice(("missing", "directory", "loop", "fifo", "link", "empty"))
    path.unlink()
    if kind == "directory":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "fifo":
        os.mkfifo(path)
    elif kind == "link":
        path.symlink_to(random.choice(_ANOTHER))
    elif kind == "empty":
        path.touch()
    return f"{path.name}: {kind}"

"""What happens to valid files in a case: their bytes, what they hold, and what lies in their place."""

import contextlib
import functools
import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from random import Random

from fuzz import containers, texts, values
from fuzz.place import Place

_YAML = (".yaml", ".yml")
_PICKLED = (".pth", ".ckpt", ".npy", ".npz", ".mat", ".safetensors", ".r3d", ".caffemodel", ".depth", ".exr", ".tiff")
_KINDS = (
    "cut off", "flipped bits", "overwritten", "inserted", "deleted", "integer", "integer", "swapped", "noise",
)  # fmt: skip
"""Of what happens to bytes."""
_INTEGERS = (0, 1, 2, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xFFFFFFFE, 100000)
_SPARSE = 2200 << 20  # Size in bytes of files that take no room on the disk
_ANOTHER = ("../../etc/passwd", "/etc/passwd", "/dev/zero", "/dev/stdin", "/proc/self/mem", ".", "nowhere")
_NAMES = (
    b"\xff\xfe%s", b"-%s", b" %s", b"%s\n", b"a" * 200 + b"%s", b"\x1b[31m%s", b"%s.txt", b"=%s", b"'%s'", b"..%s",
    b"\xe2\x80\xae%s",
)  # fmt: skip


def mutate(random: Random, place: Place, other: Callable[[], bytes]) -> list[str]:
    """Change the files of a place, and return what was changed, for people.

    Args:
        random: decides everything.
        place: the folders, with valid files.
        other: returns the content of a file of another reader.

    """
    done = []
    for _ in range(random.choice((1, 1, 1, 1, 2, 3))):
        files = sorted(path for path in place.input.rglob("*") if _is_plain(path))
        if not files:
            break
        path = random.choice(_favoured(random, files))
        pick = random.random()
        if pick < 0.12:
            done.append(_replace_in_folder(random, path, place))
        elif pick < 0.16:
            path.write_bytes(other())
            done.append(f"{path.name}: a file of another kind")
        else:
            done.append(_change_content(random, path, place.canary))
    return done


def _is_plain(path: Path) -> bool:
    """Return whether a path is a file whose content is still to be changed."""
    return path.is_file() and not path.is_symlink() and path.stat().st_size < _SPARSE


def _favoured(random: Random, files: list[Path]) -> list[Path]:
    """Return the files of one suffix, so that many pictures do not hide the one description of them."""
    suffix = random.choice(sorted({path.suffix for path in files}))
    return [path for path in files if path.suffix == suffix]


def _change_content(random: Random, path: Path, canary: Path) -> str:
    """Change what is in a file."""
    content = path.read_bytes()
    if path.suffix in _PICKLED and random.random() < 0.06:
        path.write_bytes(values.pickled(random, canary, inside=random.random() < 0.5))
        return f"{path.name}: a pickle"
    kind, changed = change(random, path.suffix, content, canary)
    path.write_bytes(changed)
    return f"{path.name}: {kind}"


def change(random: Random, suffix: str, content: bytes, canary: Path) -> tuple[str, bytes]:
    """Return the name of a mutation of a file's content, and its result."""
    if random.random() < 0.3:
        return _change_bytes(random, content)
    text = _as_text(content)
    if text is not None:
        json, yaml = suffix == ".json" or text[:1] in "{[", suffix in _YAML
        how = texts.mutate_json if json else texts.mutate_yaml if yaml else texts.mutate_text
        return "JSON" if json else "YAML" if yaml else "text", how(random, text, canary)
    return _change_binary(random, suffix, content, canary)


def _change_binary(random: Random, suffix: str, content: bytes, canary: Path) -> tuple[str, bytes]:
    """Return the name of a mutation that knows the format of bytes, and its result."""
    if content[:6] == b"\x93NUMPY":
        return "array", containers.mutate_npy(random, content, canary)
    if content[:4] == b"PK\3\4":
        unpacked = {"blocks": (10,)} if suffix == ".zip" else {}  # what is unpacked to the disk may be large
        member = functools.partial(_member, random, canary)
        return "archive", containers.mutate_zip(random, content, canary, member, **unpacked)
    if content[:2] == b"\x1f\x8b" or content[257:262] == b"ustar":
        return "archive", containers.mutate_tar(random, content, canary)
    return _change_bytes(random, content)


def _member(random: Random, canary: Path, name: str, content: bytes) -> bytes:
    """Return the changed content of an archive's member; ``data.pkl`` of torch may become another pickle."""
    if name.endswith("data.pkl") and random.random() < 0.5:
        return values.pickled(random, canary, inside=random.random() < 0.5)
    suffix = Path(name).suffix
    return change(random, suffix if suffix or name != "metadata" else ".json", content, canary)[1]


def _as_text(content: bytes) -> str | None:
    """Return the text of a file; None for bytes of no text."""
    with contextlib.suppress(UnicodeDecodeError):
        text = content.decode()
        return text if text and "\0" not in text else None
    return None


def _change_bytes(random: Random, content: bytes) -> tuple[str, bytes]:
    """Return the name of a mutation of bytes, and its result."""
    size = len(content)
    if not size:
        return "bytes", b"\0"
    changed = bytearray(content)
    at, other = random.randrange(min(size, random.choice((16, 64, 512, size)))), random.randrange(size)
    kind = random.choice(_KINDS)
    if kind == "cut off":
        del changed[other:]
    elif kind == "flipped bits":
        for _ in range(random.choice((1, 1, 3, 30))):
            changed[random.randrange(size)] ^= 1 << random.randrange(8)
    elif kind == "overwritten":
        length = min(random.choice((1, 4, 16, 200, size)), size - at)
        changed[at : at + length] = random.choice((b"\0", b"\xff", bytes([random.randrange(256)]))) * length
    elif kind == "inserted":
        changed[at:at] = random.choice((random.randbytes(20), b"\0" * 300, content[:50], b"\xff" * 4))
    elif kind == "deleted":
        del changed[at : at + random.choice((1, 2, 9, 100, 1000))]
    elif kind == "integer":
        form = random.choice(("<I", ">I", "<H", ">H", "<Q"))
        number = random.choice(_INTEGERS) % (1 << 8 * struct.calcsize(form))
        changed[at : at + struct.calcsize(form)] = struct.pack(form, number)
    elif kind == "swapped":
        changed[at : at + 64], changed[other : other + 64] = changed[other : other + 64], changed[at : at + 64]
    else:
        changed = bytearray(random.choice((b"", random.randbytes(min(size, 5000)), content + b"\0" * 1000)))
    return f"{kind} at {at}", bytes(changed)


def _replace_in_folder(random: Random, path: Path, place: Place) -> str:
    """Put something else in a file's place, or the file in another."""
    kind = random.choice((*_PLACES, "folder"))
    if kind == "folder" and path.parent != place.input:
        folder = path.parent
        shutil.rmtree(folder)
        if random.random() < 0.5:
            folder.write_bytes(b"no folder")
        return f"{folder.name}/: no folder"
    if kind == "name":
        name = os.fsdecode((random.choice(_NAMES) % os.fsencode(path.name))[:250])
        path.rename(path.with_name(name))
        return f"{path.name}: another name, {name[:60]!r}"
    if kind == "sparse":
        os.truncate(path, _SPARSE)
        return f"{path.name}: 2.2 GB"
    path.unlink()
    if kind == "directory":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "fifo":
        os.mkfifo(path)
    elif kind == "link":
        target = random.choice(_ANOTHER)
        path.symlink_to(target)
        return f"{path.name}: a link to {target}"
    elif kind == "empty":
        path.touch()
    return f"{path.name}: {kind}"


_PLACES = (
    "missing", "missing", "directory", "directory", "loop", "fifo", "fifo", "link", "link", "empty", "name", "name",
    "sparse",
)  # fmt: skip

"""What happens to valid files in a case: their bytes, what they hold, and what lies in their place."""

import io
import os
import shutil
import struct
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np
from bombs import LARGE, zeros

from fuzz.guard import MARK
from fuzz.judging import Place
from fuzz.texts import mutate_structured, mutate_text, pickled

_PICKLED = (".pth", ".ckpt", ".npy", ".npz", ".mat", ".safetensors", ".r3d", ".caffemodel", ".depth", ".exr", ".tiff")
_INTEGERS = (0, 1, 2, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xFFFFFFFE, 100000)
_SPARSE = 2200 << 20  # Size in bytes of files that take no room on the disk
_ANOTHER = ("../../etc/passwd", "/etc/passwd", "/dev/zero", "/dev/stdin", "/proc/self/mem", ".", "nowhere")
_NAMES = (
    b"\xff\xfe%s", b"-%s", b" %s", b"%s\n", b"a" * 200 + b"%s", b"\x1b[31m%s", b"%s.txt", b"=%s", b"'%s'", b"..%s",
    b"\xe2\x80\xae%s",
)  # fmt: skip
_SHAPES = (
    "()", "(0,)", "(0, 5)", "(-1, 4)", "(10**9, 10**9)", "(1000000000, 1000000000)", "(40000, 40000)", "(2, 3)",
    "(1,) * 40", "(3.0, 4)", "(True, 4)", "'x'", "(12, 16, 1)", "(192,)", "(16, 12)", "(" + "1, " * 70 + ")",
    "(9223372036854775807, 2)",
)  # fmt: skip
_TYPES = (
    "'|O'", "'<f8'", "'<f2'", "'>f4'", "'|u1'", "'<c16'", "'<M8[s]'", "'|S5'", "'<U9'", "[('a', '<f4'), ('b', '|O')]",
    "'|b1'", "'|V4'", "'<f16'", "'x'", "None", "'<i8'", "[('a', '<f4', (100000, 100000))]", "'|S2000000000'",
    "(" * 50 + ")" * 50, f"__import__('os').mkdir({MARK!r})",
)  # fmt: skip
_MEMBERS = ("../" * 6 + "tmp/x", f"{MARK}/x", "..\\x", "", "a" * 300, "%s\0", "./%s", "/%s", "extra.npy")
_MOST = 1 << 26  # Bytes in an archive, unpacked, that may be changed once more


def mutate(random: Random, place: Place, other: Callable[[], bytes]) -> list[str]:
    """Change the files of a place, or put the content of another reader's in one, and return what was changed."""
    done = []
    for _ in range(random.choice((1, 1, 1, 1, 2, 3))):
        files = sorted(path for path in place.input.rglob("*") if _is_plain(path))
        if not files:
            break
        suffix = random.choice(sorted({path.suffix for path in files}))  # many pictures don't hide one description
        path = random.choice([path for path in files if path.suffix == suffix])
        pick = random.random()
        if pick < 0.12:
            done.append(_replace_in_folder(random, path, place))
            continue
        if pick < 0.16:
            kind, content = "a file of another kind", other()
        elif suffix in _PICKLED and pick < 0.2:
            kind, content = "a pickle", pickled(random, place.canary)
        else:
            kind, content = _change(random, suffix, path.read_bytes(), place.canary)
        path.write_bytes(content)
        done.append(f"{path.name}: {kind}")
    return done


def _is_plain(path: Path) -> bool:
    """Return whether a path is a file whose content is still to be changed."""
    return path.is_file() and not path.is_symlink() and path.stat().st_size < _SPARSE


def _change(random: Random, suffix: str, content: bytes, canary: Path) -> tuple[str, bytes]:
    """Return the name of a mutation of a file's content, and its result."""
    if random.random() < 0.3:
        return _change_bytes(random, content)
    if content[:6] == b"\x93NUMPY":
        return "array", _change_array(random, content, canary)
    if content[:4] == b"PK\3\4":
        return "archive", _change_zip(random, content, canary, on_disk=suffix == ".zip")
    return _change_text(random, suffix, content)


def _change_text(random: Random, suffix: str, content: bytes) -> tuple[str, bytes]:
    """Return the name of a mutation of a text and its result; bytes that are none are changed as such."""
    try:
        text = content.decode()
    except UnicodeDecodeError:
        text = ""
    if not text or "\0" in text:
        return _change_bytes(random, content)
    if suffix in (".yaml", ".json") or text[:1] in "{[":
        return "values", mutate_structured(random, text, of_yaml=suffix == ".yaml")
    return "text", mutate_text(random, text)


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
        "integers": number * (size // len(number)),
        "noise": random.choice((b"", random.randbytes(min(size, 5000)), content + b"\0" * 1000)),
    }
    kind = random.choice(list(changes))
    return f"{kind} at {at}", changes[kind]


def _change_array(random: Random, content: bytes, canary: Path) -> bytes:
    """Return an ``.npy`` file with a pickle, or with a header that says something else."""
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception:  # it is damaged already
        return content[: len(content) // 2]
    if random.random() < 0.2:
        return _header("'|O'", "(1,)") + pickled(random, canary)
    descr, shape = repr(np.lib.format.dtype_to_descr(array.dtype)), repr(array.shape)
    order = random.choice(("True", "None", "0", "'x'", "False, 'x': 1"))
    headers = (
        _header(random.choice(_TYPES), shape),
        _header(descr, random.choice(_SHAPES)),
        _header(descr, random.choice(_SHAPES)),
        _header(descr, shape, order),
        _header(descr, shape, version=random.choice((2, 3, 4, 9))),
    )
    return random.choice(headers) + array.tobytes()


def _header(descr: str, shape: str, order: str = "False", version: int = 1) -> bytes:
    """Return the header of an ``.npy`` file that says anything."""
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", len(text)) + text


def _change_zip(random: Random, content: bytes, canary: Path, *, on_disk: bool) -> bytes:
    """Return an archive with a member changed, renamed, added, left out or huge."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(each.file_size for each in archive.infolist()) > _MOST:  # an earlier change has blown it up
                return content[: len(content) // 2]
            members = [(each.filename, archive.read(each)) for each in archive.infolist()]
    except Exception:  # it is damaged already
        return content[: len(content) // 2]
    if not members:
        return b""
    at, kind, huge = random.randrange(len(members)), random.randrange(10), -1
    name, inner = members[at]
    if kind <= 4:
        members[at] = (name, _change_member(random, name, inner, canary))
    elif kind <= 6:
        members[at] = (random.choice(_MEMBERS).replace("%s", name), inner)
    elif kind == 7:
        del members[at]
    elif kind == 8:
        members.append((name, _change_member(random, name, inner, canary)))  # a second one of the name
    else:
        huge = at
    file = io.BytesIO()
    how = random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)) if huge < 0 else zipfile.ZIP_DEFLATED
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w", how, compresslevel=1) as archive:
        warnings.simplefilter("ignore")  # of names that are there twice
        for number, (name, inner) in enumerate(members):
            size = LARGE // 4 if on_disk else LARGE  # a disk may hold what is unpacked
            zeros(archive, name, inner, size if number == huge else 0)
    return file.getvalue()


def _change_member(random: Random, name: str, content: bytes, canary: Path) -> bytes:
    """Return the changed content of an archive's member; ``data.pkl`` of torch may become another pickle."""
    if name.endswith("data.pkl") and random.random() < 0.5:
        return pickled(random, canary)
    return _change(random, Path(name).suffix, content, canary)[1]


def _replace_in_folder(random: Random, path: Path, place: Place) -> str:
    """Put something else in a file's place, or the file in another."""
    kind = random.choice(("missing", "directory", "loop", "fifo", "link", "empty", "name", "sparse", "no folder"))
    if kind == "name":
        name = os.fsdecode((random.choice(_NAMES) % os.fsencode(path.name))[:250])
        path.rename(path.with_name(name))
        return f"{path.name}: another name, {name[:60]!r}"
    if kind == "sparse":
        os.truncate(path, _SPARSE)
    elif kind == "no folder" and path.parent != place.input:
        shutil.rmtree(path.parent)
        path.parent.write_bytes(b"no folder")
    else:
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

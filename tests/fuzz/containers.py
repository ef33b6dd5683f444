"""Mutations of arrays and archives that keep the file whole but lie in its headers."""

import io
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from random import Random

import numpy as np

from fuzz import values

_SHAPES = (
    "()", "(0,)", "(0, 5)", "(-1, 4)", "(10**9, 10**9)", "(1000000000, 1000000000)", "(40000, 40000)", "(2, 3)",
    "(1,) * 40", "(3.0, 4)", "(True, 4)", "'x'", "(12, 16, 1)", "(192,)", "(16, 12)", "(" + "1, " * 70 + ")",
    "(9223372036854775807, 2)",
)  # fmt: skip
_TYPES = (
    "'|O'", "'<f8'", "'<f2'", "'>f4'", "'|u1'", "'<c16'", "'<M8[s]'", "'|S5'", "'<U9'", "[('a', '<f4'), ('b', '|O')]",
    "'|b1'", "'|V4'", "'<f16'", "'x'", "None", "'<i8'", "[('a', '<f4', (100000, 100000))]", "'|S2000000000'",
    "(" * 50 + ")" * 50,
)  # fmt: skip
_KINDS = (
    tarfile.REGTYPE, tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE, tarfile.DIRTYPE,
    tarfile.GNUTYPE_SPARSE, b"9",
)  # fmt: skip
"""Of the members of a tar archive."""
_BLOCK = 1 << 24
_MOST = 1 << 26  # Bytes in an archive, unpacked, that may be changed once more


def npy_header(descr: str, shape: str, order: str = "False", extra: str = "", version: int = 1) -> bytes:
    """Return the header of an ``.npy`` file that says anything."""
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, {extra}}}\n".encode()
    kind, largest = ("<H", 0xFFFF) if version == 1 else ("<I", 0xFFFFFFFF)
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack(kind, min(len(text), largest)) + text


def mutate_npy(random: Random, content: bytes, canary: Path) -> bytes:
    """Return an ``.npy`` file with another header or a pickle."""
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception:  # it is damaged already
        return content[: len(content) // 2]
    if random.random() < 0.2:
        return npy_header("'|O'", "(1,)") + values.pickled(random, canary)
    return _with_header(random, array, canary)


def _with_header(random: Random, array: np.ndarray, canary: Path) -> bytes:
    """Return an array behind a header that says something else."""
    descr, shape = repr(np.lib.format.dtype_to_descr(array.dtype)), repr(array.shape)
    code = f"__import__('os').mkdir({str(canary)!r})"
    headers = (
        lambda: npy_header(random.choice(_TYPES), shape),
        lambda: npy_header(descr, random.choice(_SHAPES)),
        lambda: npy_header(descr, random.choice(_SHAPES)),
        lambda: npy_header(descr, shape, random.choice(("True", "None", "0", "'x'")), random.choice(("", "'x': 1,"))),
        lambda: npy_header(descr, shape, version=random.choice((2, 3, 4, 9))),
        lambda: npy_header(code, shape),
    )
    return random.choice(headers)() + array.tobytes()


def mutate_zip(
    random: Random,
    content: bytes,
    canary: Path,
    mutate: Callable[[str, bytes], bytes],
    blocks: tuple[int, ...] = (200, 400),
) -> bytes:
    """Return an archive with a member changed, renamed, added or left out, or with lies in its directory.

    Args:
        random: decides what.
        content: an archive.
        canary: what must not be made.
        mutate: returns the changed content of a member, given its name and content.
        blocks: of 16 MB, of zeros behind a member.

    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if sum(each.file_size for each in archive.infolist()) > _MOST:  # an earlier change has blown it up
                return content[: len(content) // 2]
            members = [(each.filename, archive.read(each)) for each in archive.infolist()]
    except Exception:  # it is damaged already
        return content[: len(content) // 2]
    if not members:
        return b""
    at, kind = random.randrange(len(members)), random.randrange(12)
    name, inner = members[at]
    if kind <= 4:
        members[at] = (name, mutate(name, inner))
    elif kind == 5:
        names = (
            "../" * 6 + "tmp/x",
            str(canary / "x"),
            "..\\x",
            "",
            "a" * 300,
            name + "\0",
            name.upper(),
            "./" + name,
            "/" + name,
        )
        members[at] = (random.choice(names), inner)
    elif kind == 6:
        del members[at]
    elif kind == 7:
        members.append((name, mutate(name, inner)))  # a second one of the name
    elif kind == 8:
        members.insert(random.randrange(len(members) + 1), ("extra.npy", npy_header("'<f8'", "(3,)") + bytes(24)))
    elif kind == 9:
        return _bomb(name, inner, random.choice(blocks), members)
    packed = _zipped(members, random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)))
    return _lying(random, packed) if kind >= 10 else packed


def _zipped(members: list[tuple[str, bytes]], how: int) -> bytes:
    import warnings  # noqa: PLC0415

    file = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w", how) as archive:
        warnings.simplefilter("ignore")  # of names that are there twice
        for name, inner in members:
            archive.writestr(zipfile.ZipInfo(name), inner, compress_type=how)
    return file.getvalue()


def _lying(random: Random, content: bytes) -> bytes:
    """Return an archive whose directory says something else of one member."""
    changed = bytearray(content)
    at, local = changed.rfind(b"PK\1\2"), changed.find(b"PK\3\4")
    if at < 0 or local < 0:
        return content
    place, form, number = random.choice((
        (8, "<H", 1), (8, "<H", 0x41), (10, "<H", 99), (10, "<H", 12), (16, "<I", 7), (20, "<I", 0xFFFFFFFE),
        (20, "<I", 1), (24, "<I", 0xFFFFFFFE), (24, "<I", 1), (24, "<I", 0),
        (28, "<H", 0xFFFF), (42, "<I", 0xFFFFFFF0), (42, "<I", 9),
    ))  # fmt: skip
    struct.pack_into(form, changed, at + place, number)
    if random.random() < 0.5 and place in (8, 10, 16, 20, 24):
        struct.pack_into(form, changed, local + place - 2, number)
    return bytes(changed)


def _bomb(name: str, inner: bytes, blocks: int, others: list[tuple[str, bytes]]) -> bytes:
    """Return an archive one of whose members is followed by some GB of zeros, in a few MB."""
    packer = zlib.compressobj(9, wbits=-15)
    start = packer.compress(inner) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(_BLOCK)) + packer.flush(zlib.Z_FULL_FLUSH)
    data = start + block * blocks + packer.flush()
    size, encoded = len(inner) + _BLOCK * blocks, name.encode()
    local = (
        struct.pack("<4s5H3I2H", b"PK\3\4", 20, 0, 8, 0, 33, 0, len(data), size & 0xFFFFFFFF, len(encoded), 0) + encoded
    )
    place = len(local) + len(data)
    sizes = (0, len(data), size & 0xFFFFFFFF, len(encoded))
    entry = struct.pack("<4s6H3I5H2I", b"PK\1\2", 20, 20, 0, 8, 0, 33, *sizes, 0, 0, 0, 0, 0, 0) + encoded
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 1, 1, len(entry), place, 0)
    if len(others) < 2 or size > 0xFFFFFFFF:
        return local + data + entry + end
    rest = _zipped(
        [each for each in others if each[0] != name], zipfile.ZIP_STORED
    )  # its directory with one entry more
    body, directory = rest[: rest.find(b"PK\1\2")], rest[rest.find(b"PK\1\2") : rest.rfind(b"PK\5\6")]
    entry = entry[:42] + struct.pack("<I", len(body)) + entry[46:]
    count = directory.count(b"PK\1\2") + 1
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, count, count, len(directory) + len(entry), len(body) + place, 0)
    return body + local + data + directory + entry + end


def mutate_tar(random: Random, content: bytes, canary: Path) -> bytes:
    """Return an archive with a member that leads outside, is no file, or says another size."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w:gz" if content[:2] == b"\x1f\x8b" else "w") as tar:
        for name in (
            "set/a",
            random.choice(("../x", str(canary), "a/../../x", "set/b", "C:/x", "", "x" * 300, "set/a/b")),
        ):
            member = tarfile.TarInfo(name)
            member.type = random.choice(_KINDS)
            member.linkname = random.choice(("../../etc/passwd", "/etc/passwd", "set/a", name, "", "set"))
            member.mode, member.size = 0o777, random.choice((0, 5, 5))
            tar.addfile(member, io.BytesIO(b"12345"))
    changed = file.getvalue()
    if random.random() < 0.3:
        changed = changed[: random.randrange(len(changed))]
    return changed

"""Mutations of arrays, archives, pictures and weights that keep the file whole but lie in its headers."""

from __future__ import annotations

import io
import json
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
_MOST = 1 << 26
"""Bytes in an archive, unpacked, that may be changed once more."""


def npy_header(descr: str, shape: str, order: str = "False", extra: str = "", version: int = 1) -> bytes:
    """Return the header of an ``.npy`` file that says anything."""
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, {extra}}}\n".encode()
    kind, largest = ("<H", 0xFFFF) if version == 1 else ("<I", 0xFFFFFFFF)
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack(kind, min(len(text), largest)) + text


def mutate_npy(random: Random, content: bytes, canary: Path) -> bytes:
    """Return an ``.npy`` file with another header, a pickle, or other values."""
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception:  # it is damaged already
        return content[: len(content) // 2]
    pick = random.random()
    if pick < 0.1:
        return npy_header("'|O'", "(1,)") + values.pickled(random, canary)
    if pick < 0.6:
        return _with_header(random, array, canary)
    others = (
        _cast(random, array), array[..., None], array.ravel()[:0], array.ravel(), np.repeat(array[None], 3, 0),
        array.ravel()[:-1], _other_values(random, array), _other_values(random, array),
    )  # fmt: skip
    file = io.BytesIO()
    np.save(file, random.choice(others), allow_pickle=False)
    return file.getvalue()


def _cast(random: Random, array: np.ndarray) -> np.ndarray:
    """Return an array with values of another type."""
    kind = random.choice(("<f8", "<f2", "<c8", "|b1", "<U3", "<i8", "|u1", ">f4", "<i2"))
    with np.errstate(invalid="ignore", over="ignore"):
        return array.astype(kind) if array.dtype.kind in "biuf" else np.zeros(array.shape, kind)


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


def _other_values(random: Random, array: np.ndarray) -> np.ndarray:
    """Return an array with values that are out of range."""
    if array.dtype.kind != "f":
        return np.zeros_like(array) if random.random() < 0.5 else np.flip(array)
    value = random.choice((np.nan, np.inf, -np.inf, 0, -1, 1e19, 1e-30, 1e30, -1e30))
    result = np.array(array)
    where = random.random()
    with np.errstate(over="ignore"):  # half floats
        result[np.random.default_rng(random.randrange(2**32)).uniform(size=array.shape) < where] = value
    return result


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


def mutate_png(random: Random, content: bytes) -> bytes:
    """Return a PNG with another header or another order of chunks, whose checksums are right."""
    chunks, at = [], 8
    while at + 12 <= len(content):
        (size,) = struct.unpack_from(">I", content, at)
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + size]))
        at += 12 + size
    if not chunks or chunks[0][0] != b"IHDR" or len(chunks[0][1]) != 13:
        return content[: len(content) // 2]
    kind = random.randrange(6)
    if kind <= 2:
        fields = list(struct.unpack(">IIBBBBB", chunks[0][1]))
        place = random.randrange(7)
        fields[place] = random.choice(
            (0, 1, 7, 30000, 60000, 2**31 - 1, 2**32 - 1) if place < 2 else (0, 1, 2, 3, 4, 6, 8, 16, 255)
        )
        chunks[0] = (b"IHDR", struct.pack(">IIBBBBB", *fields))
    elif kind == 3:
        del chunks[random.randrange(len(chunks))]
    elif kind == 4:
        text = zlib.compress(bytes(1 << 26), 9)
        new = random.choice((
            (b"zTXt", b"k\0\0" + text), (b"iCCP", b"k\0\0" + text), (b"tRNS", b"\0" * 9), (b"PLTE", b"\0" * 9),
            (b"gAMA", b"\0" * 4), (b"eXIf", b"II*\0" + b"\xff" * 60), (b"acTL", b"\0\0\xff\xff" * 2),
        ))  # fmt: skip
        chunks.insert(random.randrange(len(chunks) + 1), new)
    else:
        first, second = random.randrange(len(chunks)), random.randrange(len(chunks))
        chunks[first], chunks[second] = chunks[second], chunks[first]
    return content[:8] + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )


def mutate_safetensors(random: Random, content: bytes, mutate: Callable[[bytes], bytes]) -> bytes:
    """Return safetensors with another header, whose length is right or not."""
    (size,) = struct.unpack_from("<Q", content)
    header, body = content[8 : 8 + size], content[8 + size :]
    if random.random() < 0.5:
        header = mutate(header)
    else:
        entries = json.loads(header)
        name = random.choice([key for key in entries if key != "__metadata__"] or ["x"])
        change = random.choice((
            {"dtype": "F64"}, {"dtype": "X"}, {"shape": [10**9, 10**9]}, {"shape": [-1]}, {"data_offsets": [0, 2**60]},
            {"data_offsets": [5, 1]}, {"shape": []}, {"dtype": "BOOL"}, {"data_offsets": [0, 0]},
        ))  # fmt: skip
        entries[name] = {**entries.get(name, {}), **change}
        header = json.dumps(entries).encode()
    length = len(header) if random.random() < 0.8 else random.choice((0, 2**63 - 1, 2**64 - 1, len(header) + 9, 10**8))
    return struct.pack("<Q", length) + header + body

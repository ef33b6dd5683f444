"""Values that a file may hold where it should hold another: of wrong types, out of range, huge, deep, malicious."""

import os
import pickle
from pathlib import Path
from random import Random
from typing import Any

from fuzz.place import MARK

DEEP = 10_000  # Levels of nested lists
_PLAIN: tuple[Any, ...] = (
    None, True, False, "", -1, 0, 1, 2, 0.5, -0.0, 1e-320, 1e19, 1e308, -1e308, 2**31, 2**63, -(2**63), 2**64, 10**30,
    [], {}, [[]], {"": {}}, [1, 2, 3], [1e6] * 100, {"a": 1}, "nan", "None", "0", "1/0", "abc", " ", "\n", "\0",
    "\x1b[31m", "é\u202e\ufeff", "../../etc/passwd", "/etc/passwd", "/dev/zero", "~", "a/b", ".", "..", "C:\\x",
    "a" * 300, "${oc.env:HOME}", "${now:%Y}", "%s%n{0}", "=1+1", "<script>alert(1)</script>",
    "\\input{/etc/passwd}", "x" * 10_000,
)  # fmt: skip
RAW = (
    "1e400", "-1e400", "NaN", "Infinity", "-Infinity", "9" * 400, "-" + "9" * 400, "0." + "9" * 400, "1e-400",
    "1e999999", "9" * 5000, "[" * DEEP + "]" * DEEP, '{"a":' * DEEP + "1" + "}" * DEEP, "0x10", "01", "+1", "1_000",
    "'", "\\u0000", '"\\ud800"', "tru", "",
)  # fmt: skip
"""Texts in place of a value in JSON or another text."""
NUMBERS = (
    "nan", "inf", "-inf", "1e400", "-1e400", "1e308", "1e-320", "0", "-0", "-1", "1", "9" * 400, "9" * 5000, "abc", "",
    "1e19", "4294967296", "18446744073709551616", "0x1p3", "1_0", "1,5", "٣", "--1", "1e", "3.", ".", "x" * 10_000,
    "2147483647", "1e7",
)  # fmt: skip
OUTSIDE = ("../" * 9 + "etc/passwd", "../../etc/passwd", "..\\..\\etc\\passwd", "C:\\etc\\passwd")
"""Names of files outside of the folder of a case."""
TARGETS = (
    "os.system", "os.mkdir", "subprocess.run", "subprocess.Popen", "builtins.exec", "builtins.eval", "shutil.rmtree",
    "pathlib.Path", f"{MARK}.run", f"{MARK}", "dsr.cli.main", "dsr.methods", "dsr.nowhere.X", "..", "a b.c", ".x", "x.",
    "json.loads", "dsr.utils.files.write_text", "dsr.utils.configuration.load_object", "builtins.print", "torch.load",
)  # fmt: skip


def plain(random: Random, canary: Path) -> Any:
    """Return a value that JSON and YAML can hold."""
    pick = random.random()
    if pick < 0.1:
        return random.choice(TARGETS)
    if pick < 0.15:
        return str(canary)
    if pick < 0.2:
        return {"_target_": random.choice(TARGETS), "name": "x", "command": f"mkdir {canary}", "path": str(canary)}
    return random.choice(_PLAIN)


class _Payload:
    """An object whose pickle makes a folder when it is read."""

    def __init__(self, what: int, canary: Path) -> None:
        self._what, self._canary = what, str(canary)

    def __reduce__(self) -> tuple[Any, ...]:
        code = f"import os\nos.makedirs({self._canary!r}, exist_ok=True)\n{MARK} = 1"
        return (
            (os.mkdir, (self._canary,)),
            (os.system, (f"mkdir -p '{self._canary}'",)),
            (exec, (code,)),
            (eval, (f"__import__('os').makedirs({self._canary!r})",)),
        )[self._what]


def pickled(random: Random, canary: Path, inside: bool = False) -> bytes:
    """Return a pickle that makes the canary, perhaps hidden among plain values."""
    payload: Any = _Payload(random.randrange(4), canary)
    content = {"model_state_dict": payload, "state_dict": {"a": payload}} if inside else payload
    return pickle.dumps(content, protocol=random.choice((0, 2, 4, 5)))

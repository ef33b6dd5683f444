"""Which modules the package has, and which of them import which."""

import ast
import functools
import sys
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1] / "src"

LAYERS = (
    ("dsr.notes", "dsr.utils"), ("dsr.geometry",), ("dsr.sample",),
    ("dsr.degradation", "dsr.metrics", "dsr.synthetic", "dsr.io"),
    ("dsr.data", "dsr.methods", "dsr.pictures"), ("dsr.training", "dsr.evaluation", "dsr.inference", "dsr.doctor"),
    ("dsr.report",), ("dsr.app",), ("dsr.cli", "dsr.__main__"),
)  # fmt: skip
"""From the lowest up. A package stands for all its modules; those in one line do not import each other."""


def name_of(path):
    return ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__")


MODULES = {name_of(path): path for path in sorted((SOURCE / "dsr").rglob("*.py"))}


def within(name, package):
    return name == package or name.startswith(f"{package}.")


def imports_of(text, module, *, package=False, known=()):
    """Return the dotted names that a module's text imports, wherever in it: modules rather than what is in them."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                home = module.split(".")
                home = home[: len(home) - node.level + package]
                base = ".".join([*home, base] if base else home)
            deeper = {f"{base}.{alias.name}" for alias in node.names}
            modules = {name for name in deeper if name in known}
            found |= modules
            if modules != deeper:
                found.add(base)
    return found


@functools.cache
def import_graph():
    """Return what each module imports."""
    return {
        name: imports_of(path.read_text(encoding="utf-8"), name, package=path.name == "__init__.py", known=MODULES)
        for name, path in MODULES.items()
    }


def drawing():
    """Return the rooms on their floors, each with what it is and the rooms that it imports from, as text."""
    lines = []
    for floor, layer in reversed([*enumerate(LAYERS, 1)]):
        for number, room in enumerate(sorted(each for each in layer if each != "dsr.__main__")):
            about = ast.get_docstring(ast.parse(MODULES[room].read_text(encoding="utf-8"))).partition("\n")[0]
            below = {
                package.rpartition(".")[2]
                for name, imported in import_graph().items() if within(name, room)
                for other in imported
                for below in LAYERS for package in below if package != room and within(other, package)
            }  # fmt: skip
            where = f"{floor}" if number == 0 else " "
            lines.append(f"{where}  {room.removeprefix('dsr.'):<12} {about.rstrip('.')}")
            lines += [f"{'':<18}<- {', '.join(sorted(below))}"] if below else []
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(drawing())  # for docs/architecture.md

"""Which modules the package has, and which of them import which."""

import ast
import functools
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1] / "src"


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

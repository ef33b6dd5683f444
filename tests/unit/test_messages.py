"""Library errors name the argument; only ``dsr.app`` and ``dsr.cli`` know the keys of the configuration."""

import ast
from pathlib import Path

from module_graph import MODULES, within

CONF = Path(__file__).resolve().parents[2] / "conf"
GROUPS = (*(f"{folder.name}." for folder in CONF.iterdir() if folder.is_dir()), "loss.")


def beginning_of(node):
    """Return the literal text that an expression of a message begins with; empty where it begins with a value."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return beginning_of(node.values[0]) if node.values else ""
    return beginning_of(node.left) if isinstance(node, ast.BinOp) else ""


def messages_with_keys(text):
    """Return the texts of raised exceptions, in a module's source, that begin with a key of the configuration."""
    raised = [node.exc for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Raise)]
    beginnings = [beginning_of(call.args[0]) for call in raised if isinstance(call, ast.Call) and call.args]
    return [text for text in beginnings if text.startswith(GROUPS)]


def test_library_errors_name_arguments_rather_than_configuration_keys():
    library = {
        name: path for name, path in MODULES.items() if not any(within(name, f"dsr.{p}") for p in ("app", "cli"))
    }
    found = {name: messages_with_keys(path.read_text(encoding="utf-8")) for name, path in library.items()}
    assert len(library) > 50
    assert {name: messages for name, messages in found.items() if messages} == {}

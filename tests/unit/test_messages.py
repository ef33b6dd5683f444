"""Library errors name the argument; only ``dsr.app`` and ``dsr.cli`` know the keys of the configuration."""

import ast
from pathlib import Path

import pytest
from module_graph import MODULES, within

CONF = Path(__file__).resolve().parents[2] / "conf"
GROUPS = (*(f"{folder.name}." for folder in CONF.iterdir() if folder.is_dir()), "loss.")


def messages_with_keys(text):
    """Return the texts of raised exceptions, in a module's source, that begin with a key of the configuration."""
    raised = [node.exc for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Raise)]
    calls = [call for call in raised if isinstance(call, ast.Call) and call.args]
    literals = (next((n for n in ast.walk(call.args[0]) if isinstance(n, ast.Constant)), None) for call in calls)
    return [n.value for n in literals if n is not None and isinstance(n.value, str) and n.value.startswith(GROUPS)]


def test_library_errors_name_arguments_rather_than_configuration_keys():
    library = {
        name: path for name, path in MODULES.items() if not any(within(name, f"dsr.{p}") for p in ("app", "cli"))
    }
    found = {name: messages_with_keys(path.read_text(encoding="utf-8")) for name, path in library.items()}
    assert len(library) > 50
    assert {name: messages for name, messages in found.items() if messages} == {}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('raise ValueError(f"method.{name}: expected")', ["method."]),
        ('raise ValueError("noise.std: " + "expected")', ["noise.std: "]),
        ('raise ValueError(f"{name}: expected method.sharpness")', []),
    ],
)
def test_a_message_that_begins_with_a_key_is_found(text, expected):
    assert messages_with_keys(text) == expected

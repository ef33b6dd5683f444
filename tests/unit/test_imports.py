"""Imports run downward only; see docs/architecture.md."""

from module_graph import LAYERS, MODULES, SOURCE, drawing, import_graph, within

ARCHITECTURE = SOURCE.parent / "docs" / "architecture.md"
MORE_FORBIDDEN = {
    "dsr.data": ("dsr.metrics",),
    "dsr.methods.classical": ("dsr.metrics",),
    "dsr.methods.networks": ("dsr.metrics",),
    "dsr.report": (
        "dsr.data",
        "dsr.methods",
        "dsr.evaluation.scenes",
        "dsr.training",
        "dsr.inference",
        "dsr.degradation",
    ),
}  # Beyond the layers: data sets and methods know no metric, and a report reads files alone
ONLY_APP = ("hydra", "omegaconf")  # Libraries for the configuration of commands
MAY_TOO = {"omegaconf": "dsr.methods.recipe"}  # A method's file is read there without Hydra


def place_of(name):
    """Return the rank and the group of a module, None where it has none."""
    for rank, layer in enumerate(LAYERS):
        for group in layer:
            if within(name, group):
                return rank, group
    return None


def offences(name, imported):
    """Return what is wrong with a module's imports, one line each."""
    rank, group = place_of(name)
    wrong = []
    for other in sorted(imported):
        place = place_of(other)
        forbidden = any(
            within(name, mine) and any(within(other, bad) for bad in bads) for mine, bads in MORE_FORBIDDEN.items()
        )
        if place is not None and (forbidden or place[0] > rank or (place[0] == rank and place[1] != group)):
            wrong.append(f"{name} imports {other}")
        if group != "dsr.app" and any(within(other, library) and name != MAY_TOO.get(library) for library in ONLY_APP):
            wrong.append(f"{name} imports {other}, which only dsr.app may")
    return wrong


def has_no_place(name):
    """Return whether a module needs a layer and has none.

    An ``__init__`` that imports nothing needs none, nor does that of the whole, which imports what is asked of it.
    """
    return (
        name != "dsr"
        and place_of(name) is None
        and not (MODULES[name].name == "__init__.py" and not import_graph()[name])
    )


def test_modules_all_have_a_layer():
    homeless = [name for name in MODULES if has_no_place(name)]
    assert not homeless, f"assign {', '.join(homeless)} to a layer in LAYERS of module_graph.py"


def test_modules_import_from_layers_below_and_their_own_group_alone():
    assert [
        line for name in MODULES if place_of(name) is not None for line in offences(name, import_graph()[name])
    ] == []


def test_modules_do_not_import_each_other_in_a_circle():
    done, path = set(), []

    def visit(name):
        assert name not in path, f"circle: {' -> '.join([*path[path.index(name) :], name])}"
        if name in done:
            return
        path.append(name)
        for other in sorted(import_graph()[name] & MODULES.keys()):
            if other != name:
                visit(other)
        path.pop()
        done.add(name)

    for name in MODULES:
        visit(name)


def test_documentation_shows_the_rooms_as_they_are():
    assert f"```text\n{drawing()}```\n" in ARCHITECTURE.read_text(encoding="utf-8"), "run tests/module_graph.py"

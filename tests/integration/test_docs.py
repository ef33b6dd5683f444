"""The README, the documentation's pages and CITATION.cff: sizes, links, and commands that parse."""

import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from hydra import compose, initialize_config_dir

from dsr.app.schema import EvalConfig, TrainConfig, plain_config, register

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = (
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "src/dsr/methods/weights/README.md",
    *sorted(DOCS.rglob("*.md")),
)
EXTENDING = DOCS / "extend.md"  # Its commands use the modules that it contains; test_extensions runs them


@pytest.fixture(scope="module")
def hook() -> ModuleType:
    """The module that writes the generated pages; it is no part of the package."""
    specification = importlib.util.spec_from_file_location("reference", DOCS / "hooks" / "reference.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def generated(hook: ModuleType) -> dict[str, str]:
    return hook.generated_pages()


def parametrize(name: str) -> Any:
    """Parametrize by the arguments of the distinct lines of the pages' shell blocks that begin with ``name``."""
    found, start = {}, name.split()
    for page in PAGES:
        for block in re.findall(r"^```sh\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True)
                if page != EXTENDING and words[: len(start)] == start:
                    found.setdefault(" ".join(words), words[len(start) :])
    return pytest.mark.parametrize("arguments", found.values(), ids=found)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_relative_links_of_a_page_lead_somewhere(page: Path, generated: dict[str, str]) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    targets = [link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text)]
    local = {target for target in targets if target and "://" not in target}
    missing = {path for target in local if not (path := (page.parent / target).resolve()).exists()}
    assert missing <= ({DOCS / name for name in generated} if page.is_relative_to(DOCS) else set())


@parametrize("dsr")
def test_dsr_command_of_the_documentation_parses(arguments: list[str], hook: ModuleType) -> None:
    if arguments[-1] in ("-h", "--help"):
        with pytest.raises(SystemExit, match="0"):
            hook.command_parser().parse_args(arguments)
    else:
        assert callable(hook.command_parser().parse_args(arguments).run)


def compose_each(name: str, arguments: list[str]) -> Iterator[dict[str, Any]]:
    """Yield the configurations that a command line leads to, one for each combination of a multirun."""
    overrides = [argument for argument in arguments if argument not in ("-m", "--help")]
    register()
    several = "-m" in arguments
    choices = [argument.partition("=")[2].split(",") if several else [""] for argument in overrides]
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        for which in range(max(map(len, choices), default=1)):
            chosen = [
                f"{override.partition('=')[0]}={values[which % len(values)]}" if several else override
                for override, values in zip(overrides, choices, strict=True)
            ]
            yield plain_config(compose(name, [override for override in chosen if "=..." not in override]))


@parametrize("python eval.py")
def test_evaluation_of_the_documentation_composes(arguments: list[str]) -> None:
    for config in compose_each("eval", arguments):
        settings = EvalConfig.of(config)
        assert settings.measured or settings.scale in (4, 8)


@parametrize("python train.py")
def test_training_of_the_documentation_composes(arguments: list[str]) -> None:
    for config in compose_each("train", arguments):
        assert TrainConfig.of(config).scale in (4, 8)


def test_citation_names_the_version_of_the_package() -> None:
    import dsr  # noqa: PLC0415

    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == dsr.__version__
    assert f"version = {{{dsr.__version__}}}" in (DOCS / "methods.md").read_text()

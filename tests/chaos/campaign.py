"""The folder of a campaign: undisturbed results to compare with, and the cases that are not clean."""

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from chaos.processes import Command, Ended
from chaos.scenarios import ALL, REPOSITORY, Scenario
from chaos.trees import differences

_LIMIT = 300.0  # Seconds that an undisturbed command may take


@dataclass(frozen=True)
class Undisturbed:
    """The results of a scenario without disturbance.

    Args:
        folder: its files.
        computed: seconds of computing of each command.

    """

    folder: Path
    computed: tuple[float, ...]


@dataclass
class Campaign:
    """Runs scenarios in one folder, so that the paths in their results are the same.

    Args:
        root: folder of the campaign; it is created.
        grace: seconds within which a struck command has to end.

    """

    root: Path
    grace: float = 5.0
    _known: dict[str, Undisturbed] = field(default_factory=dict)

    @property
    def work(self) -> Path:
        """The folder in which all commands run."""
        return self.root / "work"

    @property
    def environment(self) -> Mapping[str, str]:
        """The environment of all commands: one thread, a cache of their own, and nobody's settings."""
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("DSR_", "HYDRA_", "PL_"))}
        path = os.pathsep.join(filter(None, (str(REPOSITORY / "src"), kept.get("PYTHONPATH"))))
        return {**kept, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "DSR_CACHE": "cache", "GIT_OPTIONAL_LOCKS": "0"}

    def begin(self, scenario: Scenario) -> None:
        """Empty the folder of work, and put there what the scenario starts from."""
        self.work.mkdir(parents=True, exist_ok=True)
        for path in (*self.work.iterdir(), *self.root.glob("log-*")):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        for name, origin in scenario.needs.items():
            path = self.work / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if callable(origin):
                origin(path)
            else:
                shutil.copytree(self.root / "undisturbed" / origin[0] / origin[1], path)

    def start(self, scenario: Scenario, number: int = 0) -> Command:
        """Start a command of a scenario."""
        logs = self.root / f"log-{len(list(self.root.glob('log-*'))) + 1}"
        return Command(scenario.arguments(number), self.work, self.environment, logs)

    def finish(self, scenario: Scenario) -> tuple[list[str], list[Ended]]:
        """Run all commands of a scenario one after the other; return what is wrong, and how they ended."""
        problems, ends = [], []
        for number in range(len(scenario.commands)):
            ends.append(self.start(scenario, number).end(_LIMIT))
            problems += undisturbed_problems(scenario, ends[-1])
        return problems, ends

    def undisturbed(self, scenario: Scenario) -> Undisturbed:
        """Return the results of a scenario without disturbance, made at the first call.

        Raises:
            RuntimeError: the undisturbed command fails.

        """
        if scenario.name not in self._known:
            for origin in scenario.needs.values():
                if not callable(origin):
                    self.undisturbed(ALL[origin[0]])
            self.begin(scenario)
            problems, ends = self.finish(scenario)
            if problems:
                raise RuntimeError(f"{scenario.name}: undisturbed: {'; '.join(problems)}")
            folder = self.root / "undisturbed" / scenario.name
            shutil.copytree(self.work, folder)
            computed = tuple(end.computed for end in ends)
            self._known[scenario.name] = Undisturbed(folder, computed)
        return self._known[scenario.name]

    def compare(self, scenario: Scenario) -> list[str]:
        """Return what differs from the undisturbed results, one line each."""
        return differences(self.undisturbed(scenario).folder, self.work)

    def keep(self, case: str, problems: list[str]) -> Path:
        """Keep the files and the output of a case that is not clean, and return their folder."""
        folder = self.root / "unclean" / case
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.work, folder / "work", symlinks=True)
        for log in self.root.glob("log-*"):
            shutil.copytree(log, folder / log.name)
        (folder / "problems.txt").write_text("\n".join(problems) + "\n")
        return folder


def undisturbed_problems(scenario: Scenario, end: Ended) -> list[str]:
    """Return what is wrong with the end of a command that nothing disturbed."""
    if end.code == 2 and scenario.complete and scenario.complete in end.err and len(end.err.splitlines()) == 1:
        return []
    problems = [] if end.code == 0 else [f"exit code {end.code} undisturbed"]
    problems += [f"undisturbed, on stderr: {line}" for line in end.err.splitlines()[-3:]]
    return problems + ([f"undisturbed, left {len(end.left)} processes"] if end.left else [])

"""The experiments: which problem, from which share of a scan, by which optimiser; a finished one is not run again."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gnrecon.cli.learn_inputs import DesignFiles, ScanFiles, is_scan
from gnrecon.cli.learn_problem import LearnOptions, run_learn
from gnrecon.runtime.errors import ExitCode
from gnrecon.shape_learning import OPTIMISERS

PROBLEMS: dict[str, tuple[str, float | None]] = {
    "catenoid": ("catenoid", None),
    "enneper": ("enneper", None),
    "cone": ("cone", None),
    "bunny": ("bunny", None),
    "bunny-sparse": ("bunny", 0.2),
    "rockerarm": ("rockerarm", None),
}
"""What is learned, and from which share of a scan's points."""


@dataclass(frozen=True)
class Experiment:
    """One run of a problem of `PROBLEMS` by an optimiser, and where it is kept."""

    problem: str
    optimiser: str
    folder: Path

    @property
    def mesh(self) -> Path:
        """The learned surface, with its curvature."""
        return self.folder / f"{self.problem}-{self.optimiser}.ply"

    @property
    def report(self) -> Path:
        """The report of the run."""
        return self.mesh.with_suffix(".json")

    @property
    def finished(self) -> bool:
        """Whether mesh and report are there; both are written at the end, or neither."""
        return self.mesh.is_file() and self.report.is_file()

    def figures(self) -> dict[str, Any]:
        """Return the report of a finished run."""
        figures: dict[str, Any] = json.loads(self.report.read_text(encoding="utf-8"))
        return figures

    def run(self, options: LearnOptions, data: Path | None) -> int:
        """Run it, and return the exit code.

        Raises
        ------
        GnreconError
            When it cannot be run, such as where the folder of data is missing.
        """
        name, share = PROBLEMS[self.problem]
        scan = ScanFiles(data if is_scan(name) else None, share)
        return run_learn(name, self.mesh, options, files=DesignFiles(), scan=scan, report=self.report, overwrite=True)


def experiments(problems: list[str], folder: Path) -> list[Experiment]:
    """Return the experiments of some problems, by all optimisers."""
    return [Experiment(problem, optimiser, folder) for problem in problems for optimiser in OPTIMISERS]


def interrupted(code: int) -> bool:
    """Return whether an exit code says that a run was interrupted; what it wrote is not the whole of it."""
    return code == ExitCode.INTERRUPTED

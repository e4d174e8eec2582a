"""The experiments, each a problem, a share of a scan and an optimiser; and their figures as a table."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
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
"""Problems of gnrecon by the experiments' names, and the share of a scan's points."""


@dataclass(frozen=True)
class Experiment:
    """One run of a problem of `PROBLEMS` by an optimiser, and the folder of its results."""

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
        """Whether mesh and report exist; both are written at the end, or neither."""
        return self.mesh.is_file() and self.report.is_file()

    def figures(self) -> dict[str, Any]:
        """Return the report of a finished run."""
        figures: dict[str, Any] = json.loads(self.report.read_text(encoding="utf-8"))
        return figures

    def run(self, options: LearnOptions, data: Path | None) -> int:
        """Run the experiment, and return the exit code.

        Raises
        ------
        GnreconError
            When it cannot be run, for example because data is missing.
        """
        name, share = PROBLEMS[self.problem]
        scan = ScanFiles(data if is_scan(name) else None, share)
        return run_learn(name, self.mesh, options, files=DesignFiles(), scan=scan, report=self.report, overwrite=True)


def experiments(problems: list[str], folder: Path) -> list[Experiment]:
    """Return the experiments of some problems, by all optimisers."""
    return [Experiment(problem, optimiser, folder) for problem in problems for optimiser in OPTIMISERS]


def interrupted(code: int) -> bool:
    """Return whether an exit code means that a run was interrupted; its results are then incomplete."""
    return code == ExitCode.INTERRUPTED


AUTHORS: dict[str, tuple[str, dict[str, float | None]]] = {
    "bunny": ("loss", {"gn": 7.1e-5, "lbfgs": 2.4e-4, "adam": 1.4e-3}),
    "bunny-sparse": ("loss", {"gn": 5.8e-5, "lbfgs": 1.9e-4, "adam": 1.0e-3}),
    "rockerarm": ("loss", {"gn": 1.9e-5, "lbfgs": 1.9e-4, "adam": 7.3e-4}),
    "catenoid": ("chamfer", {"gn": 1.6e-6, "lbfgs": 5.9e-5, "adam": 1.8e-4}),
    "enneper": ("chamfer", {"gn": 7.8e-7, "lbfgs": None, "adam": 1.8e-4}),
    "cone": ("loss", {"gn": 5.0e-11, "lbfgs": None, "adam": 2.6e-6}),
}
"""The authors' figures, of 600 s for the scans and of 1,200 s for the rest; None where their run was unstable."""


def row(one: Experiment) -> dict[str, Any]:
    """Return the numbers of a finished experiment by the names of the columns."""
    figures = one.figures()
    quantity, theirs = AUTHORS[one.problem]
    known = {name: figures[name] for name in ("seconds", "steps", "loss", "chamfer")}
    return {
        "problem": one.problem,
        "optimiser": one.optimiser,
        **known,
        "authors_quantity": quantity,
        "authors": theirs[one.optimiser],
    }


def as_csv(done: Sequence[Experiment]) -> str:
    """Return the rows of one or more experiments as the text of a CSV file."""
    rows, text = [row(one) for one in done], io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def as_markdown(done: Sequence[Experiment]) -> str:
    """Return the rows of one or more experiments as a Markdown table."""
    rows = [row(one) for one in done]
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
    lines += ["| " + " | ".join(map(_cell, values.values())) + " |" for values in rows]
    return "\n".join(lines) + "\n"


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.2g}" if isinstance(value, float) else str(value)

"""Shape learning: Gauss-Newton, L-BFGS and Adam at equal time on the paper's data-free problems, and one step's time.

The optimisers have the same points, terms, weights and start; they differ in their steps alone. Chamfer divergence and
loss are measured at points that no step has seen.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.learn.step import step_figures
from benchmarks.provenance import provenance
from gnrecon.report.report import plain
from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.files import write_text
from gnrecon.shape_learning import OPTIMISERS, PROBLEMS, learn

RATES = {"cone": 1e-4}
"""Adam's learning rate where the paper's is not 1e-3."""


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark as the arguments say; return the exit code.

    Raises
    ------
    UsageError
        When the budget is not positive.
    OutputError
        When the result cannot be written.
    """
    parser = argparse.ArgumentParser(prog="bench learn", description=__doc__)
    parser.add_argument("--problems", nargs="+", choices=list(PROBLEMS), default=list(PROBLEMS))
    parser.add_argument("--optimisers", nargs="*", choices=list(OPTIMISERS), default=list(OPTIMISERS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], metavar="SEED")
    parser.add_argument("--budget", type=float, default=600.0, metavar="SECONDS", help="of each run; by default 600")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers; an older file is replaced")
    chosen = parser.parse_args(arguments)
    console = Console(highlight=False)
    step = step_figures(chosen.seeds[0])
    for which in ("first", "later"):
        console.print(step_line(which, step[which]))
    figures = []
    for name in chosen.problems:
        for optimiser in chosen.optimisers:
            figures += [run(name, optimiser, chosen.budget, seed) for seed in chosen.seeds]
    console.print(table(figures))
    if chosen.json:
        report = provenance("learn", arguments) | {"step": step, "figures": figures}
        write_text(chosen.json, json.dumps(report, indent=2) + "\n", overwrite=True)
    return ExitCode.OK


def run(name: str, optimiser: str, budget: float, seed: int) -> dict[str, Any]:
    """Return the figures of one run."""
    learned = learn(PROBLEMS[name](), optimiser, budget=budget, seed=seed, learning_rate=RATES.get(name, 1e-3))
    values: dict[str, Any] = plain(
        {
            "problem": name,
            "optimiser": optimiser,
            "seed": seed,
            "budget": budget,
            "steps": len(learned.solution.history),
            "seconds": learned.seconds,
            "loss": learned.best.loss,
            "chamfer": learned.best.chamfer,
            "status": learned.solution.status,
            "history": [found.as_dict() for found in learned.history],
        }
    )
    return values


def step_line(which: str, step: dict[str, Any]) -> str:
    """Return what one step takes, in a sentence."""
    return (
        f"{which.capitalize()} Gauss-Newton step of {step['rows']} rows and {step['parameters']} parameters: "
        f"{step['seconds']:.3f} s, {step['error']:.1e} from the exact step in the damped matrix's norm "
        f"({step['moving_seconds']:.3f} s with moving points, {step['factored_seconds']:.3f} s by J^T J); "
        f"{step['nested_seconds']:.3f} s by nested automatic differentiation, {step['speedup']:.1f} times as long, and "
        f"{step['papers_seconds']:.3f} s with the paper's solve, {step['papers_speedup']:.1f} times."
    )


def table(figures: list[dict[str, Any]]) -> Table:
    """Return a row for each run."""
    made = Table()
    for heading in ("problem", "optimiser", "seed", "steps", "seconds", "loss", "Chamfer"):
        made.add_column(heading)
    for one in figures:
        numbers = ("-" if one[name] is None else f"{one[name]:.1e}" for name in ("loss", "chamfer"))
        made.add_row(
            one["problem"], one["optimiser"], str(one["seed"]), str(one["steps"]), f"{one['seconds']:.0f}", *numbers
        )
    return made

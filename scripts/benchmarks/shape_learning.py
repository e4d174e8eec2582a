"""Shape learning: Gauss-Newton, L-BFGS and Adam at equal time on the paper's data-free problems, and one step's time.

The optimisers have the same points, terms, weights and start; only their steps differ. Chamfer divergence and loss are
measured at points that no step has used. The step is timed in closed form and by nested automatic differentiation: the
Jacobian's rows are then ``vmap(jacrev(residual))`` by the parameters, of residuals that take the network's derivatives
in space by ``grad`` and ``jacrev``, as in the paper's section on implementation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor
from torch.func import grad, jacrev, vmap

from benchmarks.harness import command_line
from benchmarks.harness.measurement import median_time
from benchmarks.harness.tables import number_or_dash
from gnrecon.least_squares import Cholesky, DenseJacobian, LinearSolver, identity
from gnrecon.report.report import plain
from gnrecon.runtime.errors import ExitCode
from gnrecon.shape_learning import OPTIMISERS, PROBLEMS, ShapeProblem, catenoid, learn
from gnrecon.shape_learning.frozen_points import FrozenProblem, FrozenTerm


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark with arguments; return the exit code.

    Raises
    ------
    UsageError
        When the budget is not positive.
    OutputError
        When the result cannot be written.
    """
    parser = command_line.benchmark_parser("learn", __doc__)
    parser.add_argument("--problems", nargs="+", choices=list(PROBLEMS), default=list(PROBLEMS))
    parser.add_argument("--optimisers", nargs="*", choices=list(OPTIMISERS), default=list(OPTIMISERS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], metavar="SEED")
    parser.add_argument("--budget", type=float, default=600.0, metavar="SECONDS", help="of each run; by default 600")
    command_line.add_outputs(parser)
    chosen = parser.parse_args(arguments)
    command_line.require_folders(chosen.json)
    console = Console(highlight=False)
    step = step_figures(chosen.seeds[0])
    for which in ("first", "later"):
        console.print(step_line(which, step[which]))
    figures = []
    for name in chosen.problems:
        for optimiser in chosen.optimisers:
            figures += [run(name, optimiser, chosen.budget, seed) for seed in chosen.seeds]
    console.print(table(figures))
    command_line.write_report(
        chosen.json, command_line.provenance("learn", arguments) | {"step": step, "figures": figures}
    )
    return ExitCode.OK


def run(name: str, optimiser: str, budget: float, seed: int) -> dict[str, Any]:
    """Return the figures of one run."""
    rate = 1e-4 if name == "cone" else 1e-3  # of Adam, as in the paper
    learned = learn(PROBLEMS[name](), optimiser, budget=budget, seed=seed, learning_rate=rate)
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
    """Return the times of one step, in a sentence."""
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
        numbers = (number_or_dash(one[name], "{:.1e}") for name in ("loss", "chamfer"))
        made.add_row(
            one["problem"], one["optimiser"], str(one["seed"]), str(one["steps"]), f"{one['seconds']:.0f}", *numbers
        )
    return made


def step_figures(
    seed: int, *, steps: int = 60, our_repetitions: int = 9, nested_repetitions: int = 3
) -> dict[str, Any]:
    """Return the figures of the first step of a run (`first`) and of a later one (`later`).

    Parameters
    ----------
    seed : of the run
    steps : before the later step; the surface has its shape then, and the eikonal term is gone
    our_repetitions, nested_repetitions : runs whose median counts
    """
    problem = catenoid()
    begun = learn(problem, budget=None, steps=1, seed=seed).solution
    run = learn(problem, budget=None, steps=steps, seed=seed).solution
    rng, repetitions = np.random.default_rng(seed), (our_repetitions, nested_repetitions)
    return {
        "first": figures_at(problem, begun.theta, 1, begun.history[-1].damping, rng, repetitions),
        "later": figures_at(problem, run.theta, steps + 1, run.history[-1].damping, rng, repetitions),
        "threads": torch.get_num_threads(),
    }


def figures_at(
    problem: ShapeProblem,
    theta: Tensor,
    step: int,
    damping: float,
    rng: np.random.Generator,
    repetitions: tuple[int, int],
) -> dict[str, Any]:
    """Return the seconds of a step by each method, and the error of gnrecon's.

    All have the same points, which do not move, the same residuals and the same damping in float64: gnrecon's step as
    in `gnrecon learn`, also with points that move with the surface, and with the Cholesky factor of J^T J; the nested
    one with that factor, and with the paper's solve. `repetitions` are gnrecon's and the nested ones.
    """
    our_runs, nested_runs = repetitions
    moving = problem.freeze(step, theta, rng)
    resting = replace(moving, terms=[replace(term, moves=False) for term in moving.terms])

    def ours(frozen: FrozenProblem, solver: LinearSolver) -> Callable[[], Tensor]:
        return lambda: closed_step(frozen, theta, damping, solver)

    seconds, found = median_time(ours(resting, problem.solver()), our_runs)
    with_motion, _ = median_time(ours(moving, problem.solver()), our_runs)
    factored, _ = median_time(ours(resting, Cholesky()), our_runs)
    nested, exact = median_time(lambda: nested_step(resting, theta, damping), nested_runs)
    papers, _ = median_time(lambda: papers_step(resting, theta, damping), nested_runs)
    return {
        "rows": sum(len(term.points) for term in resting.terms),
        "parameters": len(theta),
        "damping": damping,
        "seconds": seconds,
        "moving_seconds": with_motion,
        "factored_seconds": factored,
        "nested_seconds": nested,
        "papers_seconds": papers,
        "speedup": nested / seconds,
        "papers_speedup": papers / seconds,
        "error": energy_error(resting, theta, damping, found, exact),
    }


def closed_step(problem: FrozenProblem, theta: Tensor, damping: float, solver: LinearSolver) -> Tensor:
    """Return the step, of shape (p,)."""
    return solver.linearise(*problem.linearise(theta), identity).solve(damping).direction


def energy_error(problem: FrozenProblem, theta: Tensor, damping: float, found: Tensor, exact: Tensor) -> float:
    """Return a step's error in the norm of the damped matrix, as a share of the step's own."""
    jacobian, _ = problem.linearise(theta)

    def norm(step: Tensor) -> Tensor:
        return (jacobian.mv(step).square().sum() + damping * step.square().sum()).sqrt()

    return float(norm(found - exact) / norm(exact))


def nested_step(problem: FrozenProblem, theta: Tensor, damping: float) -> Tensor:
    """Return the step of the problem, of shape (p,), whose points do not move, for a damping in the identity metric.

    Raises
    ------
    KeyError
        When a term's name has no formula here.
    """
    system = Cholesky().linearise(*_linearised(problem, theta), identity)
    return system.solve(damping).direction


def papers_step(problem: FrozenProblem, theta: Tensor, damping: float) -> Tensor:
    """Return the same step, solved as the paper does: J^T J + eps I multiplied out, then least squares by QR.

    Raises
    ------
    KeyError
        When a term's name has no formula here.
    """
    jacobian, residual = _linearised(problem, theta)
    matrix = jacobian.matrix
    damped = matrix.T @ matrix + damping * torch.eye(matrix.shape[1], dtype=matrix.dtype)
    found: Tensor = torch.linalg.lstsq(damped, (matrix.T @ residual)[:, None], driver="gels").solution
    return -found[:, 0]


def _linearised(problem: FrozenProblem, theta: Tensor) -> tuple[DenseJacobian, Tensor]:
    """Return J and r."""
    parts = [_rows(problem, theta, term) for term in problem.terms]
    matrix, residual = (torch.cat(columns) for columns in zip(*parts, strict=True))
    return DenseJacobian(matrix), residual


def _rows(problem: FrozenProblem, theta: Tensor, term: FrozenTerm, *, chunk: int = 512) -> tuple[Tensor, Tensor]:
    """Return a term's part of J and r; of chunks of 64 to 2,000 points, 512 are the fastest."""

    def residual(theta: Tensor, point: Tensor) -> Tensor:
        return FORMULAS[term.name](lambda x: _value(problem, theta, x), point)

    scale = math.sqrt(term.weight / len(term.points))
    rows = vmap(jacrev(residual), in_dims=(None, 0), chunk_size=chunk)(theta, term.points)
    return scale * rows, scale * vmap(residual, in_dims=(None, 0), chunk_size=chunk)(theta, term.points)


def _value(problem: FrozenProblem, theta: Tensor, x: Tensor) -> Tensor:
    return problem.network.value(theta, x[None])[0]


def _divergence_of_normal(f: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    def normal(x: Tensor) -> Tensor:
        gradient: Tensor = grad(f)(x)
        unit: Tensor = gradient / gradient.norm()
        return unit

    divergence: Tensor = torch.trace(jacrev(normal)(x))
    return divergence


FORMULAS: dict[str, Callable[[Callable[[Tensor], Tensor], Tensor], Tensor]] = {
    "interface": lambda f, x: f(x),
    "eikonal": lambda f, x: torch.linalg.vector_norm(grad(f)(x)) - 1.0,
    "mean curvature": _divergence_of_normal,
}
"""Residuals of a field at one point, of shape (3,), by the terms' names."""

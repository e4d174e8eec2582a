"""The effect of the terms of the transport theorem that the paper neglects, along runs of its curvature problems.

Two tables. *Gradients*: at moments of a run, the gradient of the curvature's loss over the moving surface without both
neglected terms (the paper's), with its third term alone (the stretch), and with the convection alone (gnrecon's). Each
is compared with the gradient with both terms, which is that of the integral: the relative error and the cosine. *Runs*:
the loss reached in the same number of steps when surface points stay where they were drawn, as in the paper, and when
they move with the surface, convection included, as in gnrecon.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchmarks.harness import command_line
from benchmarks.harness.tables import number_or_dash
from gnrecon.least_squares import LayeredJacobian
from gnrecon.level_set import derivative_along, sample_surface, transported
from gnrecon.optim import Problem, StopRule
from gnrecon.residuals import Linearised, SecondOrder, mean_curvature
from gnrecon.runtime.errors import ExitCode, UsageError
from gnrecon.shape_learning import OPTIMISERS, PROBLEMS, SampledPoints, ShapeProblem, StepState, Term
from gnrecon.shape_learning.learn import pretrained
from gnrecon.shape_learning.result import measure

VARIANTS = {"neither": (0.0, 0.0), "stretch": (1.0, 0.0), "convection": (0.0, 1.0), "both": (1.0, 1.0)}
"""Factors of the curvature and of the derivative along the normal that are added to a residual's linearisation."""


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark with arguments; return the exit code.

    Raises
    ------
    UsageError
        When a problem is unknown, or moments are not numbers of steps.
    OutputError
        When the result cannot be written.
    """
    parser = command_line.benchmark_parser("transport", __doc__)
    parser.add_argument("--problem", action="append", metavar="NAME", help="by default catenoid and cone")
    parser.add_argument("--steps", default="0,5,20", help="moments of a run; the last is also the length of the runs")
    parser.add_argument("--seed", type=int, default=0)
    command_line.add_outputs(parser)
    chosen = parser.parse_args(arguments)
    command_line.require_folders(chosen.json)
    moments = _moments(chosen.steps)
    figures: list[dict[str, Any]] = []
    for name in chosen.problem or ("catenoid", "cone"):
        if name not in PROBLEMS:
            raise UsageError(f"There is no problem {name!r}; the problems are {', '.join(PROBLEMS)}.")
        figures += compare(name, PROBLEMS[name](), moments, chosen.seed)
    for shown in tables(figures):
        Console(highlight=False).print(shown)
    command_line.write_report(chosen.json, command_line.provenance("transport", arguments) | {"figures": figures})
    return ExitCode.OK


def _moments(text: str) -> list[int]:
    try:
        found = sorted({int(word) for word in text.split(",")})
    except ValueError:
        found = []
    if not found or found[0] < 0 or found[-1] < 1:
        raise UsageError(f"The moments are {text!r}, but must be numbers of steps such as 0,5,20.")
    return found


def compare(name: str, problem: ShapeProblem, moments: list[int], seed: int) -> Iterator[dict[str, Any]]:
    """Yield the figures of one problem: its gradients at the moments, and both runs from the same start."""
    start = pretrained(problem, seed, np.random.default_rng(seed))
    moving = run(problem, start, moments[-1], seed)
    for step in moments:
        yield from ({"problem": name, "step": step} | one for one in gradients(problem, moving[step], seed))
    staying = run(still(problem), start, moments[-1], seed)
    for way, theta in (("stay", staying[-1]), ("move", moving[-1])):
        best = measure(problem, theta, moments[-1], 0.0, seed)
        yield {"problem": name, "points": way, "steps": moments[-1], "loss": best.loss, "chamfer": best.chamfer}


def run(problem: ShapeProblem, start: Tensor, steps: int, seed: int) -> list[Tensor]:
    """Return the parameters before the first and after each step of Gauss-Newton."""
    rng, seen = np.random.default_rng(seed), []

    def problem_at(number: int, theta: Tensor) -> Problem:
        seen.append(theta.clone())
        return problem.freeze(number, theta, rng)

    last = (
        OPTIMISERS["gn"](problem, 0.0).run(problem_at, start, StopRule(steps, tolerance=0.0, patience=steps + 1)).theta
    )
    return [*seen, last]


def still(problem: ShapeProblem) -> ShapeProblem:
    """Return the problem with surface points that do not move."""

    def stays(term: Term) -> Term:
        def draw(state: StepState) -> SampledPoints:
            return replace(term.sampler(state), on_surface=False)

        return replace(term, sampler=draw)

    return replace(problem, terms=tuple(stays(term) for term in problem.terms))


def gradients(problem: ShapeProblem, theta: Tensor, seed: int, *, count: int = 2000) -> Iterator[dict[str, Any]]:
    """Yield for each variant the error of its gradient, compared with that with both terms, at `count` points."""
    (curvature,) = (term.residual for term in problem.terms if isinstance(term.residual, SecondOrder))
    points = sample_surface(problem.level_set(theta), count, np.random.default_rng(seed)).points
    found = {name: _gradient(problem, theta, curvature, points, *kept) for name, kept in VARIANTS.items()}
    both = found.pop("both")
    for name, gradient in found.items():
        yield {
            "variant": name,
            "error": float((gradient - both).norm() / both.norm()),
            "cosine": float(gradient @ both / (gradient.norm() * both.norm())),
        }


def _gradient(
    problem: ShapeProblem,
    theta: Tensor,
    residual: SecondOrder,
    points: Tensor,
    stretch: float,
    convection: float,
    *,
    step: float = 1e-3,
) -> Tensor:
    """Return J^T r of a residual on the surface, of shape (p,), with shares of the neglected terms.

    `step` is that of the finite difference along the normal.
    """
    jet = problem.network.curved_jet(theta, points)

    def at(x: Tensor) -> Linearised:
        there = problem.network.curved_jet(theta, x)
        return residual(there.value, there.gradient, there.hessian)

    normals = torch.nn.functional.normalize(jet.gradient, dim=1)
    along = convection * derivative_along(lambda x: at(x).residual, points, normals, step)
    bend = stretch * mean_curvature(jet.value, jet.gradient, jet.hessian).residual[:, 0]
    linear = transported(at(points), jet.gradient, bend, along)
    parts = (linear.by_value, linear.by_gradient, linear.by_hessian)
    rows = jet.rows(*(None if part is None else part[:, 0] for part in parts))
    sizes = tuple(out * (into + 1) for out, into in problem.network.layout.shapes)
    return LayeredJacobian(lambda: [rows], len(points), sizes, points.device).tmv(linear.residual[:, 0])


def tables(figures: Sequence[dict[str, Any]]) -> list[Table]:
    """Return the gradients' table and the runs'."""
    first = Table("problem", "step", "kept", "off by", "cosine", title="Gradients without one or both neglected terms")
    second = Table("problem", "surface points", "steps", "loss", "Chamfer", title="Runs of the same number of steps")
    for one in figures:
        if "variant" in one:
            row = f"{one['error']:.1%}", f"{one['cosine']:.3f}"
            first.add_row(one["problem"], str(one["step"]), one["variant"], *row)
        else:
            distance = number_or_dash(one["chamfer"], "{:.1e}")
            second.add_row(one["problem"], one["points"], str(one["steps"]), f"{one['loss']:.1e}", distance)
    return [first, second]

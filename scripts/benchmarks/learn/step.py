"""The time of one Gauss-Newton step on the catenoid, in closed form and by nested automatic differentiation."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.learn.nested import nested_step, papers_step
from gnrecon.least_squares import Cholesky, LinearSolver, identity
from gnrecon.shape_learning import ShapeProblem, catenoid, learn
from gnrecon.shape_learning.frozen_points import FrozenProblem

STEPS = 60
"""Of the run, before the step that is timed; the surface has its shape then, and the eikonal term is gone."""

OURS, NESTED = 9, 3
"""Repetitions, of which the median counts."""


def step_figures(seed: int) -> dict[str, Any]:
    """Return the figures of the first step of a run (`first`) and of a later one (`later`)."""
    problem = catenoid()
    begun = learn(problem, budget=None, steps=1, seed=seed).solution
    run = learn(problem, budget=None, steps=STEPS, seed=seed).solution
    rng = np.random.default_rng(seed)
    return {
        "first": figures_at(problem, begun.theta, 1, begun.history[-1].damping, rng),
        "later": figures_at(problem, run.theta, STEPS + 1, run.history[-1].damping, rng),
        "threads": torch.get_num_threads(),
    }


def figures_at(
    problem: ShapeProblem, theta: Tensor, step: int, damping: float, rng: np.random.Generator
) -> dict[str, Any]:
    """Return the seconds of a step by each way, and how far ours is from the exact one.

    All take the same points, which rest, and the same residuals and damping in float64: ours as `gnrecon learn` does,
    also with points that move with the surface as it does, and with J^T J and its Cholesky factor; the nested one with
    the same factor, and as the paper does.
    """
    moving = problem.freeze(step, theta, rng)
    resting = replace(moving, terms=[replace(term, moves=False) for term in moving.terms])

    def ours(frozen: FrozenProblem, solver: LinearSolver) -> Callable[[], Tensor]:
        return lambda: closed_step(frozen, theta, damping, solver)

    seconds, found = timed(ours(resting, problem.solver()), OURS)
    with_motion, _ = timed(ours(moving, problem.solver()), OURS)
    factored, _ = timed(ours(resting, Cholesky()), OURS)
    nested, exact = timed(lambda: nested_step(resting, theta, damping), NESTED)
    papers, _ = timed(lambda: papers_step(resting, theta, damping), NESTED)
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


def timed(work: Callable[[], Tensor], repetitions: int) -> tuple[float, Tensor]:
    """Return the median seconds of several runs, and the result."""
    spent = []
    for _ in range(repetitions):
        start = time.perf_counter()
        result = work()
        spent.append(time.perf_counter() - start)
    return float(np.median(spent)), result

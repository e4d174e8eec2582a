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
from gnrecon.linalg import Cholesky, identity
from gnrecon.shapes import catenoid
from gnrecon.shapes.frozen import FrozenProblem
from gnrecon.shapes.pretrain import pretrained

DAMPING = 1e-6
OURS, NESTED = 5, 2
"""Repetitions, of which the fastest counts."""


def step_figures(seed: int) -> dict[str, Any]:
    """Return the seconds of both, and how far their steps differ, as a share of the step's length.

    Both take the same points, which rest, the same rows in the same precision, and the same linear solver; the nested
    one is also solved as the paper does, and ours is also timed with points that move with the surface, as `gnrecon
    learn` takes it.
    """
    problem = catenoid()
    rng = np.random.default_rng(seed)
    theta = pretrained(problem, seed, rng)
    moving = problem.freeze(1, theta, rng)
    resting = replace(moving, terms=[replace(term, moves=False) for term in moving.terms])
    ours, closed = timed(lambda: closed_step(resting, theta), OURS)
    with_motion, _ = timed(lambda: closed_step(moving, theta), OURS)
    theirs, nested = timed(lambda: nested_step(resting, theta, DAMPING), NESTED)
    papers, _ = timed(lambda: papers_step(resting, theta, DAMPING), NESTED)
    return {
        "rows": sum(len(term.points) for term in resting.terms),
        "parameters": len(theta),
        "closed_seconds": ours,
        "moving_seconds": with_motion,
        "nested_seconds": theirs,
        "papers_seconds": papers,
        "speedup": theirs / ours,
        "papers_speedup": papers / ours,
        "difference": float((closed - nested).norm() / nested.norm()),
        "threads": torch.get_num_threads(),
    }


def closed_step(problem: FrozenProblem, theta: Tensor) -> Tensor:
    """Return the step, of shape (p,)."""
    return Cholesky().linearise(*problem.linearise(theta), identity).solve(DAMPING).direction


def timed(work: Callable[[], Tensor], repetitions: int) -> tuple[float, Tensor]:
    """Return the seconds of the fastest of several runs, and the result."""
    least = float("inf")
    for _ in range(repetitions):
        start = time.perf_counter()
        result = work()
        least = min(least, time.perf_counter() - start)
    return least, result

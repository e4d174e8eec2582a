"""Solving the damped equations by a Krylov method, from products with J and J^T alone (the paper's matrix-free way).

A step solves  v -> J^T (J v) + damping D v = -g, at O(M p) an iteration. What an iteration needs no setting up for,
its preconditioner does, and Gauss-Newton's matrices change little from one step to the next: a preconditioner that
was set up for one linearisation is used for later ones as long as it serves, which shows in the number of iterations.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from gnrecon.linalg.gmres import gmres
from gnrecon.linalg.jacobian import Jacobian
from gnrecon.linalg.krylov import Apply, KrylovResult, conjugate_gradients
from gnrecon.linalg.metric import Metric
from gnrecon.linalg.minres import minres
from gnrecon.linalg.preconditioner import Jacobi, Preconditioner, Prepared
from gnrecon.linalg.system import Equations, Linearisation, Step

METHODS = {"cg": conjugate_gradients, "minres": minres, "gmres": gmres}
NAMES = {"cg": "Conjugate gradients", "minres": "MINRES", "gmres": "GMRES"}
NO_DESCENT = "The iterations ended before they found a step that lowers the loss."


@dataclass
class Kept:
    """A prepared preconditioner and how it has served.

    Parameters
    ----------
    prepared : it
    like : a gradient of its time, for the number, precision and device of the columns
    first : iterations of the first solve with it, or None before that
    stale : whether it is to be made anew for the next linearisation
    """

    prepared: Prepared
    like: Tensor
    first: int | None = None
    stale: bool = False
    last: tuple[float, Apply] | None = None

    def at(self, damping: float) -> Apply:
        """Return P^-1, the last one again for the same damping."""
        if self.last is None or self.last[0] != damping:
            self.last = damping, self.prepared.at(damping)
        return self.last[1]

    def fits(self, gradient: Tensor) -> bool:
        """Whether it can be applied to such a vector."""
        like = self.like
        return (like.shape, like.dtype, like.device) == (gradient.shape, gradient.dtype, gradient.device)

    def note(self, result: KrylovResult, patience: int) -> None:
        """Judge it by a solve."""
        self.first = result.iterations if self.first is None else self.first
        self.stale = not result.converged or result.iterations > self.first + patience


@dataclass(frozen=True)
class IterativeSystem(Linearisation):
    """J, never multiplied out, and a preconditioner (None where there is nothing to solve)."""

    solver: Iterative
    kept: Kept | None

    def solve(self, damping: float, residual: Tensor | None = None) -> Step:
        """Return the step as far as the tolerance or the limit of iterations lets it come."""
        equations = self.equations.at(residual)
        obstacle = equations.obstacle(damping)
        if obstacle or self.kept is None:
            return equations.failed(obstacle or NO_DESCENT)
        jacobian, diagonal = equations.jacobian, damping * equations.metric

        def apply(v: Tensor) -> Tensor:
            return jacobian.tmv(jacobian.mv(v)).addcmul_(diagonal, v)

        method = METHODS[self.solver.method]
        result = method(apply, -equations.gradient, self.kept.at(damping), self.solver.tolerance, self.solver.limit)
        if residual is None:
            self.kept.note(result, self.solver.patience)
        if not result.converged and not float(result.solution @ equations.gradient) < 0.0:
            return equations.failed(result.failure or NO_DESCENT, result.iterations)
        return equations.step(result.solution, damping, result.rest, result.iterations)


@dataclass
class Iterative:
    """A Krylov method and a preconditioner, which is kept from one linearisation to the next.

    Parameters
    ----------
    method : "cg", "minres" or "gmres"
    preconditioner : how J^T J is approximated
    tolerance : |rest| / |g| at which a solve is done
    limit : iterations after which it ends all the same
    reuse : whether a preconditioner serves more than one linearisation
    patience : iterations more than its first solve took after which it is made anew
    seed : of the preconditioners' chance
    """

    method: Literal["cg", "minres", "gmres"] = "cg"
    preconditioner: Preconditioner = field(default_factory=Jacobi)
    tolerance: float = 1e-6
    limit: int = 200
    reuse: bool = True
    patience: int = 10
    seed: int = 0
    kept: Kept | None = field(default=None, init=False, repr=False)
    generator: torch.Generator = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(self.seed)

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> IterativeSystem:
        """Take J, and set up a preconditioner unless the last one still serves."""
        equations = Equations.of(jacobian, residual, metric)
        # What cannot be solved with a damping that stands for all, cannot be with any.
        if equations.obstacle(1.0):
            return IterativeSystem(equations, self, None)
        kept = self.kept
        if kept is None or not self.reuse or kept.stale or not kept.fits(equations.gradient):
            prepared = self.preconditioner.prepare(jacobian, equations.metric, self.generator)
            kept = self.kept = Kept(prepared, equations.gradient)
        return IterativeSystem(equations, self, kept)

    def describe(self) -> str:
        """Name the method and the preconditioner."""
        return f"{NAMES[self.method]}, preconditioned by {self.preconditioner.describe()}."

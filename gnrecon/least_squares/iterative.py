"""Solving the damped equations by a Krylov method, from products with J and J^T alone (the paper's matrix-free way).

A step solves  v -> J^T (J v) + damping D v = -g, at O(M p) an iteration. What an iteration needs no setting up for,
its preconditioner does, and Gauss-Newton's matrices change little from one step to the next: a preconditioner that
was set up for one linearisation is used for later ones as long as it serves. It serves no longer when a solve takes
`patience` iterations more than its first one did; that solve is then begun again with a new one. Nor is it adapted to
each damping: for one that is a few times another, a few more iterations cost less than a factorisation (of 2,273
parameters and 19,378 rows, ten steps took 0.76 s of the processors' time each with a factor for each damping, 0.55 s
with one for all within a factor of four).

Products with J may be made in float32. That is to solve with J + E, |E| <= eps |J|, and the exact gradient, which moves
the step, in the norm of J^T J + damping D, by about |E D^-1/2| / sqrt(damping) of itself: `rounding` bounds this, and
where the damping is too small for it, J is taken as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from gnrecon.least_squares.jacobian import Jacobian
from gnrecon.least_squares.krylov import Apply, KrylovResult, conjugate_gradients, gmres, minres
from gnrecon.least_squares.preconditioners import Jacobi, Preconditioner, Prepared
from gnrecon.least_squares.system import Equations, Linearisation, Metric, Step

METHODS = {"minres": minres, "gmres": gmres}
NAMES = {"cg": "Conjugate gradients", "minres": "MINRES", "gmres": "GMRES"}
TOLERANCE = 1e-6
FADING = 0.7
NEAR = 4.0
"""Factor of the damping within which a preconditioner is not adapted again: eigenvalues are off by no more than it."""

LOOKED_AT = 64
"""Rows whose squared lengths stand for those of all."""

NO_DESCENT = "The iterations ended before they found a step that lowers the loss."


@dataclass
class Kept:
    """A prepared preconditioner and how it has served.

    Parameters
    ----------
    prepared : it
    of : the Jacobian that it was set up from
    like : a gradient of its time, for the number, precision and device of the columns
    first : iterations of the first solve with it, or None before that
    """

    prepared: Prepared
    of: Jacobian
    like: Tensor
    first: int | None = None
    last: tuple[float, Apply] | None = None

    def at(self, damping: float) -> Apply:
        """Return P^-1, the last one again for a damping that is near its own."""
        if self.last is None or not self.last[0] / NEAR <= damping <= self.last[0] * NEAR:
            self.last = damping, self.prepared.at(damping)
        return self.last[1]

    def fits(self, gradient: Tensor) -> bool:
        """Whether it can be applied to such a vector."""
        like = self.like
        return (like.shape, like.dtype, like.device) == (gradient.shape, gradient.dtype, gradient.device)


@dataclass(frozen=True)
class IterativeSystem(Linearisation):
    """J, never multiplied out, and a preconditioner, of which there is none where there is nothing to solve."""

    solver: Iterative
    kept: list[Kept]

    def solve(self, damping: float, residual: Tensor | None = None) -> Step:
        """Return the step as far as the tolerance or the limit of iterations lets it come."""
        equations = self.equations.at(residual)
        obstacle = equations.obstacle(damping)
        if obstacle or not self.kept:
            return equations.failed(obstacle or NO_DESCENT)
        spent, old = 0, self.kept[0]
        if old.of is not equations.jacobian:
            result = self._iterate(equations, damping, old, self.solver.patience + (old.first or 0))
            if result.converged:
                return equations.step(result.solution, damping, result.rest, result.iterations)
            spent, self.kept[0] = result.iterations, self.solver.renew(self.equations)
        result = self._iterate(equations, damping, self.kept[0], self.solver.limit)
        if self.kept[0].first is None:
            self.kept[0].first = result.iterations
        spent += result.iterations
        if not result.converged and not float(result.solution @ equations.gradient) < 0.0:
            return equations.failed(result.failure or NO_DESCENT, spent)
        return equations.step(result.solution, damping, result.rest, spent)

    @cached_property
    def _rounded(self) -> tuple[Jacobian, float]:
        """J in float32, and the least damping at which its products are near enough."""
        jacobian = self.equations.jacobian
        rows = torch.arange(0, jacobian.rows, -(-jacobian.rows // LOOKED_AT), device=jacobian.device)
        squares = sum(float((chunk.square() / self.equations.metric).sum()) for chunk in jacobian.sample(rows).dense())
        squares *= jacobian.rows / len(rows)
        return jacobian.rounded(), (torch.finfo(torch.float32).eps / self.solver.rounding) ** 2 * squares

    def _products(self, damping: float) -> Jacobian:
        """Return J as the iterations take it."""
        if self.solver.rounding and damping >= self._rounded[1]:
            return self._rounded[0]
        return self.equations.jacobian

    def _iterate(self, equations: Equations, damping: float, kept: Kept, limit: int) -> KrylovResult:
        jacobian, diagonal = self._products(damping), damping * equations.metric

        def apply(v: Tensor) -> Tensor:
            return jacobian.tmv(jacobian.mv(v)).addcmul_(diagonal, v)

        result = self.solver.iterate(apply, -equations.gradient, kept.at(damping), min(limit, self.solver.limit))
        self.solver.spent += result.iterations
        return result


@dataclass
class Iterative:
    """A Krylov method and a preconditioner, which is kept from one linearisation to the next.

    Parameters
    ----------
    method : "cg", "minres" or "gmres"
    preconditioner : how J^T J is approximated
    tolerance : |rest| / |g| at which a solve is done
    energy : conjugate gradients also stop at this relative error of the step in the norm of the damped matrix, as the
        preconditioner measures it; 0.1 serves Gauss-Newton, whose model is no more exact than that
    limit : iterations after which it ends all the same
    reuse : whether a preconditioner serves more than one linearisation
    patience : iterations more than its first solve took after which an older one is made anew
    seed : of the preconditioners' chance
    rounding : share of a step by which products with J in float32 may move it, in the norm of the damped matrix; 0 for
        products in the precision in which J is stored
    adapt : from the preconditioner and the effort to the preconditioner of the next linearisation; by default it stays
    effort : iterations that a linearisation took of late, a running mean
    """

    method: Literal["cg", "minres", "gmres"] = "cg"
    preconditioner: Preconditioner = field(default_factory=Jacobi)
    tolerance: float = TOLERANCE
    energy: float = 0.0
    limit: int = 200
    reuse: bool = True
    patience: int = 8
    seed: int = 0
    rounding: float = 0.0
    adapt: Callable[[Preconditioner, float], Preconditioner] | None = None
    kept: Kept | None = field(default=None, init=False, repr=False)
    effort: float = field(default=0.0, init=False, repr=False)
    spent: int = field(default=0, init=False, repr=False)
    generator: torch.Generator = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.generator = torch.Generator().manual_seed(self.seed)

    def linearise(self, jacobian: Jacobian, residual: Tensor, metric: Metric) -> IterativeSystem:
        """Take J, and set up a preconditioner unless the last one still serves."""
        equations = Equations.of(jacobian, residual, metric)
        self.effort, self.spent = FADING * self.effort + (1 - FADING) * self.spent, 0
        if self.adapt is not None:
            self.preconditioner = self.adapt(self.preconditioner, self.effort)
        # What cannot be solved with a damping that stands for all, cannot be with any.
        if equations.obstacle(1.0):
            return IterativeSystem(equations, self, [])
        kept = self.kept
        if kept is None or not self.reuse or not kept.fits(equations.gradient):
            kept = self.renew(equations)
        return IterativeSystem(equations, self, [kept])

    def renew(self, equations: Equations) -> Kept:
        """Set up the preconditioner from a linearisation."""
        prepared = self.preconditioner.prepare(equations.jacobian, equations.metric, self.generator)
        self.kept = Kept(prepared, equations.jacobian, equations.gradient)
        return self.kept

    def iterate(self, apply: Apply, right: Tensor, precondition: Apply, limit: int) -> KrylovResult:
        """Run the method on  apply(s) = right."""
        if self.method == "cg":
            return conjugate_gradients(apply, right, precondition, self.tolerance, limit, self.energy)
        return METHODS[self.method](apply, right, precondition, self.tolerance, limit)

    def describe(self) -> str:
        """Name the method and the preconditioner."""
        return f"{NAMES[self.method]}, preconditioned by {self.preconditioner.describe()}."

"""The preconditioned conjugate gradient method, and the result type of all Krylov methods.

A Krylov method solves A x = b from products with A. It looks for x in the span of z, (P^-1 A) z, (P^-1 A)^2 z, ... with
z = P^-1 b, where P^-1 is a cheap approximation of A^-1, and stops once |b - A x| <= tolerance |b|.

Conjugate gradients minimise the error of x in the norm of A, for symmetric positive definite A and P. Each iterate
decreases x.A x / 2 - b.x, so a step that stops early is still a descent step. Sources: Hestenes and Stiefel, Methods of
conjugate gradients (1952); Steihaug (1983) for the truncated step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Apply = Callable[[Tensor], Tensor]
"""A linear map of vectors of shape (p,)."""


@dataclass(frozen=True)
class KrylovResult:
    """The result of a Krylov method.

    Parameters
    ----------
    solution : x, the last good iterate, of shape (p,); usable whether or not it converged
    rest : the residual b - A x, as updated by the recurrences, of shape (p,)
    iterations : products with A
    converged : whether the stopping rule holds
    failure : why the iteration stopped early, or None; reaching the limit is not a failure
    """

    solution: Tensor
    rest: Tensor
    iterations: int
    converged: bool
    failure: str | None = None


def conjugate_gradients(
    apply: Apply,
    b: Tensor,
    precondition: Apply,
    tolerance: float,
    limit: int,
    energy: float = 0.0,
    start: KrylovResult | None = None,
) -> KrylovResult:
    """Solve A x = b, for b of shape (p,), in at most `limit` products.

    With P near A, r.P^-1 r approximates the squared error |x - A^-1 b|_A^2. The iteration also stops when the square
    root of this falls below `energy` times its value at x = 0. It begins there, or where another one, such as with a
    worse preconditioner, has ended.
    """
    target = tolerance * norm(b)
    if not norm(b) > 0.0:
        return zero_solution(b)
    z = precondition(b)
    least = energy**2 * float(b @ z)
    x, r = torch.zeros_like(b), b.clone()
    if start is not None:
        x, r = start.solution.clone(), start.rest.clone()
        z = precondition(r)
        if norm(r) <= target or 0.0 <= float(r @ z) <= least:
            return KrylovResult(x, r, 0, True)
    p, rz = z.clone(), float(r @ z)
    for count in range(1, limit + 1):
        if not 0.0 < rz < math.inf:
            return KrylovResult(x, r, count - 1, False, "The preconditioner is not positive definite.")
        Ap = apply(p)
        curvature = float(p @ Ap)
        if not 0.0 < curvature < math.inf:
            indefinite = "The matrix is not positive definite along a search direction."
            failure = indefinite if math.isfinite(curvature) else "A product with the matrix is not finite."
            return KrylovResult(x, r, count, False, failure)
        x.add_(p, alpha=rz / curvature)
        r.sub_(Ap, alpha=rz / curvature)
        if norm(r) <= target:
            return KrylovResult(x, r, count, True)
        z, before = precondition(r), rz
        rz = float(r @ z)
        if 0.0 <= rz <= least:
            return KrylovResult(x, r, count, True)
        # p <- z + beta p, conjugate to all directions before
        p.mul_(rz / before).add_(z)
    return KrylovResult(x, r, limit, False)


def zero_solution(b: Tensor) -> KrylovResult:
    """Return x = 0 for b = 0, or the failure of a right-hand side that is not finite."""
    failure = None if bool(torch.isfinite(b).all()) else "The right-hand side is not finite."
    return KrylovResult(torch.zeros_like(b), b.clone(), 0, failure is None, failure)


def norm(vector: Tensor) -> float:
    """Return |v|."""
    return float(torch.linalg.vector_norm(vector))

"""Krylov methods solve A x = b from products with A; here what they have in common, and conjugate gradients.

All look for x in the span of z, (P^-1 A) z, (P^-1 A)^2 z, ... with z = P^-1 b, where P^-1 is a cheap approximation of
A^-1, and stop once |b - A x| <= tolerance |b|.

Conjugate gradients make the error of x least in the norm of A, for A and P symmetric and positive definite. Every
iterate lowers x.A x / 2 - b.x further, so that one that stopped early is still a descent step. Sources: Hestenes and
Stiefel, Methods of conjugate gradients (1952); Steihaug (1983) for the truncated step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Apply = Callable[[Tensor], Tensor]
"""A linear map of vectors of shape (p,)."""

INDEFINITE = "The matrix is not positive definite along a search direction."
BAD_PRECONDITIONER = "The preconditioner is not positive definite."
NOT_FINITE = "A product with the matrix is not finite."
BAD_RIGHT_SIDE = "The right-hand side is not finite."
SINGULAR = "The matrix is singular on the space that was searched."


@dataclass(frozen=True)
class KrylovResult:
    """What an iteration came to.

    Parameters
    ----------
    solution : x, the last good iterate, of shape (p,); usable whether or not it converged
    rest : b - A x as the recurrences have it, of shape (p,)
    iterations : products with A
    converged : whether the stopping rule holds
    failure : what broke the iteration off, or None; reaching the limit is no failure
    """

    solution: Tensor
    rest: Tensor
    iterations: int
    converged: bool
    failure: str | None = None


def conjugate_gradients(
    apply: Apply, b: Tensor, precondition: Apply, tolerance: float, limit: int, energy: float = 0.0
) -> KrylovResult:
    """Solve A x = b, for b of shape (p,), in at most `limit` products.

    With P near A, r.P^-1 r is near |x - A^-1 b|_A^2, the error as a quadratic model feels it; `energy` is the share of
    its first root at which the iteration stops as well.
    """
    target = tolerance * norm(b)
    if not norm(b) > 0.0:
        return unmoved(b)
    x, r = torch.zeros_like(b), b.clone()
    z = precondition(r)
    p, rz = z.clone(), float(r @ z)
    least = energy**2 * rz
    for count in range(1, limit + 1):
        if not 0.0 < rz < math.inf:
            return KrylovResult(x, r, count - 1, False, BAD_PRECONDITIONER)
        Ap = apply(p)
        curvature = float(p @ Ap)
        if not 0.0 < curvature < math.inf:
            return KrylovResult(x, r, count, False, INDEFINITE if math.isfinite(curvature) else NOT_FINITE)
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


def unmoved(b: Tensor) -> KrylovResult:
    """Return x = 0, which solves A x = 0; a right-hand side that is not finite has no solution."""
    failure = None if bool(torch.isfinite(b).all()) else BAD_RIGHT_SIDE
    return KrylovResult(torch.zeros_like(b), b.clone(), 0, failure is None, failure)


def norm(vector: Tensor) -> float:
    """Return |v|."""
    return float(torch.linalg.vector_norm(vector))

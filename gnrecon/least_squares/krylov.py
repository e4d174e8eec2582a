"""Krylov methods solve A x = b from products with A; here what they have in common, and conjugate gradients.

All look for x in the span of z, (P^-1 A) z, (P^-1 A)^2 z, ... with z = P^-1 b, where P^-1 is a cheap approximation of
A^-1, and stop once |b - A x| <= tolerance |b|.

Conjugate gradients make the error of x least in the norm of A, for A and P symmetric and positive definite. Every
iterate lowers x.A x / 2 - b.x further, so that one that stopped early is still a descent step. Sources: Hestenes and
Stiefel, Methods of conjugate gradients (1952); Steihaug (1983) for the truncated step.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
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


BASIS = 50

STAGNANT = 1.0 - 1e-6


# Flexible GMRES: the least residual in a Krylov space, for any matrix and preconditioner, at the price of its basis.
#
# Arnoldi's process gives A Z = V H with V orthonormal and z_k = P^-1 v_k; x = Z y with y the least-squares solution of
# |beta e_1 - H y|, and b - A x = V (beta e_1 - H y). After `BASIS` iterations it starts again from b - A x, which
# bounds the memory to 2 `BASIS` vectors. Neither A nor P needs to be symmetric, and orthogonality is kept by force, so
# that it stands more rounding in the products than the three-term recurrences do. Sources: Saad and Schultz, GMRES
# (1986); Saad, A flexible inner-outer preconditioned GMRES algorithm (1993).


def gmres(apply: Apply, b: Tensor, precondition: Apply, tolerance: float, limit: int) -> KrylovResult:
    """Solve A x = b, for b of shape (p,), in at most `limit` products."""
    target = tolerance * norm(b)
    if not norm(b) > 0.0:
        return unmoved(b)
    x, r, count = torch.zeros_like(b), b.clone(), 0
    while count < limit:
        before = norm(r)
        cycle = _cycle(apply, r, precondition, target, min(BASIS, limit - count))
        x, r, count = x + cycle.solution, cycle.rest, count + cycle.iterations
        if norm(r) <= target:
            return KrylovResult(x, r, count, True)
        failure = cycle.failure or (None if norm(r) < STAGNANT * before else SINGULAR)
        if failure:
            return KrylovResult(x, r, count, False, failure)
    return KrylovResult(x, r, count, False)


def _cycle(apply: Apply, r: Tensor, precondition: Apply, target: float, size: int) -> KrylovResult:
    """Return the best solution of A x = r in a basis of at most `size` vectors."""
    V, Z, H = r.new_zeros(size + 1, len(r)), r.new_zeros(size, len(r)), np.zeros((size + 1, size))
    beta = norm(r)
    V[0] = r / beta
    for k in range(size):
        Z[k] = precondition(V[k])
        w = apply(Z[k])
        length = norm(w)
        if not length < np.inf:
            return _best(V, Z, H[: k + 1, :k], beta, k + 1, NOT_FINITE)
        # Gram-Schmidt, twice, which is as good as Householder's reflections
        for _ in range(2):
            overlap = V[: k + 1] @ w
            w = w - overlap @ V[: k + 1]
            H[: k + 1, k] += overlap.cpu().numpy()
        H[k + 1, k] = norm(w)
        # The space is exhausted: it holds the solution, if there is one.
        exhausted = H[k + 1, k] <= 4.0 * sys.float_info.epsilon * length
        V[k + 1] = w / H[k + 1, k] if not exhausted else 0.0
        if exhausted or _left(H[: k + 2, : k + 1], beta) <= target:
            return _best(V, Z, H[: k + 2, : k + 1], beta, k + 1, None)
    return _best(V, Z, H, beta, size, None)


def _coordinates(H: np.ndarray, beta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return y, of shape (k,), and beta e_1 - H y, of shape (k + 1,)."""
    right = np.zeros(len(H))
    right[0] = beta
    y = np.linalg.lstsq(H, right, rcond=None)[0]
    return y, right - H @ y


def _left(H: np.ndarray, beta: float) -> float:
    return float(np.linalg.norm(_coordinates(H, beta)[1]))


def _best(V: Tensor, Z: Tensor, H: np.ndarray, beta: float, count: int, failure: str | None) -> KrylovResult:
    """Return the solution whose coordinates in Z minimise the residual."""
    y, left = (torch.from_numpy(part).to(V) for part in _coordinates(H, beta))
    return KrylovResult(y @ Z[: len(y)], left @ V[: len(left)], count, False, failure)


# MINRES: the least residual in a Krylov space, from a three-term recurrence.
#
# For A symmetric, definite or not, and P symmetric and positive definite. Lanczos vectors v_k, orthonormal in P^-1,
# turn A into a tridiagonal matrix T; x = Z y with z_k = P^-1 v_k and y the least-squares solution of |beta e_1 - T y|,
# kept up to date by one Givens rotation an iteration. What is least is the norm of b - A x in P^-1; for a definite A
# the iterates lower x.A x / 2 - b.x as well. Sources: Paige and Saunders, Solution of sparse indefinite systems of
# linear equations (1975); with a preconditioner in Elman, Silvester and Wathen, Finite Elements and Fast Iterative
# Solvers (2014), algorithm 4.1.


def minres(apply: Apply, b: Tensor, precondition: Apply, tolerance: float, limit: int) -> KrylovResult:
    """Solve A x = b, for b of shape (p,), in at most `limit` products."""
    target = tolerance * norm(b)
    if not norm(b) > 0.0:
        return unmoved(b)
    x, r = torch.zeros_like(b), b.clone()
    v_old, v, z = torch.zeros_like(b), b, precondition(b)
    w_old, w, Aw_old, Aw = (torch.zeros_like(b) for _ in range(4))
    gamma_old, gamma = 1.0, _norm_in(z, v)
    eta, c_old, c, s_old, s = gamma, 1.0, 1.0, 0.0, 0.0
    if not gamma > 0.0:
        return KrylovResult(x, r, 0, False, BAD_PRECONDITIONER)
    for count in range(1, limit + 1):
        # Lanczos: A z = delta v + gamma v_old + the next v, here with v of length gamma in P^-1 and z of length 1
        z = z / gamma
        Az = apply(z)
        delta = float(z @ Az)
        if not math.isfinite(delta):
            return KrylovResult(x, r, count, False, NOT_FINITE)
        v_old, v = v, Az - (delta / gamma) * v - (gamma / gamma_old) * v_old
        z_old, z = z, precondition(v)
        gamma_new = _norm_in(z, v)
        if not gamma_new >= 0.0:
            return KrylovResult(x, r, count, False, BAD_PRECONDITIONER)
        # The new column of T, turned by the last two rotations and by a new one that clears gamma_new
        a0, a2, a3 = c * delta - c_old * s * gamma, s * delta + c_old * c * gamma, s_old * gamma
        a1 = math.hypot(a0, gamma_new)
        if a1 <= sys.float_info.epsilon * (abs(delta) + gamma):
            return KrylovResult(x, r, count, False, SINGULAR)
        c_old, c, s_old, s = c, a0 / a1, s, gamma_new / a1
        # W = Z T_R^-1, and A W by the same recurrence, which gives b - A x without another product
        w_old, w = w, (z_old - a3 * w_old - a2 * w) / a1
        Aw_old, Aw = Aw, (Az - a3 * Aw_old - a2 * Aw) / a1
        x.add_(w, alpha=c * eta)
        r.sub_(Aw, alpha=c * eta)
        if norm(r) <= target:
            return KrylovResult(x, r, count, True)
        if gamma_new == 0.0:
            return KrylovResult(x, r, count, False, SINGULAR)
        eta, gamma_old, gamma = -s * eta, gamma, gamma_new
    return KrylovResult(x, r, limit, False)


def _norm_in(z: Tensor, v: Tensor) -> float:
    """Return |v| in the norm of P^-1, given z = P^-1 v, or NaN where that is no norm."""
    square = float(z @ v)
    # What is left of v once the space is exhausted is rounding, of either sign.
    tiny = sys.float_info.epsilon * norm(z) * norm(v)
    return math.sqrt(max(square, 0.0)) if -tiny <= square < math.inf else math.nan

"""MINRES: the least residual in a Krylov space, from a three-term recurrence.

For A symmetric, definite or not, and P symmetric and positive definite. Lanczos vectors v_k, orthonormal in P^-1,
turn A into a tridiagonal matrix T; x = Z y with z_k = P^-1 v_k and y the least-squares solution of |beta e_1 - T y|,
kept up to date by one Givens rotation an iteration. What is least is the norm of b - A x in P^-1; for a definite A
the iterates lower x.A x / 2 - b.x as well. Sources: Paige and Saunders, Solution of sparse indefinite systems of
linear equations (1975); with a preconditioner in Elman, Silvester and Wathen, Finite Elements and Fast Iterative
Solvers (2014), algorithm 4.1.
"""

from __future__ import annotations

import math
import sys

import torch
from torch import Tensor

from gnrecon.linalg.krylov import BAD_PRECONDITIONER, NOT_FINITE, SINGULAR, Apply, KrylovResult, norm, unmoved


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

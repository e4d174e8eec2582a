"""Flexible GMRES: the least residual in a Krylov space, for any matrix and preconditioner, at the price of its basis.

Arnoldi's process gives A Z = V H with V orthonormal and z_k = P^-1 v_k; x = Z y with y the least-squares solution of
|beta e_1 - H y|, and b - A x = V (beta e_1 - H y). After `BASIS` iterations it starts again from b - A x, which
bounds the memory to 2 `BASIS` vectors. Neither A nor P needs to be symmetric, and orthogonality is kept by force, so
that it stands more rounding in the products than the three-term recurrences do. Sources: Saad and Schultz, GMRES
(1986); Saad, A flexible inner-outer preconditioned GMRES algorithm (1993).
"""

from __future__ import annotations

import sys

import numpy as np
import torch
from torch import Tensor

from gnrecon.linalg.krylov import NOT_FINITE, SINGULAR, Apply, KrylovResult, norm, unmoved

BASIS = 50
STAGNANT = 1.0 - 1e-6


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

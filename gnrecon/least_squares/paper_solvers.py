"""The solvers that the paper names and that `auto` never chooses: GMRES, block Jacobi and Nystrom preconditioning.

They are here for comparison, as "gmres", "cg-block-jacobi" and "cg-nystrom" of `SOLVERS`. The paper's other two, the
conjugate gradient method and the Jacobi preconditioner, are in `krylov` and `preconditioners`.
Source: the paper's section on solving the linear system, which cites Frangella, Tropp and Udell for Nystrom.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gnrecon.least_squares.direct import solve_factored
from gnrecon.least_squares.jacobian import Jacobian
from gnrecon.least_squares.krylov import Apply, KrylovResult, norm, zero_solution
from gnrecon.least_squares.preconditioners import definite_factor, positive

# Flexible GMRES minimises the residual over a Krylov space, for any matrix and preconditioner.
#
# Arnoldi's process gives A Z = V H with V orthonormal and z_k = P^-1 v_k; x = Z y with y the least-squares solution of
# |beta e_1 - H y|, and b - A x = V (beta e_1 - H y). It restarts from b - A x when the basis is full, which bounds the
# memory to two bases. Neither A nor P needs to be symmetric, and the explicit orthogonalisation tolerates more rounding
# in the products than the short recurrence of conjugate gradients. Sources: Saad and Schultz, GMRES (1986); Saad, A
# flexible inner-outer preconditioned GMRES algorithm (1993).


def gmres(
    apply: Apply,
    b: Tensor,
    precondition: Apply,
    tolerance: float,
    limit: int,
    *,
    basis_size: int = 50,
    stagnation: float = 1e-6,
) -> KrylovResult:
    """Solve A x = b, for b of shape (p,), in at most `limit` products.

    Parameters
    ----------
    basis_size : vectors before a restart; 50 bounds the memory to 100 vectors of the parameters' size
    stagnation : relative decrease of the residual over a cycle below which A counts as singular
    """
    target = tolerance * norm(b)
    if not norm(b) > 0.0:
        return zero_solution(b)
    x, r, count = torch.zeros_like(b), b.clone(), 0
    while count < limit:
        before = norm(r)
        cycle = _cycle(apply, r, precondition, target, min(basis_size, limit - count))
        x, r, count = x + cycle.solution, cycle.rest, count + cycle.iterations
        if norm(r) <= target:
            return KrylovResult(x, r, count, True)
        stagnates = not norm(r) < (1.0 - stagnation) * before
        failure = cycle.failure or ("The matrix is singular on the searched space." if stagnates else None)
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
            return _best(V, Z, H[: k + 1, :k], beta, k + 1, "A product with the matrix is not finite.")
        # Gram-Schmidt twice is as accurate as Householder reflections.
        for _ in range(2):
            overlap = V[: k + 1] @ w
            w = w - overlap @ V[: k + 1]
            H[: k + 1, k] += overlap.cpu().numpy()
        H[k + 1, k] = norm(w)
        # The space is invariant under A: it contains the solution, if there is one.
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


@dataclass(frozen=True)
class PreparedBlocks:
    """Diagonal blocks of J^T J, lower triangles valid, for `groups` of columns."""

    products: Sequence[Tensor]
    groups: Sequence[slice]
    metric: Tensor

    def at(self, damping: float) -> Apply:
        """Return r -> P^-1 r with P block by block J_l^T J_l + damping D_l."""
        factors = [
            definite_factor(product, damping * self.metric[group])
            for product, group in zip(self.products, self.groups, strict=True)
        ]

        def apply(r: Tensor) -> Tensor:
            parts = zip(factors, self.groups, strict=True)
            return torch.cat([solve_factored(factor, r[group]) for factor, group in parts])

        return apply


@dataclass(frozen=True)
class BlockJacobi:
    """The groups' blocks of J^T J: O(M sum p_l^2) to set up, O(sum p_l^3) a damping."""

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> PreparedBlocks:  # noqa: ARG002
        """Assemble the blocks."""
        return PreparedBlocks(jacobian.group_grams(), jacobian.groups, metric)

    def describe(self) -> str:
        """Name it."""
        return "the blocks of the groups of columns"


# Randomised Nystrom preconditioning: the leading eigenvectors of J^T J from a few products.
#
# With A = D^-1/2 J^T J D^-1/2 and a random orthonormal Omega of k columns, the sketch Y = A Omega gives the Nystrom
# approximation
#
#     A ~ Y (Omega^T Y)^-1 Y^T = U diag(lambda) U^T,
#
# computed for A + nu I with a small shift nu, subtracted at the end, so that rounding does not make the Cholesky
# factorisation of Omega^T Y fail. The preconditioner replaces A on the complement of U by lambda_k I:
#
#     P^-1 = U diag((lambda_k + mu) / (lambda + mu)) U^T + (I - U U^T),    mu = the damping,
#
# here divided by lambda_k + mu, so that it approximates the inverse itself. It works well where at most k eigenvalues
# of A are above the damping. Source: Frangella, Tropp, Udell, Randomized Nystrom preconditioning (2021), algorithm 2.1
# and equation 1.3.


@dataclass(frozen=True)
class PreparedNystrom:
    """U, of shape (p, k), lambda, of shape (k,) in descending order, and D^-1/2's diagonal."""

    U: Tensor
    values: Tensor
    scale: Tensor

    def at(self, damping: float) -> Apply:
        """Return r -> D^-1/2 P^-1 D^-1/2 r."""
        # The part outside of U is a difference; its rounding error is divided by `outside`, so that must not be tiny.
        damped = positive(self.values + damping)
        damped = damped.clamp_min(100.0 * torch.finfo(damped.dtype).eps * float(damped[0]))
        outside = float(damped[-1])
        inner = 1.0 / damped - 1.0 / outside

        def apply(r: Tensor) -> Tensor:
            r = self.scale * r
            return self.scale * (r / outside + self.U @ (inner * (self.U.T @ r)))

        return apply


@dataclass(frozen=True)
class Nystrom:
    """The `rank` leading eigenvectors of J^T J in the metric: `rank` products with J^T J and O(p rank^2) to set up."""

    rank: int

    def prepare(self, jacobian: Jacobian, metric: Tensor, generator: torch.Generator) -> PreparedNystrom:
        """Sketch J^T J column by column."""
        p, k, scale = jacobian.columns, min(self.rank, jacobian.columns), metric.rsqrt()
        Omega = torch.linalg.qr(torch.randn(p, k, generator=generator, dtype=torch.float64).to(metric)).Q
        Y = torch.stack([scale * jacobian.tmv(jacobian.mv(scale * Omega[:, i])) for i in range(k)], 1)
        core = Omega.T @ Y
        # The shift is as large as the rounding error of the symmetry, and at least eps |Y|.
        asymmetry = float(torch.linalg.matrix_norm(core - core.T))
        nu = max(asymmetry, torch.finfo(Y.dtype).eps * float(torch.linalg.matrix_norm(Y)))
        Y = Y + nu * Omega
        # A + nu I ~ B B^T with B = Y C^-T and C C^T = Omega^T Y, so that B's singular values are sqrt(lambda + nu)
        C = definite_factor(0.5 * (core + core.T), torch.full_like(core[0], nu))
        B = torch.linalg.solve_triangular(C, Y.T, upper=False).T
        U, roots, _ = torch.linalg.svd(B, full_matrices=False)
        return PreparedNystrom(U, (roots.square() - nu).clamp_min(0.0), scale)

    def describe(self) -> str:
        """Name it."""
        return f"a Nystrom approximation of rank {self.rank}"

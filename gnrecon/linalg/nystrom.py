"""Randomised Nystrom preconditioning: the leading eigenvectors of J^T J, found with a few products.

With A = D^-1/2 J^T J D^-1/2 and a random orthonormal Omega of k columns, the sketch Y = A Omega gives the best
approximation of A that Y knows of,

    A ~ Y (Omega^T Y)^-1 Y^T = U diag(lambda) U^T,

computed for A + nu I with a small shift nu, taken off again at the end, which keeps the Cholesky factor of Omega^T Y
from breaking down in rounding. The preconditioner treats the part of A that U does not reach as lambda_k I:

    P^-1 = U diag((lambda_k + mu) / (lambda + mu)) U^T + (I - U U^T),    mu = the damping,

here divided by lambda_k + mu, so that it approximates the inverse itself. It serves where the eigenvalues of A fall
below the damping within k of them. Source: Frangella, Tropp, Udell, Randomized Nystrom preconditioning (2021),
algorithms 2.1 and equation 1.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gnrecon.linalg.jacobian import Jacobian
from gnrecon.linalg.krylov import Apply
from gnrecon.linalg.preconditioner import definite_factor, positive


@dataclass(frozen=True)
class PreparedNystrom:
    """U, of shape (p, k), lambda, of shape (k,) in descending order, and D^-1/2's diagonal."""

    U: Tensor
    values: Tensor
    scale: Tensor

    def at(self, damping: float) -> Apply:
        """Return r -> D^-1/2 P^-1 D^-1/2 r."""
        # The part outside of U comes from a difference, whose rounding, divided by `outside`, must not drown the rest.
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
        # A shift of the size of what rounding left of the symmetry, at the least of eps |Y|
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

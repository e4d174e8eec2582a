"""The same Gauss-Newton step with everything differentiated by torch, nested: what the closed form is set beside.

The Jacobian's rows are ``vmap(jacrev(residual))`` by the parameters, of residuals that take the network's derivatives
in space by ``grad`` and ``jacrev`` themselves, as the paper's implementation section describes its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.func import grad, jacrev, vmap

from gnrecon.least_squares import Cholesky, DenseJacobian, identity
from gnrecon.shape_learning.frozen_points import FrozenProblem, FrozenTerm

CHUNK = 512
"""Points that are differentiated together: of 64 to 2,000, those with which it is fastest."""


def nested_step(problem: FrozenProblem, theta: Tensor, damping: float) -> Tensor:
    """Return the step of the problem, of shape (p,), its points at rest, for a damping in the identity metric.

    Raises
    ------
    KeyError
        When a term's name has no formula here.
    """
    system = Cholesky().linearise(*_linearised(problem, theta), identity)
    return system.solve(damping).direction


def papers_step(problem: FrozenProblem, theta: Tensor, damping: float) -> Tensor:
    """Return the same step, solved as the paper does: J^T J + eps I multiplied out, then least squares by QR.

    Raises
    ------
    KeyError
        When a term's name has no formula here.
    """
    jacobian, residual = _linearised(problem, theta)
    matrix = jacobian.matrix
    damped = matrix.T @ matrix + damping * torch.eye(matrix.shape[1], dtype=matrix.dtype)
    found: Tensor = torch.linalg.lstsq(damped, (matrix.T @ residual)[:, None], driver="gels").solution
    return -found[:, 0]


def _linearised(problem: FrozenProblem, theta: Tensor) -> tuple[DenseJacobian, Tensor]:
    """Return J and r."""
    parts = [_rows(problem, theta, term) for term in problem.terms]
    matrix, residual = (torch.cat(columns) for columns in zip(*parts, strict=True))
    return DenseJacobian(matrix), residual


def _rows(problem: FrozenProblem, theta: Tensor, term: FrozenTerm) -> tuple[Tensor, Tensor]:
    """Return a term's part of J and r."""

    def residual(theta: Tensor, point: Tensor) -> Tensor:
        return FORMULAS[term.name](lambda x: _value(problem, theta, x), point)

    scale = math.sqrt(term.weight / len(term.points))
    rows = vmap(jacrev(residual), in_dims=(None, 0), chunk_size=CHUNK)(theta, term.points)
    return scale * rows, scale * vmap(residual, in_dims=(None, 0), chunk_size=CHUNK)(theta, term.points)


def _value(problem: FrozenProblem, theta: Tensor, x: Tensor) -> Tensor:
    return problem.network.value(theta, x[None])[0]


def _divergence_of_normal(f: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    def normal(x: Tensor) -> Tensor:
        gradient: Tensor = grad(f)(x)
        unit: Tensor = gradient / gradient.norm()
        return unit

    divergence: Tensor = torch.trace(jacrev(normal)(x))
    return divergence


FORMULAS: dict[str, Callable[[Callable[[Tensor], Tensor], Tensor], Tensor]] = {
    "interface": lambda f, x: f(x),
    "eikonal": lambda f, x: torch.linalg.vector_norm(grad(f)(x)) - 1.0,
    "mean curvature": _divergence_of_normal,
}
"""Residuals of a field at one point, of shape (3,), by the terms' names."""

"""The terms of a problem on the points of one step, as the least-squares problem that the optimisers solve.

Row i of a term with weight w and N points is sqrt(w / N) r_i. The points of a surface move with it: each goes along the
gradient to where the changed field has the old value (zero), so the loss of a trial is that of the new surface. The
velocity of a point is -df / |grad f| along the normal n, so its residual changes by

    dr - (d_n r) df / |grad f|,

whose second part is a coefficient of df in the rows (`level_set.transport`). The linear model then agrees with the loss
of a trial, and the ratio of actual and predicted decrease controls the steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gnrecon.field import CurvedJet, Network
from gnrecon.least_squares import Block, LayeredJacobian
from gnrecon.level_set import transported
from gnrecon.residuals import Linearised, Residual, SecondOrder, tangents
from gnrecon.runtime.chunks import slices


@dataclass(frozen=True)
class FrozenTerm:
    """One constraint at the points of one step; `moves` if they are on the surface and move with it."""

    name: str
    residual: Residual | SecondOrder
    points: Tensor
    target: Tensor | None
    weight: float
    moves: bool = False

    @property
    def scale(self) -> float:
        """Factor of its residuals, sqrt(weight / N)."""
        return math.sqrt(self.weight / max(len(self.points), 1))


@dataclass(frozen=True)
class FrozenProblem:
    """Terms on a network, all of whose parameters are free.

    Parameters
    ----------
    network : Network
    terms : the constraints on their points
    theta : parameters, of shape (p,), at which the points were drawn
    stored : precision of the Jacobian's rows
    """

    network: Network
    terms: Sequence[FrozenTerm]
    theta: Tensor
    stored: torch.dtype = torch.float64

    def free(self) -> Tensor:
        """Return the parameters, of shape (p,)."""
        return self.theta

    def whole(self, free: Tensor) -> Tensor:
        """Return the parameters, of shape (p,)."""
        return free

    def residual(self, free: Tensor) -> Tensor:
        """Return the weighted residuals, of shape (M,), with surface points moved with the surface."""
        return torch.cat([free.new_zeros(0), *(rows for term in self.terms for rows in self._residuals(free, term))])

    def shares(self, free: Tensor) -> dict[str, float]:
        """Return each term's share of the loss, by its name."""
        losses: dict[str, float] = {}
        for term in self.terms:
            share = sum(0.5 * float(rows @ rows) for rows in self._residuals(free, term))
            losses[term.name] = losses.get(term.name, 0.0) + share
        return losses

    def linearise(self, free: Tensor) -> tuple[LayeredJacobian, Tensor]:
        """Return J, of shape (M, p), as outer products, and r, of shape (M,)."""
        blocks: list[Block] = []
        residuals = [free.new_zeros(0)]
        for term in self.terms:
            for points, target in self._batches(free, term):
                jet = self._jet(free, term.residual, points, 1)
                linear = self._linearised(free, term, jet, target, points)
                residuals.append((linear.residual * term.scale).T.flatten())
                blocks += [[layer.to(self.stored) for layer in block] for block in _rows(jet, linear, term.scale)]
        residual = torch.cat(residuals)
        sizes = tuple(out * (into + 1) for out, into in self.network.layout.shapes)
        return LayeredJacobian(lambda: blocks, len(residual), sizes, free.device, stored=self.stored), residual

    def _residuals(self, free: Tensor, term: FrozenTerm) -> Iterator[Tensor]:
        for points, target in self._batches(free, term):
            linear = evaluate(term.residual, self._jet(free, term.residual, points, 0), target)
            yield (linear.residual * term.scale).T.flatten()

    def _linearised(
        self, free: Tensor, term: FrozenTerm, jet: CurvedJet, target: Tensor | None, points: Tensor
    ) -> Linearised:
        linear = evaluate(term.residual, jet, target)
        if not term.moves:
            return linear
        along = self._rates_along_normals(free, term.residual, jet, points)
        return transported(linear, jet.gradient, torch.zeros_like(jet.value), linear.rate(*along))

    def _rates_along_normals(
        self,
        free: Tensor,
        residual: Residual | SecondOrder,
        jet: CurvedJet,
        points: Tensor,
        *,
        difference_step: float = 2e-3,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return the derivatives of f, grad f and Hess f, if the residual has it, along the normals.

        By central differences: third derivatives of f in closed form would cost more. Differences of the residual
        itself are not possible, because the tangent frames of the strain may jump between two points. In float32:
        over `difference_step` its rounding is 1e-4 of the derivatives.

        Parameters
        ----------
        difference_step : in the coordinates' unit; about the motion of a surface in a step, so that where curvature
            changes fast, at edges of a part, the difference is over that distance
        """
        slope: Tensor = torch.linalg.vector_norm(jet.gradient, dim=1)
        offset = difference_step * torch.nn.functional.normalize(jet.gradient, dim=1)
        directions = None if jet.directions is None else jet.directions.float()
        before, after = (
            replace(self._plain_jet(free.float(), residual, (points + side).float(), 0), directions=directions)
            for side in (-offset, offset)
        )
        turn = (after.gradient - before.gradient).to(free) / (2 * difference_step)
        if not isinstance(residual, SecondOrder):
            return slope, turn, None
        return slope, turn, (after.hessian - before.hessian).to(free) / (2 * difference_step)

    def _jet(self, free: Tensor, residual: Residual | SecondOrder, points: Tensor, further: int) -> CurvedJet:
        """Return the field with the derivatives that a residual takes, and `further` orders for its rows."""
        jet = self._plain_jet(free, residual, points, further)
        if isinstance(residual, SecondOrder) and residual.tangential:
            return replace(jet, directions=tangents(jet.gradient))
        return jet

    def _plain_jet(self, free: Tensor, residual: Residual | SecondOrder, points: Tensor, further: int) -> CurvedJet:
        order = (2 if isinstance(residual, SecondOrder) else 1) + further
        return CurvedJet.of(self.network.layout.layers(free), self.network.activation, points, order)

    def _batches(
        self, free: Tensor, term: FrozenTerm, *, batch_points: int = 8192
    ) -> Iterator[tuple[Tensor, Tensor | None]]:
        """Yield points and targets in batches that fit into the cache; surface points are moved to `free`."""
        for rows in slices(len(term.points), batch_points):
            points = term.points[rows]
            if term.moves and free is not self.theta:
                points = self._followed(free, points)
            yield points, None if term.target is None else term.target[rows]

    def _followed(self, free: Tensor, points: Tensor, *, newton_steps: int = 2, longest_step: float = 0.1) -> Tensor:
        """Move points, of shape (N, 3), to where the field at `free` has its old values at the points.

        Each of the Newton steps is at most `longest_step` long, in the coordinates' unit.
        """
        level = self.network.value(self.theta, points)
        for _ in range(newton_steps):
            value, gradient = self.network.value_and_gradient(free, points)
            square = gradient.square().sum(1).clamp_min(1e-12)
            step = ((level - value) / square)[:, None] * gradient
            longest = torch.linalg.vector_norm(step, dim=1, keepdim=True).clamp_min(longest_step)
            points = points + step * (longest_step / longest)
        return points


def evaluate(residual: Residual | SecondOrder, jet: CurvedJet, target: Tensor | None) -> Linearised:
    """Return residuals at a jet's points."""
    if isinstance(residual, SecondOrder):
        return residual(jet.value, jet.gradient, jet.hessian, target)
    return residual(jet.value, jet.gradient, target)


def _rows(jet: CurvedJet, linear: Linearised, scale: float) -> Iterator[Block]:
    """Yield one block for each of the m residuals of the points."""
    for column in range(linear.residual.shape[1]):
        yield jet.rows(
            *(
                None if part is None else part[:, column] * scale
                for part in (linear.by_value, linear.by_gradient, linear.by_hessian)
            )
        )

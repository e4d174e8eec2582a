"""Curvature penalties of the fitted surface: smooth, minimal where there is no data, or developable.

    smooth   strain=W      W / 2 mean of k1^2 + k2^2 over the surface
    fill     minimal       W / 2 mean of (k1 + k2)^2, only where the surface is far from all points
    prior    developable   W / 2 mean of (k1 k2)^2, where it is no crease

each added to half the mean square distance of the points from the surface. All lengths are in radii of the scan. A bump
of wavenumber k costs f^2 by the data and W k^4 f^2 by the strain, so that bumps of the wavelength 2 pi W^(1/4) are
halved, and shorter ones all but vanish. A closed surface cannot be developable everywhere: its Gauss curvature must add
up, and it does so in creases and corners. So the square of k1 k2 counts as Geman and McClure's robust r^2 / (1 + r^2),
r over 8 per squared radius, which pulls at creases no more.
Source: King et al., Gauss-Newton natural gradient descent for shape learning (its table of constraints); Geman and
McClure, Statistical methods for tomographic image reconstruction (1987).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gnrecon.field.random_features import Features
from gnrecon.fit.parameters import PenaltyFitParameters
from gnrecon.least_squares import identity
from gnrecon.least_squares.jacobian import DenseJacobian
from gnrecon.optim import GainRatioDamping, GaussNewton, StopRule
from gnrecon.optim.problem import loss_of
from gnrecon.residuals import Linearised, SecondOrder, gauss_curvature, mean_curvature, surface_strain
from gnrecon.runtime.errors import UsageError


@dataclass(frozen=True)
class Regulariser:
    """One curvature penalty.

    Parameters
    ----------
    name : as in the options
    residual : of curvature, in radii
    weight : W
    holes : whether it applies only where the surface is far from all points
    crease : size of the residual from which on it hardly counts, or None
    """

    name: str
    residual: SecondOrder
    weight: float
    holes: bool = False
    crease: float | None = None


def regularisers(
    smooth: str | None,
    fill: str | None,
    prior: str | None,
    *,
    parameters: PenaltyFitParameters = PenaltyFitParameters(),
) -> tuple[Regulariser, ...]:
    """Return the penalties of the options: each is None or, for example, ``"strain=1e-4"`` or ``"developable"``.

    Raises
    ------
    UsageError
        When a text names another penalty, or a weight is not a positive number.
    """
    found = []
    if smooth is not None:
        found.append(Regulariser("strain", surface_strain, _weight("smooth", smooth, "strain", None)))
    if fill is not None:
        weight = _weight("fill", fill, "minimal", parameters.minimal_weight)
        found.append(Regulariser("minimal", mean_curvature, weight, holes=True))
    if prior is not None:
        weight = _weight("prior", prior, "developable", parameters.developable_weight)
        found.append(Regulariser("developable", gauss_curvature, weight, crease=parameters.crease_curvature))
    return tuple(found)


def _weight(option: str, text: str, known: str, default: float | None) -> float:
    """Return the weight in ``known=weight``, or the default, if there is one, of ``known`` alone."""
    name, equals, number = text.partition("=")
    if name != known or (default is None and not equals):
        shape = f"{known}=WEIGHT" + ("" if default is None else f" or {known} alone")
        raise UsageError(f"The option {option} takes {shape}, such as {known}=1e-4, not {text!r}.")
    if default is not None and not equals:
        return default
    try:
        weight = float(number)
    except ValueError:
        weight = math.nan
    if not 0 < weight < math.inf:
        raise UsageError(f"The weight of {option} must be a positive number, as in {known}=1e-4, not {number!r}.")
    return weight


Jet = tuple[Tensor, Tensor, Tensor]
"""Value (N,), gradient (N, 3) and second derivatives (N, 3, 3)."""


# Gauss-Newton on the amplitudes of sine features, with curvature penalties.
#
# The data, the volume and the prior are linear in the amplitudes a, so that all their rows are equivalent to those of
# one triangular matrix, |L^T a - y|^2 up to a constant. The residuals of curvature are not linear, and need a few steps
# of Gauss-Newton, each at points of the current surface; the best of these surfaces is returned.
#
# With phases z_j = w_j . x + p_j a feature has the gradient cos z_j w_j and the second derivatives -sin z_j w_j w_j^T,
# and so a residual linearised to dr = c df + v . d(grad f) + M : d(Hess f) the row
#
#     c sin z_j + (v . w_j) cos z_j - (w_j . M w_j) sin z_j.


@dataclass(frozen=True)
class PenaltyTerm:
    """A residual of curvature at points that follow the surface, or a residual of the value at fixed points.

    Parameters
    ----------
    residual : SecondOrder
    points : of shape (N, 3), near the surface, onto which they are moved
    scale : factor of each point's rows, of shape (N, 1)
    robust : size of the residual from which on it hardly counts, or None
    target : of each point, of shape (N,), or None
    fixed_value : value of the known function at each point, of shape (N,), if the points are fixed; else None
    """

    residual: SecondOrder
    points: Tensor
    scale: Tensor
    robust: float | None = None
    target: Tensor | None = None
    fixed_value: Tensor | None = None

    def linearised(self, jet: Jet) -> Linearised:
        """Return the residuals at the points' jet."""
        return self.residual(*jet, self.target)

    def active_rows(self, jet: Jet) -> tuple[PenaltyTerm, Linearised]:
        """Return the term at the fixed points whose residuals are not zero, and these residuals, at the jet."""
        linear = self.linearised(jet)
        assert linear.by_value is not None, "residuals of the value"
        rows = linear.residual.ne(0).any(dim=1)
        kept = replace(self, points=self.points[rows], scale=self.scale[rows])
        return kept, Linearised(linear.residual[rows], linear.by_value[rows], None)

    def reweighted(self, jet: Jet) -> PenaltyTerm:
        """Return a robust term with its weights at the points' jet in its scale."""
        assert self.robust is not None, "only robust terms have weights"
        square = self.linearised(jet).residual.square().sum(1, keepdim=True)
        # The tangent of r^2 / (1 + r^2) is a multiple of r^2: iteratively reweighted least squares.
        return replace(self, scale=self.scale / (1 + square / self.robust**2))


@dataclass(frozen=True)
class SineSum:
    """Sine features about a centre, on top of a known function.

    Parameters
    ----------
    features : Features
    center : of shape (3,)
    length : of the features
    reach : how far a point may go in one step onto the surface
    base : gives the known function's jet at points, of shape (N, 3); None where there is none
    """

    features: Features
    center: Tensor
    length: float
    reach: float
    base: Callable[[Tensor], Jet] | None = None

    def known(self, x: Tensor) -> Jet:
        """Return the jet of the known function at x, of shape (N, 3)."""
        if self.base is not None:
            return self.base(x)
        return x.new_zeros(len(x)), x.new_zeros(len(x), 3), x.new_zeros(len(x), 3, 3)

    def value(self, amplitudes: Tensor, x: Tensor, known: Jet) -> Jet:
        """Return the value of both together, with the known function's derivatives."""
        return known[0] + self.features.sums(amplitudes, x, self.center, self.length, 0)[0], known[1], known[2]

    def jet(self, amplitudes: Tensor, x: Tensor, known: Jet) -> Jet:
        """Return the jet of both together; `known` is that of the known function there."""
        own = self.features.sums(amplitudes, x, self.center, self.length, 2)
        return known[0] + own[0], known[1] + own[1], known[2] + own[2]

    def rows(self, x: Tensor, linear: Linearised, scale: Tensor) -> Tensor:
        """Return the rows of residuals, of shape (m N, p), residual by residual."""
        z = self.features.phase(x, self.center, self.length)
        sines, waves = z.sin(), self.features.frequencies / self.length
        cosines = sines if linear.by_gradient is None else z.cos()
        squares = (waves[:, :, None] * waves[:, None, :]).reshape(-1, 9)
        made = []
        for column in range(linear.residual.shape[1]):
            row = torch.zeros_like(sines)
            if linear.by_value is not None:
                row += linear.by_value[:, column, None] * sines
            if linear.by_gradient is not None:
                row += (linear.by_gradient[:, column] @ waves.T) * cosines
            if linear.by_hessian is not None:
                row -= (linear.by_hessian[:, column].reshape(-1, 9) @ squares.T) * sines
            made.append(scale * row)
        return torch.cat(made)

    def on_surface(
        self, amplitudes: Tensor, x: Tensor, *, newton_steps: int = PenaltyFitParameters.newton_steps
    ) -> Tensor:
        """Return points, of shape (N, 3), moved along the gradient onto the zero level, as far as it is near."""
        for _ in range(newton_steps):
            known = self.known(x)
            value, gradient = self.features.sums(amplitudes, x, self.center, self.length, 1)
            value, gradient = known[0] + value, known[1] + gradient
            step = value[:, None] * gradient / gradient.square().sum(1, keepdim=True).clamp_min(1e-6)
            far = torch.linalg.vector_norm(step, dim=1, keepdim=True).clamp_min(self.reach)
            x = x - step * (self.reach / far)
        return x


def constant_jet(value: Tensor) -> Jet:
    """Return values, of shape (N,), as a jet with derivatives of zero."""
    count = len(value)
    return value, value.new_zeros(1, 3).expand(count, 3), value.new_zeros(1, 3, 3).expand(count, 3, 3)


@dataclass(frozen=True)
class PenaltyProblem:
    """The least-squares problem of one step: L^T a = y, and the penalty terms at points that are fixed in this step.

    Parameters
    ----------
    sines : SineSum
    factor, target : L, of shape (p, p), and y, of shape (p,)
    terms : with points on the surface, and robust weights in their scales
    theta : amplitudes at which the problem was made
    known : jets of the known function at each term's points
    """

    sines: SineSum
    factor: Tensor
    target: Tensor
    terms: Sequence[PenaltyTerm]
    theta: Tensor
    known: Sequence[Jet]

    @classmethod
    def at(
        cls, sines: SineSum, factor: Tensor, target: Tensor, terms: Sequence[PenaltyTerm], theta: Tensor
    ) -> PenaltyProblem:
        """Return the problem at the surface of the amplitudes theta."""
        placed = [
            replace(term, points=sines.on_surface(theta, term.points)) if term.fixed_value is None else term
            for term in terms
        ]
        known = [
            sines.known(term.points) if term.fixed_value is None else constant_jet(term.fixed_value) for term in placed
        ]
        reweighted = [
            term if term.robust is None else term.reweighted(sines.jet(theta, term.points, jet))
            for term, jet in zip(placed, known, strict=True)
        ]
        return cls(sines, factor, target, reweighted, theta, known)

    def free(self) -> Tensor:
        """Return the amplitudes at which the problem was made."""
        return self.theta

    def whole(self, free: Tensor) -> Tensor:
        """Return the amplitudes."""
        return free

    def residual(self, free: Tensor) -> Tensor:
        """Return r, of shape (M,), where M depends on how many one-sided residuals are active."""
        return self._residual(free, self._linearised(free))

    def linearise(self, free: Tensor) -> tuple[DenseJacobian, Tensor]:
        """Return J, of shape (M, p), and r."""
        linearised = list(self._linearised(free))
        rows = [self.sines.rows(term.points, linear, term.scale) for term, linear in linearised]
        return DenseJacobian(torch.cat([self.factor.T, *rows])), self._residual(free, linearised)

    def _residual(self, free: Tensor, linearised: Iterable[tuple[PenaltyTerm, Linearised]]) -> Tensor:
        parts = [(term.scale * linear.residual).T.flatten() for term, linear in linearised]
        return torch.cat([self.factor.T @ free - self.target, *parts])

    def _linearised(self, free: Tensor) -> Iterator[tuple[PenaltyTerm, Linearised]]:
        for term, known in zip(self.terms, self.known, strict=True):
            if term.fixed_value is None:
                yield term, term.linearised(self.sines.jet(free, term.points, known))
            else:
                yield term.active_rows(self.sines.value(free, term.points, known))


def minimise_penalised(
    sines: SineSum,
    factor: Tensor,
    right: Tensor,
    terms: Sequence[PenaltyTerm],
    amplitudes: Tensor,
    steps: int,
    *,
    parameters: PenaltyFitParameters = PenaltyFitParameters(),
) -> Tensor:
    """Return amplitudes, of shape (p,), that minimise the linear part and the penalty terms.

    Parameters
    ----------
    sines : SineSum
    factor, right : L and b of the linear part's normal equations L L^T a = b
    terms : the penalties
    amplitudes : initial ones, of shape (p,)
    steps : of Gauss-Newton, at most
    """
    target = torch.linalg.solve_triangular(factor, right[:, None], upper=False)[:, 0]

    def posed(number: int, theta: Tensor) -> PenaltyProblem:
        del number
        return PenaltyProblem.at(sines, factor, target, terms, theta)

    # A step ignores that the surface moves away from its points; the loss that counts is that at the new surface.
    method = GaussNewton(GainRatioDamping(initial_damping=1e-9, metric=identity))
    stop = StopRule(
        steps, parameters.least_decrease_share, patience=steps + 1, held_out_patience=parameters.patience_steps
    )
    solution = method.run(posed, amplitudes, stop, held_out=lambda theta: loss_of(posed(0, theta), theta))
    if solution.interrupted:
        raise KeyboardInterrupt
    return solution.theta

"""What a fit asks of its surface beside its data: to be smooth, minimal where there is no data, or developable.

    smooth   strain=W      W / 2 mean of k1^2 + k2^2 over the surface
    fill     minimal       W / 2 mean of (k1 + k2)^2, only where the surface is far from all points
    prior    developable   W / 2 mean of (k1 k2)^2, where it is no crease

each beside half the mean square distance of the points from the surface. All lengths are in radii of the scan. A bump
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
    """One thing that is asked of the surface.

    Parameters
    ----------
    name : as it was asked for
    residual : of curvature, in radii
    weight : W
    holes : whether it is asked for only where the surface is far from all points
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
    """Return what was asked for, each None or a text such as ``"strain=1e-4"``, ``"minimal"`` or ``"developable"``.

    Raises
    ------
    UsageError
        When a text asks for something else, or a weight is no positive number.
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
    """Return the weight in ``known=weight``, or the default where it may be left out and is."""
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


# Sine features, solved for data already, bent to what regularisers ask of the surface that they make.
#
# The data, the volume and the prior are linear in the amplitudes a, so that all of their rows together are as good as
# the few of one triangular matrix, |L^T a - y|^2 up to a constant. The residuals of curvature are not linear, and ask
# for a few steps of Gauss-Newton, each at points of the surface as it is then; the best of these surfaces is taken.
#
# With phases z_j = w_j . x + p_j a feature has the gradient cos z_j w_j and the second derivatives -sin z_j w_j w_j^T,
# and so a residual linearised to dr = c df + v . d(grad f) + M : d(Hess f) the row
#
#     c sin z_j + (v . w_j) cos z_j - (w_j . M w_j) sin z_j.


@dataclass(frozen=True)
class PenaltyTerm:
    """A residual of curvature that is asked of points of the surface, or one of the value, at points that stay.

    Parameters
    ----------
    residual : SecondOrder
    points : of shape (N, 3), near the surface, onto which they are brought
    scale : factor of each point's rows, of shape (N, 1)
    robust : size of the residual from which on it hardly counts, or None
    target : of each point, of shape (N,), or None
    still : value of the known function at each point, of shape (N,), where the points are to stay; else None
    """

    residual: SecondOrder
    points: Tensor
    scale: Tensor
    robust: float | None = None
    target: Tensor | None = None
    still: Tensor | None = None

    def linearised(self, jet: Jet) -> Linearised:
        """Return the residuals at the points' jet."""
        return self.residual(*jet, self.target)

    def active_rows(self, jet: Jet) -> tuple[PenaltyTerm, Linearised]:
        """Return those of the points that stay whose residuals of the value are not zero, and these, at the jet."""
        linear = self.linearised(jet)
        assert linear.by_value is not None, "residuals of the value"
        rows = linear.residual.ne(0).any(dim=1)
        kept = replace(self, points=self.points[rows], scale=self.scale[rows])
        return kept, Linearised(linear.residual[rows], linear.by_value[rows], None)

    def reweighted(self, jet: Jet) -> PenaltyTerm:
        """Return a robust wish with what its residuals count, at the points' jet, in its scale."""
        assert self.robust is not None, "what is not robust counts alike"
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
    """Return values, of shape (N,), as a jet whose derivatives nobody asks for."""
    count = len(value)
    return value, value.new_zeros(1, 3).expand(count, 3), value.new_zeros(1, 3, 3).expand(count, 3, 3)


@dataclass(frozen=True)
class PenaltyProblem:
    """The least-squares problem of one step: L^T a = y, and the wishes at their points, of which none moves.

    Parameters
    ----------
    sines : Sines
    factor, target : L, of shape (p, p), and y, of shape (p,)
    wishes : with points on the surface, and what is robust of them in their scales
    theta : amplitudes where it was posed
    known : jets of the known function at each wish's points
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
        """Pose the problem of the surface that the amplitudes theta make."""
        placed = [
            replace(term, points=sines.on_surface(theta, term.points)) if term.still is None else term for term in terms
        ]
        known = [sines.known(term.points) if term.still is None else constant_jet(term.still) for term in placed]
        reweighted = [
            term if term.robust is None else term.reweighted(sines.jet(theta, term.points, jet))
            for term, jet in zip(placed, known, strict=True)
        ]
        return cls(sines, factor, target, reweighted, theta, known)

    def free(self) -> Tensor:
        """Return the amplitudes where it was posed."""
        return self.theta

    def whole(self, free: Tensor) -> Tensor:
        """Return the amplitudes."""
        return free

    def residual(self, free: Tensor) -> Tensor:
        """Return r, of shape (M,), without values that are as they should be; M depends on how many are."""
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
            if term.still is None:
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
    """Return amplitudes, of shape (p,), that heed the wishes beside the linear part.

    Parameters
    ----------
    sines : Sines
    factor, right : L and b of the linear part's normal equations L L^T a = b
    wishes : what is asked of the surface
    amplitudes : to begin with, of shape (p,)
    steps : of Gauss-Newton, at most
    """
    target = torch.linalg.solve_triangular(factor, right[:, None], upper=False)[:, 0]

    def posed(number: int, theta: Tensor) -> PenaltyProblem:
        del number
        return PenaltyProblem.at(sines, factor, target, terms, theta)

    # A step knows nothing of how the surface moves away from its points; what counts is how it is where it has gone.
    method = GaussNewton(GainRatioDamping(initial_damping=1e-9, metric=identity))
    stop = StopRule(
        steps, parameters.least_decrease_share, patience=steps + 1, held_out_patience=parameters.patience_steps
    )
    return method.run(posed, amplitudes, stop, held_out=lambda theta: loss_of(posed(0, theta), theta)).theta

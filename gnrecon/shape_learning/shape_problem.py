"""A shape-learning problem: terms on the zero level set of a network, with their points, weights and a start."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gnrecon.field import TANH, Network
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import Box, kd_tree_order
from gnrecon.least_squares import Iterative, LinearSolver, NeighbourSums, identity
from gnrecon.level_set import KnownSurface, LevelSet, sample_surface
from gnrecon.optim import GainRatioDamping, Search
from gnrecon.residuals import Residual, SecondOrder
from gnrecon.runtime.errors import FitError
from gnrecon.shape_learning.frozen_points import FrozenProblem, FrozenTerm
from gnrecon.shape_learning.learning_parameters import ShapeLearningParameters


def paper_network() -> Network:
    """Return the network of the paper's minimal and developable surfaces."""
    return Network((32, 32), TANH)


def cautious_damping() -> GainRatioDamping:
    """Return a step control whose initial damping is large enough not to tear the surface in the first steps."""
    return GainRatioDamping(initial_damping=1.0, metric=identity)


def neighbour_sum_cg(*, energy: float = 0.1, least_cosine: float = 0.5, rounding: float = 0.05) -> LinearSolver:
    """Return conjugate gradients preconditioned by sums of neighbouring rows, set up again at each step.

    The rows of points on a smooth surface, in the order of `sample_surface`, change little from one to the next, and
    few eigenvalues of J^T J are above the damping. Where rows change, J^T J itself is the preconditioner.

    Parameters
    ----------
    energy : relative error of a step in the norm of the damped matrix; Gauss-Newton's model is not more accurate
    least_cosine : least mean cosine of rows that are summed. Low, because the first dampings are large, so that a rough
        preconditioner is enough; later all points are on the surface, and their rows are similar
    rounding : relative change of a step that products with J in float32 may cause, in the same norm
    """
    return Iterative("cg", NeighbourSums(least_cosine), energy=energy, reuse=False, rounding=rounding)


Start = Callable[[Tensor], Tensor]
"""From points, of shape (N, 3), to values, of shape (N,): about a distance to a surface similar to the wanted one."""


@dataclass(frozen=True)
class Pretraining:
    """The fit of the network before that of a problem's own terms.

    Parameters
    ----------
    terms : constraints whose points do not depend on the field, the values of a start among them
    steps : most steps
    tolerance, patience : of `gnrecon.optim.StopRule`
    """

    terms: tuple[Term, ...]
    steps: int
    tolerance: float = 0.02
    patience: int = 3


@dataclass(frozen=True)
class ShapeProblem:
    """The constraints on a surface, with the network and the methods to solve them.

    Parameters
    ----------
    name : str
    terms : the constraints
    box : the domain of the samplers of volume and surface
    start : the function that the network is fitted to before the constraints
    network : Network
    known : the exact solution, if it is known, to measure the error
    shown : the part of the box that is meshed, by default all of it
    search : step control of Gauss-Newton
    solver : creates Gauss-Newton's linear solver, which may have a state
    stored : precision of the Jacobian's rows; float32 is faster, but limits the accuracy of undamped steps
    pretraining : the fit of the start, by default of its values in the box
    """

    name: str
    terms: tuple[Term, ...]
    box: Box
    start: Start
    network: Network = field(default_factory=paper_network)
    known: KnownSurface | None = None
    shown: Box | None = None
    search: Search = field(default_factory=cautious_damping)
    solver: Callable[[], LinearSolver] = neighbour_sum_cg
    stored: torch.dtype = torch.float64
    pretraining: Pretraining | None = None

    def level_set(self, theta: Tensor) -> LevelSet:
        """Return the zero level of the network with parameters theta, of shape (p,)."""
        rounded = theta.float()
        return LevelSet(
            lambda x: self.network.value(theta, x),
            lambda x: self.network.value_and_gradient(theta, x),
            self.box,
            roughly=lambda x: self.network.value(rounded, x.float()).to(x),
        )

    def freeze(
        self, step: int, theta: Tensor, rng: np.random.Generator, terms: tuple[Term, ...] | None = None
    ) -> FrozenProblem:
        """Draw the points of a step, of some terms or by default all; terms without weight are omitted.

        Raises
        ------
        FitError
            When a term needs points of the surface and there is none.
        """
        state = StepState(step, self.level_set(theta), rng)
        weighed = [(term, term.weight_at(step)) for term in (self.terms if terms is None else terms)]
        return self._frozen(theta, [(term, term.sampler(state), weight) for term, weight in weighed if weight > 0.0])

    def _frozen(self, theta: Tensor, drawn: list[tuple[Term, SampledPoints, float]]) -> FrozenProblem:
        terms = [
            FrozenTerm(term.name, term.residual, points.points, points.target, weight * points.share, points.on_surface)
            for term, points, weight in drawn
        ]
        return FrozenProblem(self.network, terms, theta, self.stored)


def cube(half: float) -> Box:
    """Return the box from -half to half along each axis."""
    return Box(np.full(3, -half), np.full(3, half))


def z_plane(x: Tensor) -> Tensor:
    """Return the distance to the plane z = 0 of points of shape (N, 3), of shape (N,): a start for single sheets."""
    return x[:, 2]


def z_cylinder(radius: float = 1.0) -> Start:
    """Return (x^2 + y^2 - radius^2) / (2 radius), which is about the distance to a cylinder: a start for tubes."""
    return lambda x: (x[:, :2].square().sum(1) - radius**2) / (2 * radius)


def circle(radius: float, height: float, count: int = 1000) -> Float:
    """Return points of the circle around the z axis at a height, of shape (count, 3)."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=1)


def plane_through(points: Float) -> Start:
    """Return the signed distance to the best-fit plane of points, (N, 3): a start for a sheet bounded by a curve."""
    center = points.mean(axis=0)
    normal = torch.as_tensor(np.linalg.svd(points - center)[2][2])
    middle = torch.as_tensor(center)
    return lambda x: (x - middle) @ normal


# The terms of a shape-learning problem: a residual, a sampler of its points, and a weight.
#
# A sampler is called at each step with the current field, because the points of a moving surface, and those that join
# components, change with it. A weight may change from step to step. The loss that a run reports has other weights, by
# default the last ones of the terms.


@dataclass(frozen=True)
class StepState:
    """The input of a sampler: the number of the step, from 1, the current zero level set, and random numbers."""

    step: int
    level_set: LevelSet
    rng: np.random.Generator

    @property
    def measuring(self) -> bool:
        """Whether the points are for a measurement and not for a step."""
        return self.step == ShapeLearningParameters.measurement_step


@dataclass(frozen=True)
class SampledPoints:
    """Points of a step.

    Parameters
    ----------
    points : of shape (N, 3)
    target : of shape (N,) or (N, 3), or None
    on_surface : whether they belong to the surface and move with it
    share : fraction of the drawn points that these are; the others have no residual and are not evaluated
    """

    points: Tensor
    target: Tensor | None = None
    on_surface: bool = False
    share: float = 1.0


Sampler = Callable[[StepState], SampledPoints]

Weight = Callable[[int], float]
"""Returns the weight of a term at a step, by its number from 1."""


@dataclass(frozen=True)
class Term:
    """One constraint.

    It contributes  weight / (2 N) sum_i |r_i|^2  over the N drawn points to the loss.

    Parameters
    ----------
    name : str
    residual : of `gnrecon.residuals`, of first or second order
    sampler : returns its points at each step
    weight : a number, or one for each step
    reported : weight in the loss that a run reports, by default the last weight
    """

    name: str
    residual: Residual | SecondOrder
    sampler: Sampler
    weight: float | Weight = 1.0
    reported: float | None = None

    def weight_at(self, step: int) -> float:
        """Return the weight at a step, or that in the reported loss at the step number of measurements."""
        if step == ShapeLearningParameters.measurement_step and self.reported is not None:
            return self.reported
        return self.weight(step) if callable(self.weight) else self.weight


Count = Callable[[int], int]
"""Returns the number of points at a step, by its number from 1."""


def at_points(points: npt.ArrayLike, targets: npt.ArrayLike | None = None, count: int | Count | None = None) -> Sampler:
    """Return a sampler of known points, of shape (N, 3), with targets or without; `count` of them at each step.

    Without a count, all are used each time.
    """
    known = torch.as_tensor(np.asarray(points, dtype=np.float64))
    values = None if targets is None else torch.as_tensor(np.asarray(targets, dtype=np.float64))

    def draw(state: StepState) -> SampledPoints:
        wanted = count(state.step) if callable(count) else count
        if wanted is None or wanted >= len(known):
            return SampledPoints(known, values)
        rows = torch.as_tensor(np.sort(state.rng.permutation(len(known))[:wanted]))
        return SampledPoints(known[rows], None if values is None else values[rows])

    return draw


def in_box(count: int, box: Box | None = None) -> Sampler:
    """Return a sampler of uniform points in a box, by default the problem's, with neighbours adjacent."""

    def draw(state: StepState) -> SampledPoints:
        points = (box or state.level_set.box).sample(count, state.rng)
        return SampledPoints(torch.as_tensor(points[kd_tree_order(points)]))

    return draw


def on_surface(count: int, nodes: int = 30_000) -> Sampler:
    """Return a sampler of about `count` points of the zero level in the problem's box, uniform by area.

    The sampler raises `FitError` if there are none. `nodes` is the number of evaluations of the search at each step,
    see `gnrecon.level_set.sample_surface`.
    """

    def draw(state: StepState) -> SampledPoints:
        sample = sample_surface(state.level_set, count, state.rng, nodes, sweeps=0)
        if not len(sample):
            raise FitError(f"At step {state.step} the field has no zero level in the problem's box any more.")
        return SampledPoints(sample.points, on_surface=True)

    return draw


def growing(first: int, factor: float, many: int, slowly: float, *, most_log_growth: float = 20.0) -> Count:
    """Return a number of points that grows by a factor per step, and by a smaller one above `many` points.

    With fewer points a step is faster but overfits them more, which matters more near the end of a run. A measurement
    takes all points. `most_log_growth` is the logarithm of the largest growth, beyond the points of any scan.
    """
    quick = math.log(many / first) / math.log(factor)

    def at(step: int) -> int:
        if step == ShapeLearningParameters.measurement_step:
            return step
        growth = math.log(factor) * min(step - 1, quick) + math.log(slowly) * max(0.0, step - 1 - quick)
        return round(first * math.exp(min(growth, most_log_growth)))

    return at


def rising(weight: float, hold: int, factor: float, most: float) -> Weight:
    """Return a weight that is constant for `hold` steps, then grows by a factor per step up to `most`."""
    growth = int(math.log(most / weight) / math.log(factor)) + 1

    def at(step: int) -> float:
        return min(most, weight * factor ** min(max(0, step - hold), growth))

    return at


def falling(weight: float, factor: float, least: float) -> Weight:
    """Return a weight that decreases by a factor per step from the first step on, down to `least`."""
    steps = int(math.log(least / weight) / math.log(factor)) + 1
    return lambda step: max(least, weight * factor ** min(step, steps))


def fading(weight: float, hold: int, factor: float, least: float = 1e-5) -> Weight:
    """Return a weight that is constant for `hold` steps, then decreases by a factor per step; zero below `least`."""

    def at(step: int) -> float:
        # Capped, because larger powers of the factor underflow.
        faded = weight * factor ** min(max(0, step - hold), 10_000)
        return faded if faded >= least else 0.0

    return at

"""A shape-learning problem: constraints on a network's zero level, where they hold, and what it begins as."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

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

PAPERS = Network((32, 32), TANH)
"""The network of the paper's minimal and developable surfaces."""

CAUTIOUS = GainRatioDamping(initial_damping=1.0, metric=identity)
"""Step control that does not tear a surface in its first steps."""

ENERGY = 0.1
"""Error of a step in the norm of the damped matrix: Gauss-Newton's model is no more exact than that."""

ALIKE = 0.5
"""Least mean cosine of rows whose sums stand for them. The first steps' dampings are large, and what is not much alike
serves them too; later ones have points on the surface alone, which are."""

ROUNDING = 0.05
"""What products with J in float32 may move a step by, in the same norm."""


def by_neighbours() -> LinearSolver:
    """Return conjugate gradients that sums of neighbouring rows precondition, afresh at each step.

    The rows of points on a smooth surface, in the order in which `sample_surface` gives them, change little from one
    to the next, and few of J^T J's eigenvalues are above the damping. Where rows do change, J^T J itself is taken.
    """
    return Iterative("cg", NeighbourSums(ALIKE), energy=ENERGY, reuse=False, rounding=ROUNDING)


Start = Callable[[Tensor], Tensor]
"""From points, of shape (N, 3), to values, of shape (N,): about a distance to a surface much like the wanted one."""


@dataclass(frozen=True)
class Pretraining:
    """What a network is fitted to before a problem's own terms.

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
    """What is asked of a surface.

    Parameters
    ----------
    name : str
    terms : the constraints
    box : where the surface lives; samplers of the volume and of the surface keep to it
    start : what the network is fitted to before the constraints are
    network : Network
    known : the solution, where it is known, to measure against
    shown : the part of the box that is meshed, by default all of it
    search : step control of Gauss-Newton
    solver : makes Gauss-Newton's linear solver, which may keep what it knows from step to step
    stored : precision of the Jacobian's rows; products of float32 are faster, and end what undamped steps can reach
    pretraining : how the network becomes the start, by default from its values in the box
    """

    name: str
    terms: tuple[Term, ...]
    box: Box
    start: Start
    network: Network = PAPERS
    known: KnownSurface | None = None
    shown: Box | None = None
    search: Search = CAUTIOUS
    solver: Callable[[], LinearSolver] = by_neighbours
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
        """Draw the points of a step, of some terms or by default all; what weighs nothing at it is left out.

        Raises
        ------
        FitError
            When a term needs points of the surface and there is none.
        """
        moment = Moment(step, self.level_set(theta), rng)
        weighed = [(term, term.weight_at(step)) for term in (self.terms if terms is None else terms)]
        return self._frozen(theta, [(term, term.sampler(moment), weight) for term, weight in weighed if weight > 0.0])

    def _frozen(self, theta: Tensor, drawn: list[tuple[Term, Drawn, float]]) -> FrozenProblem:
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
    """Return the signed distance to the plane that fits points of shape (N, 3) best: a start for a sheet in a curve."""
    center = points.mean(axis=0)
    normal = torch.as_tensor(np.linalg.svd(points - center)[2][2])
    middle = torch.as_tensor(center)
    return lambda x: (x - middle) @ normal


LAST = 10**9
"""The number of a step that is never reached: weights have ended there."""

MOST_GROWTH = 20.0
"""Logarithm of the most by which a number of points grows: by then it is all points of any scan."""

NODES = 30_000
"""Evaluations that the search for a surface costs at each step; see `gnrecon.level_set.sample_surface`."""


# The terms of a shape-learning problem: a residual, where its points come from at each step, and its weight.
#
# A sampler is called afresh at each step with what the field is then, because the points of a moving surface, or those
# that join components, change with it. A weight may change from step to step. The loss that a run reports has weights
# of its own, by default those that the terms end with.


@dataclass(frozen=True)
class Moment:
    """When a sampler is asked: the step's number, from 1, the field's zero level then, and what draws."""

    step: int
    level_set: LevelSet
    rng: np.random.Generator


@dataclass(frozen=True)
class Drawn:
    """Points of a step.

    Parameters
    ----------
    points : of shape (N, 3)
    target : of shape (N,) or (N, 3), or None
    on_surface : whether they belong to the surface and move with it
    share : of all points that were drawn; the others have no residual, and need not be evaluated
    """

    points: Tensor
    target: Tensor | None = None
    on_surface: bool = False
    share: float = 1.0


Sampler = Callable[[Moment], Drawn]

Weight = Callable[[int], float]
"""Gives a term's weight at a step of a number, from 1."""


@dataclass(frozen=True)
class Term:
    """One constraint.

    Its share of the loss is  weight / (2 N) sum_i |r_i|^2  over the N points that are drawn.

    Parameters
    ----------
    name : str
    residual : of `gnrecon.residuals`, of first or second order
    sampler : gives its points at each step
    weight : a number, or one for each step
    reported : weight in the loss that a run reports, by default that which the weight ends with
    """

    name: str
    residual: Residual | SecondOrder
    sampler: Sampler
    weight: float | Weight = 1.0
    reported: float | None = None

    def weight_at(self, step: int) -> float:
        """Return the weight at a step, or that in the reported loss at `LAST`."""
        if step == LAST and self.reported is not None:
            return self.reported
        return self.weight(step) if callable(self.weight) else self.weight


Count = Callable[[int], int]
"""Gives the number of points at a step of a number, from 1."""


def at_points(points: npt.ArrayLike, targets: npt.ArrayLike | None = None, count: int | Count | None = None) -> Sampler:
    """Return a sampler of known points, of shape (N, 3), with targets or without; `count` of them at each step.

    Without a count, all are used each time.
    """
    known = torch.as_tensor(np.asarray(points, dtype=np.float64))
    values = None if targets is None else torch.as_tensor(np.asarray(targets, dtype=np.float64))

    def draw(moment: Moment) -> Drawn:
        wanted = count(moment.step) if callable(count) else count
        if wanted is None or wanted >= len(known):
            return Drawn(known, values)
        rows = torch.as_tensor(np.sort(moment.rng.permutation(len(known))[:wanted]))
        return Drawn(known[rows], None if values is None else values[rows])

    return draw


def in_box(count: int, box: Box | None = None) -> Sampler:
    """Return a sampler of uniform points in a box, by default the problem's, neighbours one after the other."""

    def draw(moment: Moment) -> Drawn:
        points = (box or moment.level_set.box).sample(count, moment.rng)
        return Drawn(torch.as_tensor(points[kd_tree_order(points)]))

    return draw


def on_surface(count: int, nodes: int = NODES) -> Sampler:
    """Return a sampler of about `count` points of the zero level in the problem's box, uniform by area.

    It raises `FitError` where there is none.
    """

    def draw(moment: Moment) -> Drawn:
        sample = sample_surface(moment.level_set, count, moment.rng, nodes, sweeps=0)
        if not len(sample):
            raise FitError(f"At step {moment.step} the field has no zero level in the problem's box any more.")
        return Drawn(sample.points, on_surface=True)

    return draw


def growing(first: int, factor: float, many: int, slowly: float) -> Count:
    """Return a number of points that grows by a factor a step, and by a smaller one once there are many.

    The fewer points, the sooner a step is done, and the farther what fits them is from what fits all: that matters the
    more, the less is left to gain. A measurement takes all points.
    """
    quick = math.log(many / first) / math.log(factor)

    def at(step: int) -> int:
        if step == LAST:
            return step
        growth = math.log(factor) * min(step - 1, quick) + math.log(slowly) * max(0.0, step - 1 - quick)
        return round(first * math.exp(min(growth, MOST_GROWTH)))

    return at


def rising(weight: float, hold: int, factor: float, most: float) -> Weight:
    """Return a weight that holds for some steps, then grows by a factor a step, up to the most."""
    growth = int(math.log(most / weight) / math.log(factor)) + 1

    def at(step: int) -> float:
        return min(most, weight * factor ** min(max(0, step - hold), growth))

    return at


def falling(weight: float, factor: float, least: float) -> Weight:
    """Return a weight that shrinks by a factor from the first step on, down to the least."""
    steps = int(math.log(least / weight) / math.log(factor)) + 1
    return lambda step: max(least, weight * factor ** min(step, steps))


def fading(weight: float, hold: int, factor: float, least: float = 1e-5) -> Weight:
    """Return a weight that holds for some steps, then shrinks by a factor a step, and is zero below `least`."""

    def at(step: int) -> float:
        # Capped, because a large power of the factor underflows anyhow.
        faded = weight * factor ** min(max(0, step - hold), 10_000)
        return faded if faded >= least else 0.0

    return at

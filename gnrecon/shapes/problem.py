"""A shape-learning problem: constraints on a network's zero level, where they hold, and what it begins as."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gnrecon.field import TANH, Network
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import Box
from gnrecon.least_squares import Iterative, LinearSolver, Neighbours, identity
from gnrecon.level_set import KnownSurface, LevelSet
from gnrecon.optim import GainRatioDamping, Search
from gnrecon.shapes.frozen import FrozenProblem, FrozenTerm
from gnrecon.shapes.term import Drawn, Moment, Term

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
    return Iterative("cg", Neighbours(ALIKE), energy=ENERGY, reuse=False, rounding=ROUNDING)


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

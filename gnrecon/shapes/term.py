"""The terms of a shape-learning problem: a residual, where its points come from at each step, and its weight.

A sampler is called afresh at each step with what the field is then, because the points of a moving surface, or those
that join components, change with it. A weight may change from step to step. The loss that a run reports has weights
of its own, by default those that the terms end with.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from gnrecon.geometry.signed_distance import Box, halved
from gnrecon.level_set import LevelSet, sample_surface
from gnrecon.residuals import Residual, SecondOrder
from gnrecon.runtime.errors import FitError

LAST = 10**9
"""The number of a step that is never reached: weights have ended there."""

MOST_GROWTH = 20.0
"""Logarithm of the most by which a number of points grows: by then it is all points of any scan."""

NODES = 30_000
"""Evaluations that the search for a surface costs at each step; see `gnrecon.level_set.sample_surface`."""


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
        return Drawn(torch.as_tensor(points[halved(points)]))

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

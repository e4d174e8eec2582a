"""What the network begins as, by Gauss-Newton: the start's values at fresh uniform points, or what a problem says.

The paper pretrains on a shape of the wanted topology for thousands of steps; here a few dozen do. Their damping is the
same for all parameters: in units of J^T J's diagonal, saturated units could be moved any distance at no cost.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gnrecon.least_squares import identity
from gnrecon.optim import GainRatioDamping, GaussNewton, StopRule
from gnrecon.residuals import signed_distance
from gnrecon.shapes.frozen import FrozenProblem
from gnrecon.shapes.problem import Pretraining, ShapeProblem
from gnrecon.shapes.term import Drawn, Moment, Term

POINTS, STEPS = 1500, 15


def pretrained(problem: ShapeProblem, seed: int, rng: np.random.Generator, seconds: float | None = None) -> Tensor:
    """Return parameters, of shape (p,), with which the network is the problem's start; within `seconds`, if given."""
    what = problem.pretraining or _on_values(problem)

    def freeze(number: int, theta: Tensor) -> FrozenProblem:
        return problem.freeze(number, theta, rng, what.terms)

    theta = problem.network.initial(torch.Generator().manual_seed(seed))
    method = GaussNewton(GainRatioDamping(initial_damping=1e-2, metric=identity))
    return method.run(freeze, theta, StopRule(what.steps, what.tolerance, what.patience, seconds)).theta


def _on_values(problem: ShapeProblem) -> Pretraining:
    """Return the fit of the start's values in the problem's box."""

    def draw(moment: Moment) -> Drawn:
        points = torch.as_tensor(problem.box.sample(POINTS, moment.rng))
        return Drawn(points, problem.start(points))

    return Pretraining((Term("start", signed_distance, draw),), STEPS)

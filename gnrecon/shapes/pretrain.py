"""What the network begins as: fitted to a known function in the box, by Gauss-Newton.

The paper pretrains on a shape of the wanted topology; here the fit is of values at fresh uniform points and takes a
few dozen steps. Its damping is the same for all parameters: in units of J^T J's diagonal, saturated units could be
moved any distance at no cost.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gnrecon.linalg import identity
from gnrecon.optim import GainRatioDamping, GaussNewton, StopRule
from gnrecon.residuals import signed_distance
from gnrecon.shapes.frozen import FrozenProblem, FrozenTerm
from gnrecon.shapes.problem import ShapeProblem

POINTS, STEPS, TOLERANCE = 1500, 15, 0.02


def pretrained(problem: ShapeProblem, seed: int, rng: np.random.Generator) -> Tensor:
    """Return parameters, of shape (p,), with which the network is the problem's start."""

    def freeze(number: int, theta: Tensor) -> FrozenProblem:
        del number
        points = torch.as_tensor(problem.box.sample(POINTS, rng))
        return FrozenProblem(
            problem.network, [FrozenTerm("start", signed_distance, points, problem.start(points), 1.0)], theta
        )

    theta = problem.network.initial(torch.Generator().manual_seed(seed))
    method = GaussNewton(GainRatioDamping(initial_damping=1e-2, metric=identity))
    return method.run(freeze, theta, StopRule(STEPS, TOLERANCE, patience=3)).theta

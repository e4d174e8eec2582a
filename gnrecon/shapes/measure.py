"""How good a surface is, on points of its own that no step has seen."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from torch import Tensor

from gnrecon.level_set import chamfer_divergence
from gnrecon.runtime.errors import FitError
from gnrecon.shapes.problem import ShapeProblem
from gnrecon.shapes.term import LAST

DRAWS = 2
"""Times that each term's points are drawn for the loss; their mean counts."""


@dataclass(frozen=True)
class Measurement:
    """A surface at a step.

    Parameters
    ----------
    step : its number; 0 is the start
    seconds : since the run began, measuring included
    loss : at fresh points, with the terms' reported weights; infinite where there is no surface
    shares : of the loss, by the terms' names
    chamfer : root mean square distance from the known solution to the surface, by projection: the paper's figure
    chamfer_back : that from the surface to the solution
    """

    step: int
    seconds: float
    loss: float
    shares: dict[str, float]
    chamfer: float | None
    chamfer_back: float | None

    def as_dict(self) -> dict[str, Any]:
        """All of it by name."""
        return asdict(self)


def measure(problem: ShapeProblem, theta: Tensor, step: int, seconds: float, seed: int) -> Measurement:
    """Measure the surface of parameters theta, of shape (p,); the points depend on the seed alone."""
    chamfer = None
    if problem.known is not None:
        chamfer = chamfer_divergence(problem.level_set(theta), problem.known, np.random.default_rng(seed))
    shares = _shares(problem, theta, seed)
    return Measurement(
        step,
        seconds,
        sum(shares.values()) if shares else float("inf"),
        shares,
        None if chamfer is None else chamfer.from_known,
        None if chamfer is None else chamfer.to_known,
    )


def _shares(problem: ShapeProblem, theta: Tensor, seed: int) -> dict[str, float]:
    """Return the loss by terms with their last weights, or nothing where there is no surface."""
    rng = np.random.default_rng(seed)
    total: dict[str, float] = {}
    try:
        for _ in range(DRAWS):
            for name, share in problem.freeze(LAST, theta, rng).shares(theta).items():
                total[name] = total.get(name, 0.0) + share / DRAWS
    except FitError:
        return {}
    return total

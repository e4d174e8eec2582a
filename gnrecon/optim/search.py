"""How a search turns a linearisation into a move; the ways to do so are `damping` and `line`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from gnrecon.linalg.metric import Metric
from gnrecon.linalg.system import DampedSystem
from gnrecon.optim.problem import Problem


@dataclass(frozen=True)
class Move:
    """Where a search ended: new free parameters and loss (the old ones when `length` is zero), and the next damping.

    `iterations` counts those of iterative solvers, `failure` says why a solver found no step, if it did not.
    """

    free: Tensor
    loss: float
    damping: float
    gain_ratio: float
    length: float
    next_damping: float
    iterations: int = 0
    failure: str | None = None


class Search(Protocol):
    """Turns a damped system into a move."""

    @property
    def initial_damping(self) -> float:
        """Damping of the first step."""
        ...

    @property
    def metric(self) -> Metric:
        """What the damping is measured in."""
        ...

    def advance(self, problem: Problem, system: DampedSystem, free: Tensor, damping: float) -> Move:
        """Return the move from the free parameters, of shape (k,)."""
        ...

    def describe(self) -> str:
        """Return what this search does, in a sentence."""
        ...

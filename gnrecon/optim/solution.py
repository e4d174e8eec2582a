"""What an optimiser returns: parameters, a sentence that says why it stopped, and its history."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Record:
    """One outer step.

    Parameters
    ----------
    step : its number, from 1
    before, loss : |r|^2 / 2 on the step's own sample of points, before and after the step
    damping : with which the step was solved, or zero for methods that do not damp
    gain_ratio : decrease of the loss over the predicted one, or zero for methods that predict none
    length : multiple of the solved direction that was taken, zero when no trial improved; Adam's learning rate
    held_out : value of the held-out residuals after the step, if there are any
    iterations : of an iterative linear solver
    seconds : since the start of the run
    """

    step: int
    before: float
    loss: float
    damping: float
    gain_ratio: float
    length: float
    held_out: float | None = None
    iterations: int = 0
    seconds: float = 0.0


Callback = Callable[[Record], None]


@dataclass(frozen=True)
class Solution:
    """Parameters theta, of shape (p,), the history, and `status`, the reason for stopping as a sentence.

    `method` is what the optimiser said of itself at the end.
    """

    theta: Tensor
    status: str
    history: tuple[Record, ...]
    interrupted: bool = False
    method: str = ""

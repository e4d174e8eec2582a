"""What an optimiser returns: parameters, a sentence that says why it stopped, and its history."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Record:
    """One outer step.

    `loss` is that of the step's own sample of points after the step, `before` that before it; `length` is the
    multiple of the solved direction that was taken (zero when no trial improved).
    """

    step: int
    before: float
    loss: float
    damping: float
    gain_ratio: float
    length: float


Callback = Callable[[Record], None]


@dataclass(frozen=True)
class Solution:
    """Parameters theta, of shape (p,), the history, and `status`, the reason for stopping as a sentence."""

    theta: Tensor
    status: str
    history: tuple[Record, ...]
    interrupted: bool = False

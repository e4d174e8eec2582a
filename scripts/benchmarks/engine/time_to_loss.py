"""Times until the data loss falls to given values, gnrecon's and the baseline's, in one run.

The baseline's pretraining is not counted; gnrecon's time starts with the points. Evaluating the loss is in neither
time. The baseline ends at the first value or when its budget is spent. In the latter case the ratio of times is a lower
bound: the budget over gnrecon's time. gnrecon's eikonal weight falls (see `our_fit`); a second fit at the paper's
weight, and both sides' eikonal error at their end, show the effect.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from torch import Tensor

from benchmarks.engine.our_fit import OnRecord
from benchmarks.engine.paper_loss import Sample, data_loss, eikonal_error
from benchmarks.engine.plain_baseline import Baseline
from benchmarks.harness.measurement import Clock
from gnrecon.field import Siren

Fit = Callable[[Tensor, Tensor, float, OnRecord], None]
"""Fits points and normals for so many seconds, see `our_fit.our_fit`."""


@dataclass(frozen=True)
class Goal:
    """A scan, the data loss at which both sides' times are compared, and the paper's own final one."""

    case: str
    loss: float
    final: float


GOALS = {"rockerarm": Goal("rockerarm-100", 1.9e-4, 1.9e-5), "bunny_20": Goal("bunny-20", 5.8e-4, 5.8e-5)}


class ReachedError(Exception):
    """The last value was reached; ends a fit."""


@dataclass
class History:
    """Seconds and data losses of a run, in order; it ends at `last`. With the eikonal error at its end."""

    last: float
    seconds: list[float] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    eikonal: float | None = None

    def note(self, seconds: float, loss: float) -> bool:
        """Add a value; return whether it is the last one."""
        self.seconds.append(seconds)
        self.losses.append(loss)
        return loss <= self.last

    def time_to(self, loss: float) -> float | None:
        """Return the seconds until the loss first was at most this, or None."""
        pairs = zip(self.seconds, self.losses, strict=True)
        return next((seconds for seconds, reached in pairs if reached <= loss), None)

    def as_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {"seconds": self.seconds, "losses": self.losses, "eikonal_error": self.eikonal}


def run_baseline(
    sample: Sample, widths: tuple[int, ...], theta: Tensor, budget: float, last: float, *, chunk: int = 512
) -> History:
    """Take baseline steps from theta, of shape (p,), with the Jacobian of `chunk` points at a time.

    They end when the data loss is at most `last`, `budget` seconds have passed, or a step does not lower the loss.
    """
    baseline, network, history = Baseline(widths, sample, chunk), Siren(widths), History(last)
    history.note(0.0, data_loss(network, theta, sample))
    clock, length = Clock(), 1.0
    while clock.seconds < budget and length > 0.0:
        step = baseline.step(theta)
        theta, length = step.theta, step.length
        now = clock.seconds
        with clock.pause():
            done = history.note(now, data_loss(network, theta, sample))
        if done:
            break
    history.eikonal = eikonal_error(network, theta, sample)
    return history


def run_ours(sample: Sample, widths: tuple[int, ...], fit: Fit, seconds: float, last: float) -> History:
    """Fit the sample until the data loss is at most `last`, or so many seconds have passed."""
    network, history = Siren(widths), History(last)

    def on_record(now: float, theta: Tensor) -> None:
        history.eikonal = eikonal_error(network, theta, sample)
        if history.note(now, data_loss(network, theta, sample)):
            raise ReachedError

    with suppress(ReachedError):
        fit(sample.points, sample.normals, seconds, on_record)
    return history


def compare(ours: History, baseline: History, goal: Goal, budget: float) -> dict[str, Any]:
    """Return both times to the goal's loss, their ratio, and gnrecon's time to the final loss; None if not reached.

    A baseline that stopped before its budget was spent is counted with the whole budget.
    """
    our_time, base_time = ours.time_to(goal.loss), baseline.time_to(goal.loss)
    spent = base_time if base_time is not None else max(budget, baseline.seconds[-1])
    return {
        "case": goal.case,
        "loss": goal.loss,
        "final_loss": goal.final,
        "ours_seconds": our_time,
        "baseline_seconds": base_time,
        "budget": budget,
        "ratio": None if our_time is None else spent / our_time,
        "is_lower_bound": base_time is None,
        "ours_seconds_to_final": ours.time_to(goal.final),
        "ours_best": min(ours.losses),
        "baseline_best": min(baseline.losses),
        "ours": ours.as_dict(),
        "baseline": baseline.as_dict(),
    }


def measure_quality(
    goal: Goal, sample: Sample, widths: tuple[int, ...], fit: Callable[..., None], theta: Tensor, times: Sequence[float]
) -> dict[str, Any]:
    """Run both sides on a sample, the baseline from theta, of shape (p,); `times` are gnrecon's seconds and its budget.

    The fit has the arguments of a `Fit`, and `eikonal_falls`.
    """
    seconds, budget = times
    ours = run_ours(sample, widths, fit, seconds, goal.final)
    constrained = run_ours(sample, widths, partial(fit, eikonal_falls=False), seconds, goal.final)
    compared = compare(ours, run_baseline(sample, widths, theta, budget, goal.loss), goal, budget)
    return compared | {"ours_at_full_eikonal_weight": constrained.as_dict()}

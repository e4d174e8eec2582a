"""The time that a running reconstruction still takes: the measured model's, corrected by the run's own pace.

The model of `gnrecon.report.estimate` gives seconds for the fit and for the mesh before the fit begins. As the fit goes
on, the pace is the time that it took over the time that the model expected for the share that is done. What is still to
do counts at the expected pace, because shares do not grow evenly: trials of length scales come first and report little:

    pace = (elapsed + prior) / (share expected + prior)        prior = (1 - share) trust expected
"""

from __future__ import annotations

import time
from collections.abc import Callable


class TimeLeft:
    """Predicts the end of a run from its stages and shares; unknown until `expect` was called.

    Parameters
    ----------
    clock : seconds, never decreasing
    trust : share of the expected time of the fit that counts as measured at the expected pace
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, *, trust: float = 1.0) -> None:
        self._clock, self._trust = clock, trust
        self._fit_seconds = self._mesh_seconds = 0.0
        self._stage, self._share = "", 0.0
        self._fit_began: float | None = None
        self._fit_ended: float | None = None

    def expect(self, fit_seconds: float, mesh_seconds: float) -> None:
        """Take the expected seconds of the fit, and of all that follows it."""
        self._fit_seconds, self._mesh_seconds = fit_seconds, mesh_seconds

    def stage(self, name: str) -> None:
        """Note that a stage begins."""
        if name == "fit":
            self._fit_began, self._share = self._clock(), 0.0
        elif self._stage == "fit":
            self._fit_ended, self._share = self._clock(), 1.0
        self._stage = name

    def advance(self, share: float) -> None:
        """Note the share of the stage that is done, from 0 to 1."""
        if self._stage == "fit":
            self._share = share

    @property
    def seconds(self) -> float | None:
        """Seconds to the end of the run; None before the fit, and where no such run was measured."""
        if self._fit_began is None or not self._fit_seconds > 0:
            return None
        now = self._clock()
        prior = (1 - self._share) * self._trust * self._fit_seconds
        fitted = (now if self._fit_ended is None else self._fit_ended) - self._fit_began
        # A share that stands still while time goes on must not promise an early end.
        pace = (fitted + prior) / (self._share * self._fit_seconds + prior) if self._share else 1.0
        if self._fit_ended is not None:
            return max(pace * self._mesh_seconds - (now - self._fit_ended), 0.0)
        fit = max(pace * self._fit_seconds - fitted, 0.0)
        return fit + pace * self._mesh_seconds

    def describe(self) -> str:
        """Return the time as text, such as ``about 40 s left``, or nothing where it is unknown."""
        left = self.seconds
        if left is None:
            return ""
        if left < 5:
            return "a few seconds left"
        if left < 100:
            return f"about {5 * round(left / 5)} s left"
        return f"about {round(left / 60)} min left" if left < 5400 else f"about {left / 3600:.1f} h left"

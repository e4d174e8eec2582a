"""The global network by Gauss-Newton: a ladder of widths, climbed while validation points gain by it.

A small network is fast and smooth, and finds the shape as a whole. The best of some starts is widened with its
function kept (`field.widening`) and fitted further, until a width gains no more; only to widths with a parameter for
each point, because local fields resolve more of denser scans. Sparse points leave much freedom, so that each start
ends in another field: the mean of those networks that score best together is nearer to the surface, as their
deviations between points are independent. Starts and networks are fitted side by side, each in a thread of its own, and
so is the linear field that they are compared with, their `Rival`.
Source: Caruana et al., *Ensemble Selection from Libraries of Models* (2004), for the choice of members.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from functools import partial
from time import perf_counter
from typing import TypeVar

import numpy as np
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.field.widening import mean_of, widened
from gnrecon.fit.fit_options import FitOptions, network_count, network_starts
from gnrecon.fit.global_network import NetworkTerms
from gnrecon.fit.initialisation import spectral_start
from gnrecon.fit.objective import FieldProblem, Scene, start_terms
from gnrecon.fit.parameters import InitialisationParameters, NetworkLadderParameters
from gnrecon.least_squares import layer_scaled
from gnrecon.least_squares.direct import Cholesky
from gnrecon.optim import Callback, GainRatioDamping, GaussNewton, Record, Solution, StopRule
from gnrecon.runtime.parallel import call_outside, end_if_asked, run_in_threads

_log = logging.getLogger(__name__)

Result = TypeVar("Result")


class Rival:
    """A field that is used instead of a network where it predicts better, fitted side by side with the first network.

    Parameters
    ----------
    fit : fits it and returns its score
    exact_score : a score below leaves a network nothing to gain
    """

    def __init__(self, fit: Callable[[], float], *, exact_score: float = 0.0) -> None:
        self._fit, self._exact_score = fit, exact_score
        self._found: Future[float] = Future()

    @classmethod
    def none(cls) -> Rival:
        """Return one that never predicts better."""
        rival = cls(lambda: np.inf)
        rival.fit()
        return rival

    def fit(self) -> None:
        """Fit it, if that is still to be done, and let those go on who wait for its score."""
        if self._found.done():
            return
        try:
            self._found.set_result(self._fit())
        except BaseException as error:
            self._found.set_exception(error)
            raise

    @property
    def score(self) -> float:
        """Its score, once it is fitted, which another thread does."""
        return self._found.result()

    @property
    def is_exact(self) -> bool:
        """Whether no network is needed."""
        return self.score < self._exact_score


@dataclass
class NetworkLadder:
    """A network that is fitted and widened.

    Parameters
    ----------
    terms : what it is fitted to
    options : of which the device and the residual of the normals are used at the start
    rng : draws the start, new units and the rows of each step
    callback : called with the record of each step
    rival : where it is better than a network, no more of them are fitted
    began : when, a time of `time.perf_counter`
    """

    terms: NetworkTerms
    options: FitOptions
    rng: np.random.Generator
    callback: Callback | None = None
    rival: Rival = dataclass_field(default_factory=Rival.none)
    parameters: NetworkLadderParameters = NetworkLadderParameters()
    began: float = dataclass_field(default_factory=perf_counter, repr=False)

    def __post_init__(self) -> None:
        self.history: list[Record] = []
        self.members: list[tuple[Siren, Tensor]] = []

    def fit(self) -> tuple[Siren, Solution, float] | None:
        """Return the best mean of networks, its parameters with the history of all steps, and its score.

        None where the rival is exact.

        Raises
        ------
        FitError
            When a linear start cannot be solved.
        """
        climbs = self._parts(network_count(len(self.terms.scene.points), parameters=self.parameters))

        def is_last(end: tuple[Siren, Solution, float]) -> bool:
            return end[1].interrupted or end[2] > self.rival.score

        if len(climbs) > 1:
            ends = self._with_rival(NetworkLadder.climb, climbs, is_last)
        else:
            starts = climbs[0]._starts()
            found = self._with_rival(NetworkLadder._first_steps, starts, _is_interrupted)
            ends = [climbs[0].climb(climbs[0]._continued(starts, found))] if found else []
        if not ends:
            return None
        climbs = climbs[: len(ends)]
        self._take_histories(climbs)
        # Each climb has found places of its own where its network was wrong; all count for the choice.
        self.terms = self.terms.joined([climb.terms for climb in climbs])
        networks = [(self.terms.score(field, solution.theta), field, solution.theta) for field, solution, _ in ends]
        networks.sort(key=lambda network: network[0])
        score, field, theta = networks[0]
        members = [(field, theta)]
        for network in (one[1:] for one in networks[1:]):
            tried = mean_of([*members, network])
            if (of_mean := self.terms.score(*tried)) < score:
                members.append(network)
                (field, theta), score = tried, of_mean
        self.members = members
        scores = ", ".join(f"{one[0]:.3g}" for one in networks)
        _log.info("Networks of scores %s; the mean of %d has %.3g disk radii.", scores, len(members), score)
        return field, replace(_last([end[1] for end in ends]), theta=theta, history=tuple(self.history)), score

    def refit(self, scene: Scene) -> tuple[Siren, Tensor]:
        """Return the mean of the networks after some steps on other points, such as all of them, and its parameters.

        Raises
        ------
        KeyboardInterrupt
            On Ctrl-C during the steps; the networks are unchanged.
        """
        parts = zip(self.members, self._parts(len(self.members)), strict=True)
        return mean_of(run_in_threads(lambda part: part[1]._refitted(*part[0], scene), [*parts], self.options.device))

    def climb(self, start: tuple[Siren, Solution] | None = None) -> tuple[Siren, Solution, float]:
        """Return the network of the best score, its parameters, and that score.

        `start` is the network of the first width, where that is fitted.

        Raises
        ------
        FitError
            When the linear start cannot be solved.
        """
        field, solution = start or self._started()
        best = field, solution.theta, self.terms.score(field, solution.theta)
        for width in self._wider():
            if solution.interrupted or best[2] > self.parameters.hopeless_ratio * self.rival.score:
                break
            self.terms = self.terms.with_wrong_signs(field, solution.theta, self.rng)
            frequency = InitialisationParameters.first_layer_frequency
            field, theta = widened(field, solution.theta, width, self.rng, frequency)
            solution = self._fitted(field, theta, self.parameters.steps)
            found, before = self.terms.prediction(field, solution.theta), self.terms.prediction(*best[:2])
            # On noisy points a wider network follows the noise, and seems better on the validation points by chance.
            if not found.is_better_than(before, standard_errors=self.parameters.gain_standard_errors):
                break
            best = field, solution.theta, found.score
        field, theta, score = best
        _log.info("A network has widths %s, after %d steps.", field.widths, len(self.history))
        # Whether and why the steps ended is what the last width's say, whichever width is the best.
        return field, replace(solution, theta=theta), score

    def _with_rival(
        self, work: Callable[[NetworkLadder], Result], parts: Sequence[NetworkLadder], is_last: Callable[[Result], bool]
    ) -> list[Result]:
        """Return the results of the parts, the rival being fitted side by side with the first; none if it is exact."""
        rival = self.rival
        tasks: list[Callable[[], Result | None]] = [rival.fit, *(partial(work, part) for part in parts)]

        def ends(result: Result | None) -> bool:
            return rival.is_exact if result is None else is_last(result)

        found = run_in_threads(lambda task: task(), tasks, self.options.device, ends)
        return [] if rival.is_exact else [result for result in found if result is not None]

    def _started(self) -> tuple[Siren, Solution]:
        """Return the best network of the first width from random starts, after the first steps."""
        starts = self._starts()
        return self._continued(
            starts, run_in_threads(NetworkLadder._first_steps, starts, self.options.device, _is_interrupted)
        )

    @property
    def _start_count(self) -> int:
        return network_starts(len(self.terms.scene.points), parameters=self.parameters)

    def _starts(self) -> list[NetworkLadder]:
        """Return the ladders of the starts, of which one is continued, with few rows."""
        few = replace(self, terms=self.terms.with_rows(self.parameters.first_rows))
        return few._parts(self._start_count)

    def _first_steps(self) -> Solution:
        """Return a random start of the first width after as many steps as each start has."""
        field = self._first_field()
        steps = self.parameters.first_steps if self._start_count == 1 else self.parameters.trial_steps
        terms = partial(start_terms, self.terms.scene, self.options, self.rng)
        theta = spectral_start(field, self.terms.scene, terms, self.rng)
        # The score rises before it falls, as the damping finds its size: no patience ends these steps.
        return self._fitted(field, theta, steps, patience=steps)

    def _continued(self, starts: Sequence[NetworkLadder], found: Sequence[Solution]) -> tuple[Siren, Solution]:
        """Return the best of the starts that were found, after more steps.

        It takes the rest of the first steps, and then as many again, with more rows, as in successive halving
        (Jamieson and Talwalkar, *Non-stochastic Best Arm Identification and Hyperparameter Optimization*, 2016).
        """
        field, steps = self._first_field(), self.parameters.first_steps
        few = starts[0].terms
        self._take_histories(starts[: len(found)])
        best, last = min(found, key=lambda one: self.terms.score(field, one.theta)), _last(found)
        if len(starts) > 1 and not last.interrupted:
            damping = best.history[-1].damping if best.history else None
            rest = steps - self.parameters.trial_steps
            last = best = self._fitted(field, best.theta, rest, terms=few, patience=steps, damping=damping)
        return field, replace(last, theta=best.theta) if last.interrupted else self._fitted(field, best.theta, steps)

    def _first_field(self) -> Siren:
        return Siren(self.parameters.widths[:1] * self.parameters.depth)

    def _parts(self, count: int) -> list[NetworkLadder]:
        """Return ladders of so many networks or starts, each with random numbers and a history of its own."""
        if self.callback is None:
            report = None
        else:
            steps, callback = itertools.count(len(self.history) + 1), self.callback

            def report(record: Record) -> None:
                callback(replace(record, step=next(steps)))

        return [replace(self, terms=replace(self.terms), rng=rng, callback=report) for rng in self.rng.spawn(count)]

    def _take_histories(self, parts: Sequence[NetworkLadder]) -> None:
        """Append the histories of the parts, one after the other, though some ran side by side."""
        for record in itertools.chain.from_iterable(part.history for part in parts):
            self.history.append(replace(record, step=len(self.history) + 1))

    def _wider(self) -> list[int]:
        """Return the further widths with a parameter for each point, and no more of them than rows."""
        points = len(self.terms.scene.points)
        counts = {width: Siren((width,) * self.parameters.depth).layout.count for width in self.parameters.widths[1:]}
        return [width for width, count in counts.items() if points <= count <= 4 * points]

    def _fitted(
        self,
        field: Siren,
        theta: Tensor,
        steps: int,
        *,
        terms: NetworkTerms | None = None,
        patience: int | None = None,
        damping: float | None = None,
    ) -> Solution:
        """Take at most so many steps of Gauss-Newton; return the parameters of the least score.

        Parameters
        ----------
        field, theta : network and its parameters, of shape (p,)
        steps : the most
        terms : what it is fitted to, by default all of it
        patience : steps without a better score
        damping : of the first step, in a run that continues another one
        """
        terms = terms or self.terms
        noise = terms.noise(field, theta)
        residual = 0.0

        def problem_at(number: int, theta: Tensor) -> FieldProblem:
            nonlocal noise
            del number
            end_if_asked()
            noise = noise.followed(terms.noise(field, theta))
            return terms.problem(field, theta, noise, self.rng)

        def score(theta: Tensor) -> float:
            nonlocal residual
            residual = terms.eikonal_rms(field, theta)
            return terms.score(field, theta)

        def record(found: Record) -> None:
            step, seconds = len(self.history) + 1, perf_counter() - self.began
            found = replace(found, step=step, seconds=seconds, eikonal=residual)
            self.history.append(found)
            if self.callback is not None:
                call_outside(partial(self.callback, found))

        patience = self.parameters.patience_steps if patience is None else patience
        stop = StopRule(steps, tolerance=self.parameters.least_gain, patience=steps + 1, held_out_patience=patience)
        return self._optimiser(damping=damping).run(problem_at, theta, stop, record, score)

    def _refitted(self, field: Siren, theta: Tensor, scene: Scene) -> tuple[Siren, Tensor]:
        """Return a network after some steps on other points."""
        terms, noise = replace(self.terms, scene=scene), self.terms.noise(field, theta)

        def problem_at(number: int, theta: Tensor) -> FieldProblem:
            del number
            end_if_asked()
            return terms.problem(field, theta, noise, self.rng)

        steps = StopRule(self.parameters.refit_steps, patience=self.parameters.refit_steps + 1)
        solution = self._optimiser(self.parameters.refit_length).run(problem_at, theta, steps)
        if solution.interrupted:
            raise KeyboardInterrupt
        return field, solution.theta

    def _optimiser(self, length: float = 1.0, damping: float | None = None) -> GaussNewton:
        search = GainRatioDamping(self.parameters.damping, metric=layer_scaled, geodesic=True, length=length)
        return GaussNewton(search, Cholesky(), damping)


def _last(solutions: Sequence[Solution]) -> Solution:
    """Return the solution that was interrupted, if there is one, or the last."""
    return next((one for one in solutions if one.interrupted), solutions[-1])


def _is_interrupted(solution: Solution) -> bool:
    return solution.interrupted

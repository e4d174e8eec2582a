"""The global network by Gauss-Newton: a ladder of widths, climbed while validation points gain by it.

A small network is fast and smooth, and finds the shape as a whole. The best of some starts is widened with its
function kept (`field.widening`) and fitted further, until a width gains no more; only to widths with a parameter for
each point, because local fields resolve more of denser scans. Sparse points leave much freedom, so that each start
ends in another field: the mean of those networks that score best together is nearer to the surface, as their
deviations between points are independent. Starts and networks are fitted side by side, each in a thread of its own.
Source: Caruana et al., *Ensemble Selection from Libraries of Models* (2004), for the choice of members.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from functools import partial
from time import perf_counter

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


@dataclass
class NetworkLadder:
    """A network that is fitted and widened.

    Parameters
    ----------
    terms : what it is fitted to
    options : of which the device and the residual of the normals are used at the start
    rng : draws the start, new units and the rows of each step
    callback : called with the record of each step
    rival : score of the field that is used instead where it is better; then no more networks are fitted
    began : when, a time of `time.perf_counter`
    """

    terms: NetworkTerms
    options: FitOptions
    rng: np.random.Generator
    callback: Callback | None = None
    rival: float = np.inf
    parameters: NetworkLadderParameters = NetworkLadderParameters()
    began: float = dataclass_field(default_factory=perf_counter, repr=False)

    def __post_init__(self) -> None:
        self.history: list[Record] = []
        self.members: list[tuple[Siren, Tensor]] = []

    def fit(self) -> tuple[Siren, Solution, float]:
        """Return the best mean of networks, its parameters with the history of all steps, and its score.

        Raises
        ------
        FitError
            When a linear start cannot be solved.
        """
        climbs = self._parts(network_count(len(self.terms.scene.points), parameters=self.parameters))

        def is_last(end: tuple[Siren, Solution, float]) -> bool:
            return end[1].interrupted or end[2] > self.rival

        ends = run_in_threads(NetworkLadder.climb, climbs, self.options.device, is_last)
        climbs = climbs[: len(ends)]
        self._take_histories(climbs)
        # Each climb has found places of its own where its network was wrong; all count for the choice.
        self.terms = self.terms.joined([climb.terms for climb in climbs])
        found = [(self.terms.score(field, solution.theta), field, solution.theta) for field, solution, _ in ends]
        found.sort(key=lambda network: network[0])
        score, field, theta = found[0]
        members = [(field, theta)]
        for network in (one[1:] for one in found[1:]):
            tried = mean_of([*members, network])
            if (of_mean := self.terms.score(*tried)) < score:
                members.append(network)
                (field, theta), score = tried, of_mean
        self.members = members
        scores = ", ".join(f"{one[0]:.3g}" for one in found)
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

    def climb(self) -> tuple[Siren, Solution, float]:
        """Return the network of the best score, its parameters, and that score.

        Raises
        ------
        FitError
            When the linear start cannot be solved.
        """
        widths = self._widths()
        field, solution = self._started(widths[0])
        best = field, solution.theta, self.terms.score(field, solution.theta)
        for width in widths[1:]:
            if solution.interrupted or best[2] > self.parameters.hopeless_ratio * self.rival:
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

    def _started(self, width: int) -> tuple[Siren, Solution]:
        """Return the best network of one width from random starts, after the first steps.

        The start that is ahead after some of them takes the rest, and then as many again, with more rows, as in
        successive halving (Jamieson and Talwalkar, *Non-stochastic Best Arm Identification and Hyperparameter
        Optimization*, 2016).
        """
        field, steps = Siren((width,) * self.parameters.depth), self.parameters.first_steps
        few = self.terms.with_rows(self.parameters.first_rows)
        count = network_starts(len(self.terms.scene.points), parameters=self.parameters)
        tried = steps if count == 1 else self.parameters.trial_steps

        def first_steps(start: NetworkLadder) -> Solution:
            terms = partial(start_terms, start.terms.scene, start.options, start.rng)
            theta = spectral_start(field, start.terms.scene, terms, start.rng)
            # The score rises before it falls, as the damping finds its size: no patience ends these steps.
            return start._fitted(field, theta, tried, patience=tried)

        starts = replace(self, terms=few)._parts(count)
        found = run_in_threads(first_steps, starts, self.options.device, lambda one: one.interrupted)
        self._take_histories(starts[: len(found)])
        best, last = min(found, key=lambda one: self.terms.score(field, one.theta)), _last(found)
        if tried < steps and not last.interrupted:
            damping = best.history[-1].damping if best.history else None
            last = best = self._fitted(field, best.theta, steps - tried, terms=few, patience=steps, damping=damping)
        return field, replace(last, theta=best.theta) if last.interrupted else self._fitted(field, best.theta, steps)

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

    def _widths(self) -> list[int]:
        """Return the first width, and wider ones with a parameter for each point, and no more of them than rows."""
        (first, *wider), points = self.parameters.widths, len(self.terms.scene.points)
        counts = {width: Siren((width,) * self.parameters.depth).layout.count for width in wider}
        return [first, *(width for width, count in counts.items() if points <= count <= 4 * points)]

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

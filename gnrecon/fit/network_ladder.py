"""The global network by Gauss-Newton: a ladder of widths, climbed while validation points gain by it.

A small network is fast and smooth, and finds the shape as a whole. When its score stops falling, it is widened with its
function kept (`field.widening`), and fitted further. The ladder ends at the width that no longer improves the score.
A step costs a multiple of the fourth power of the width, so that the small networks take most of the steps.

Sparse points leave a network much freedom, so that each start ends in another field. Several networks are then fitted
from different starts, and the mean of those is used that score best together: it is nearer to the surface than its
members, as their deviations between the points are independent.
Source: Caruana et al., *Ensemble Selection from Libraries of Models* (2004), for the choice of members.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.field.widening import mean_of, widened
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.initialisation import spectral_start
from gnrecon.fit.network_terms import Deviations, NetworkTerms
from gnrecon.fit.objective import FieldProblem, Scene, start_terms
from gnrecon.fit.parameters import InitialisationParameters, NetworkLadderParameters
from gnrecon.least_squares import layer_scaled
from gnrecon.least_squares.direct import Cholesky
from gnrecon.optim import Callback, GainRatioDamping, GaussNewton, Record, Solution, StopRule

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
    """

    terms: NetworkTerms
    options: FitOptions
    rng: np.random.Generator
    callback: Callback | None = None
    rival: float = np.inf
    parameters: NetworkLadderParameters = NetworkLadderParameters()

    def __post_init__(self) -> None:
        """Begin without records."""
        self.history: list[Record] = []
        self.members: list[tuple[Siren, Tensor]] = []

    def fit(self) -> tuple[Siren, Solution, float]:
        """Return the best mean of networks, its parameters with the history of all steps, and its score.

        Raises
        ------
        FitError
            When a linear start cannot be solved.
        """
        points = self.parameters.points_per_member / max(len(self.terms.scene.points), 1)
        found = []
        for _ in range(min(max(round(points), 1), self.parameters.most_members)):
            found.append(self.climb())
            if found[-1][1].interrupted or found[-1][2] > self.rival:
                break
        found.sort(key=lambda member: member[2])
        members = [found[0]]
        field, theta, score = found[0][0], found[0][1].theta, found[0][2]
        for member in found[1:]:
            tried = mean_of([(one, solution.theta) for one, solution, _ in (*members, member)])
            of_mean = self.terms.score(*tried)
            if of_mean < score:
                members.append(member)
                (field, theta), score = tried, of_mean
        self.members = [(one, solution.theta) for one, solution, _ in members]
        scores = ", ".join(f"{one[2]:.3g}" for one in found)
        _log.info("Networks of scores %s; the mean of %d has %.3g disk radii.", scores, len(members), score)
        return field, replace(found[-1][1], theta=theta, history=tuple(self.history)), score

    def refit(self, scene: Scene) -> tuple[Siren, Tensor]:
        """Return the mean of the networks after some steps on other points, such as all of them, and its parameters."""
        terms = replace(self.terms, scene=scene)
        search = GainRatioDamping(
            initial_damping=self.parameters.damping,
            metric=layer_scaled,
            geodesic=True,
            length=self.parameters.refit_length,
        )
        found = []
        for field, theta in self.members:
            noise = self.terms.noise(field, theta)

            def problem_at(number: int, theta: Tensor, field: Siren = field, noise: Deviations = noise) -> FieldProblem:
                del number
                return terms.problem(field, theta, noise, self.rng)

            steps = StopRule(self.parameters.refit_steps, patience=self.parameters.refit_steps + 1)
            found.append((field, GaussNewton(search, Cholesky()).run(problem_at, theta, steps).theta))
        return mean_of(found)

    def climb(self) -> tuple[Siren, Solution, float]:
        """Return the network of the best score, its parameters, and that score.

        Raises
        ------
        FitError
            When the linear start cannot be solved.
        """
        widths = self._widths()
        field = Siren((widths[0],) * self.parameters.depth)
        scene, rng = self.terms.scene, self.rng
        theta = spectral_start(field, scene, lambda x, d, n: start_terms(scene, self.options, rng, x, d, n), rng)
        solution = self._fitted(field, theta, self.parameters.first_steps)
        best = field, solution, self.terms.score(field, solution.theta)
        for width in widths[1:]:
            if solution.interrupted or best[2] > self.parameters.hopeless_ratio * self.rival:
                break
            self.terms = self.terms.with_wrong_signs(field, solution.theta, rng)
            frequency = InitialisationParameters.first_layer_frequency
            field, theta = widened(field, solution.theta, width, rng, frequency)
            solution = self._fitted(field, theta, self.parameters.steps)
            score = self.terms.score(field, solution.theta)
            gains = score < (1 - self.parameters.least_gain) * best[2]
            if score < best[2]:
                best = field, solution, score
            if not gains:
                break
        field, solution, score = best
        _log.info("A network has widths %s, after %d steps.", field.widths, len(self.history))
        return field, solution, score

    def _widths(self) -> list[int]:
        """Return the first width, and those of networks with no more parameters than the data has rows."""
        first, *wider = self.parameters.widths
        rows = 4 * len(self.terms.scene.points)
        return [first, *(w for w in wider if Siren((w,) * self.parameters.depth).layout.count <= rows)]

    def _fitted(self, field: Siren, theta: Tensor, steps: int) -> Solution:
        """Take at most so many steps of Gauss-Newton; return the parameters of the least score."""
        noise = self.terms.noise(field, theta)
        done, seconds = len(self.history), self.history[-1].seconds if self.history else 0.0
        residual = 0.0

        def problem_at(number: int, theta: Tensor) -> FieldProblem:
            nonlocal noise
            del number
            found = self.terms.noise(field, theta)
            # Deviations follow the field at half the rate at which they rise, so that one bad step has little effect.
            noise = Deviations(
                (min(noise.values, found.values) + found.values) / 2,
                (min(noise.normals, found.normals) + found.normals) / 2,
            )
            return self.terms.problem(field, theta, noise, self.rng)

        def score(theta: Tensor) -> float:
            nonlocal residual
            residual = self.terms.eikonal_rms(field, theta)
            return self.terms.score(field, theta)

        def record(found: Record) -> None:
            found = replace(found, step=done + found.step, seconds=seconds + found.seconds, eikonal=residual)
            self.history.append(found)
            if self.callback is not None:
                self.callback(found)

        search = GainRatioDamping(initial_damping=self.parameters.damping, metric=layer_scaled, geodesic=True)
        patience = self.parameters.patience_steps
        stop = StopRule(steps, tolerance=self.parameters.least_gain, patience=steps + 1, held_out_patience=patience)
        return GaussNewton(search, Cholesky()).run(problem_at, theta, stop, record, score)

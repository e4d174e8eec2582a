"""The global network by Gauss-Newton: a ladder of widths, climbed while validation points gain by it.

A small network is fast and smooth, and finds the shape as a whole. When its score stops falling, it is widened with its
function kept (`field.widening`), and fitted further. The ladder ends at the width that no longer improves the score.
A step costs a multiple of the fourth power of the width, so that the small networks take most of the steps.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.field.widening import widened
from gnrecon.fit.fit_options import FitOptions
from gnrecon.fit.initialisation import spectral_start
from gnrecon.fit.network_terms import Deviations, NetworkTerms
from gnrecon.fit.objective import FieldProblem, start_terms
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
    """

    terms: NetworkTerms
    options: FitOptions
    rng: np.random.Generator
    callback: Callback | None = None
    parameters: NetworkLadderParameters = NetworkLadderParameters()

    def __post_init__(self) -> None:
        """Begin without records."""
        self.history: list[Record] = []

    def climb(self) -> tuple[Siren, Solution, float]:
        """Return the network of the best score, its parameters with the history of all steps, and that score.

        Raises
        ------
        FitError
            When the linear start cannot be solved.
        """
        widths = self.parameters.widths
        field = Siren((widths[0],) * self.parameters.depth)
        scene, rng = self.terms.scene, self.rng
        theta = spectral_start(field, scene, lambda x, d, n: start_terms(scene, self.options, rng, x, d, n), rng)
        solution = self._fitted(field, theta, self.parameters.first_steps)
        best = field, solution, self.terms.score(field, solution.theta)
        for width in widths[1:]:
            if solution.interrupted:
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
        _log.info("The global network has widths %s, after %d steps.", field.widths, len(self.history))
        return field, replace(solution, history=tuple(self.history)), score

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

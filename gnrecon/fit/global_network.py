"""The global network by Gauss-Newton: its terms, and the ladder of widths that it climbs.

    values       f = 0                       at the points
    normals      grad f = n                  at the points
    free space   f between two shares of d   where the winding number is certain; d is the coarse signed distance
    eikonal      |grad f| = 1                near the surface, and in the whole box

Each row is over its standard deviation, so that the sum of squares is a log likelihood, and no weight is left to set.
The deviations of values and normals are those of the validation points from the field that the step starts at
(`NetworkTerms.noise`): a coarse field fits coarsely, a better one weighs the data more, and what the network cannot
predict it does not chase. Rows of data have the robust weights of Student's t distribution at that deviation, so that
outliers and contradicting normals lose their weight. Those of free space are one-sided; besides a random part of all
samples, each step has the samples at which the field is wrong.
Source: Lange, Little and Taylor, *Robust Statistical Modeling Using the t Distribution* (1989), for the weights.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.field.widening import mean_of, widened
from gnrecon.fit.fit_options import FitOptions, network_count, network_starts
from gnrecon.fit.initialisation import WrongSignSearch, spectral_start
from gnrecon.fit.objective import FieldProblem, ObjectiveTerm, Scene, start_terms
from gnrecon.fit.parameters import InitialisationParameters, NetworkLadderParameters, NetworkTermParameters
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import sample_near_surface
from gnrecon.least_squares import layer_scaled
from gnrecon.least_squares.direct import Cholesky
from gnrecon.optim import Callback, GainRatioDamping, GaussNewton, Record, Solution, StopRule
from gnrecon.residuals.constraints import eikonal, interface, normal_vector, value_range

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Deviations:
    """Standard deviations of values, in radii, and of normals, in radians."""

    values: float
    normals: float


@dataclass(frozen=True)
class Prediction:
    """How a field predicts the validation points and the sign of free space.

    misfits : of shape (V,), distance of each validation point from the surface, in disk radii, plus |grad f - n|
    wrong : mask of shape (Q,), of the samples of free space whose sign is wrong
    wrong_sign_score : what a field costs that is wrong in all of free space
    """

    misfits: Tensor
    wrong: Tensor
    wrong_sign_score: float

    @property
    def score(self) -> float:
        """How bad it is, in disk radii."""
        return float(self.misfits.mean()) + self.wrong_sign_score * float(self.wrong.double().mean())

    def is_better_than(self, other: Prediction, *, standard_errors: float) -> bool:
        """Whether it gains so many standard errors over another prediction of the same points and samples.

        The noise of a validation point is in both, so that differences, point by point, have little of it.
        """
        points = other.misfits - self.misfits
        signs = self.wrong_sign_score * (other.wrong.double() - self.wrong.double())
        error = sum(float(part.var(correction=0)) / len(part) for part in (points, signs) if len(part)) ** 0.5
        return bool(other.score - self.score > standard_errors * error)


@dataclass(frozen=True)
class NetworkTerms:
    """The data of a global network.

    Parameters
    ----------
    scene : the points that it sees
    points, normals : of shape (V, 3), the validation points
    volume, distances : samples of free space, of shape (Q, 3), and their coarse signed distances, of shape (Q,)
    near : places near the surface at which the eikonal residual is measured, of shape (E, 3)
    """

    scene: Scene
    points: Tensor
    normals: Tensor
    volume: Tensor
    distances: Tensor
    near: Tensor
    parameters: NetworkTermParameters

    @classmethod
    def draw(
        cls,
        scene: Scene,
        points: Float,
        normals: Float,
        rng: np.random.Generator,
        *,
        parameters: NetworkTermParameters = NetworkTermParameters(),
    ) -> NetworkTerms:
        """Draw the samples of free space; without validation points, the points that are seen take their place."""
        if len(points) < parameters.least_validation_points:
            points, normals = scene.samples.points, scene.samples.normals
        x, distance = _certain(scene, scene.places(parameters.pool_samples, rng))
        count = parameters.eikonal_measured
        near = sample_near_surface(scene.samples.points, parameters.near_spacings * scene.coarse.spacing, count, rng)
        validation = scene.tensor(points), scene.tensor(normals)
        return cls(scene, *validation, scene.tensor(x), scene.tensor(distance), scene.tensor(near), parameters)

    def with_wrong_signs(self, field: Siren, theta: Tensor, rng: np.random.Generator) -> NetworkTerms:
        """Return the terms with more samples of free space where the field has the wrong sign."""
        scene = self.scene
        known = WrongSignSearch(scene.coarse, self.volume.cpu().numpy(), self.distances.sign().cpu().numpy())
        trial = scene.places(self.parameters.trial_samples, rng)
        wrong, _ = known.wrong_signs(trial, lambda x: field.value(theta, scene.tensor(x)).cpu().numpy())
        x, distance = _certain(scene, wrong)
        volume = torch.cat([self.volume, scene.tensor(x)])
        return replace(self, volume=volume, distances=torch.cat([self.distances, scene.tensor(distance)]))

    def noise(self, field: Siren, theta: Tensor) -> Deviations:
        """Return robust deviations of the validation points from the field."""
        distance, angle = self._misfits(field, theta)
        least, radius = self.parameters.least_deviation, self.radius
        # Medians of the absolute value of a normal variable, and of the length of a normal vector in space.
        values, normals = float(distance.median()) / 0.6745, float(angle.median()) / 1.538
        # The errors of estimated normals are alike among neighbours, so that validation points do not show them.
        least_angle = self.parameters.least_estimated_deviation if self.scene.samples.estimated else least
        return Deviations(max(values, least * radius), max(normals, least_angle))

    def prediction(self, field: Siren, theta: Tensor) -> Prediction:
        """Return how the field predicts."""
        distance, angle = self._misfits(field, theta)
        wrong = self.distances.sign() * field.value(theta, self.volume) < 0.0
        return Prediction(distance / self.radius + angle, wrong, self.parameters.wrong_sign_score)

    def score(self, field: Siren, theta: Tensor) -> float:
        """Return how badly it predicts, in disk radii."""
        return self.prediction(field, theta).score

    def eikonal_rms(self, field: Siren, theta: Tensor) -> float:
        """Return the root mean square of |grad f| - 1 near the surface."""
        gradient = field.value_and_gradient(theta, self.near)[1]
        return float((gradient.norm(dim=1) - 1.0).square().mean().sqrt())

    def problem(self, field: Siren, theta: Tensor, noise: Deviations, rng: np.random.Generator) -> FieldProblem:
        """Draw the rows of one step."""
        terms = [*self._data(field, theta, noise, rng), self._free_space(field, theta, rng), *self._eikonal(rng)]
        return FieldProblem(field, terms, theta, precision=torch.float32)

    @property
    def radius(self) -> float:
        """Median radius of the disks that points stand for."""
        return self.scene.coarse.radius

    def _misfits(self, field: Siren, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances of the validation points from the surface, and |grad f - n|, both of shape (V,)."""
        value, gradient = field.value_and_gradient(theta, self.points)
        slope = (gradient * self.normals).sum(1).clamp_min(self.parameters.least_slope)
        return value.abs() / slope, (gradient - self.normals).norm(dim=1)

    def _is_wrong(self, field: Siren, theta: Tensor) -> Tensor:
        """Return the samples of free space at which f is beyond half of the one-sided bound, a mask of shape (Q,)."""
        value = self.distances.sign() * field.value(theta, self.volume)
        return value < self.parameters.least_share / 2 * self.distances.abs()

    def _data(
        self, field: Siren, theta: Tensor, noise: Deviations, rng: np.random.Generator
    ) -> tuple[ObjectiveTerm, ObjectiveTerm]:
        """Return values and normals at a random part of the points, with robust weights."""
        freedom = self.parameters.robust_degrees_of_freedom
        rows = self._part(len(self.scene.points), self.parameters.data_rows, rng)
        points, normals = self.scene.points[rows], self.scene.normals[rows]
        value, gradient = field.value_and_gradient(theta, points)
        off = (value / noise.values).square()
        turned = ((gradient - normals) / noise.normals).square().sum(1)
        of_values = (freedom + 1) / (freedom + off) / noise.values**2
        of_normals = (freedom + 3) / (freedom + turned) / noise.normals**2
        # A term's weight is divided by its number of rows.
        return (
            ObjectiveTerm("interface", interface, points, None, len(rows) * of_values),
            ObjectiveTerm("normal", normal_vector, points, normals, len(rows) * of_normals),
        )

    def _free_space(self, field: Siren, theta: Tensor, rng: np.random.Generator) -> ObjectiveTerm:
        """Return a random part of free space, and of the samples at which the field is wrong."""
        count = min(len(self.scene.points), self.parameters.data_rows)
        some = self._part(len(self.volume), count, rng)
        wrong = self._is_wrong(field, theta).nonzero()[:, 0]
        rows = torch.cat([some, wrong[self._part(len(wrong), count // 2, rng)]])
        distance = self.distances[rows]
        near, far = self.parameters.least_share * distance, self.parameters.most_share * distance
        ends = torch.stack([torch.minimum(near, far), torch.maximum(near, far)], 1)
        weight = len(rows) / (self.parameters.free_space_deviation_share * distance).square()
        return ObjectiveTerm("free space", value_range, self.volume[rows], ends, weight)

    def _eikonal(self, rng: np.random.Generator) -> tuple[ObjectiveTerm, ObjectiveTerm]:
        """Return eikonal rows near the surface and in the box."""
        scene, limits = self.scene, self.parameters
        count = max(min(len(scene.points), limits.data_rows) // 2, 1)
        near = sample_near_surface(scene.samples.points, limits.near_spacings * scene.coarse.spacing, count, rng)
        box = scene.box.sample(max(count // 2, 1), rng)
        deviations = limits.near_eikonal_deviation, limits.far_eikonal_deviation
        near_term, far_term = (
            ObjectiveTerm(name, eikonal, scene.tensor(x), None, len(x) / deviation**2)
            for name, x, deviation in zip(("eikonal near the surface", "eikonal"), (near, box), deviations, strict=True)
        )
        return near_term, far_term

    def _part(self, count: int, most: int, rng: np.random.Generator) -> Tensor:
        """Return at most `most` of so many rows, in order."""
        return torch.as_tensor(np.sort(rng.permutation(count)[:most])).to(self.points.device)


def _certain(scene: Scene, x: Float) -> tuple[Float, Float]:
    """Return the places among x, of shape (Q, 3), where distance and sign are known, and the signed distances."""
    known, distance, _, certain = scene.coarse.at(x)
    return x[known][certain], distance[certain]


# A ladder of widths, climbed while validation points gain by it.
#
# A small network is fast and smooth, and finds the shape as a whole. The best of some starts is widened with its
# function kept (`field.widening`) and fitted further, until a width gains no more; only to widths with a parameter for
# each point, because local fields resolve more of denser scans. Sparse points leave much freedom, so that each start
# ends in another field: the mean of those networks that score best together is nearer to the surface, as their
# deviations between points are independent.
# Source: Caruana et al., *Ensemble Selection from Libraries of Models* (2004), for the choice of members.


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
        self.history: list[Record] = []
        self.members: list[tuple[Siren, Tensor]] = []

    def fit(self) -> tuple[Siren, Solution, float]:
        """Return the best mean of networks, its parameters with the history of all steps, and its score.

        Raises
        ------
        FitError
            When a linear start cannot be solved.
        """
        found = []
        for _ in range(network_count(len(self.terms.scene.points), parameters=self.parameters)):
            found.append(self.climb())
            if found[-1][1].interrupted or found[-1][2] > self.rival:
                break
        last = found[-1][1]
        found.sort(key=lambda member: member[2])
        members = [found[0]]
        field, theta, score = found[0][0], found[0][1].theta, found[0][2]
        for member in found[1:]:
            tried = mean_of([(one, solution.theta) for one, solution, _ in (*members, member)])
            if (of_mean := self.terms.score(*tried)) < score:
                members.append(member)
                (field, theta), score = tried, of_mean
        self.members = [(one, solution.theta) for one, solution, _ in members]
        scores = ", ".join(f"{one[2]:.3g}" for one in found)
        _log.info("Networks of scores %s; the mean of %d has %.3g disk radii.", scores, len(members), score)
        return field, replace(last, theta=theta, history=tuple(self.history)), score

    def refit(self, scene: Scene) -> tuple[Siren, Tensor]:
        """Return the mean of the networks after some steps on other points, such as all of them, and its parameters.

        Raises
        ------
        KeyboardInterrupt
            On Ctrl-C during the steps; the networks are unchanged.
        """
        terms = replace(self.terms, scene=scene)
        found = []
        for field, theta in self.members:
            noise = self.terms.noise(field, theta)

            def problem_at(number: int, theta: Tensor, field: Siren = field, noise: Deviations = noise) -> FieldProblem:
                del number
                return terms.problem(field, theta, noise, self.rng)

            steps = StopRule(self.parameters.refit_steps, patience=self.parameters.refit_steps + 1)
            solution = self._optimiser(self.parameters.refit_length).run(problem_at, theta, steps)
            if solution.interrupted:
                raise KeyboardInterrupt
            found.append((field, solution.theta))
        return mean_of(found)

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

        The best start takes as many again, as in successive halving (Jamieson and Talwalkar, *Non-stochastic Best Arm
        Identification and Hyperparameter Optimization*, 2016).
        """
        field, found = Siren((width,) * self.parameters.depth), list[Solution]()
        scene, rng, steps = self.terms.scene, self.rng, self.parameters.first_steps
        start = partial(start_terms, scene, self.options, rng)
        for _ in range(network_starts(len(scene.points), parameters=self.parameters)):
            theta = spectral_start(field, scene, start, rng, InitialisationParameters.hidden_weight_share)
            # The score rises before it falls, as the damping finds its size: no patience ends these steps.
            found.append(self._fitted(field, theta, steps, patience=steps))
            if found[-1].interrupted:
                break
        best = min(found, key=lambda one: self.terms.score(field, one.theta)).theta
        return field, replace(found[-1], theta=best) if found[-1].interrupted else self._fitted(field, best, steps)

    def _widths(self) -> list[int]:
        """Return the first width, and wider ones with a parameter for each point, and no more of them than rows."""
        (first, *wider), points = self.parameters.widths, len(self.terms.scene.points)
        counts = {width: Siren((width,) * self.parameters.depth).layout.count for width in wider}
        return [first, *(width for width, count in counts.items() if points <= count <= 4 * points)]

    def _fitted(self, field: Siren, theta: Tensor, steps: int, *, patience: int | None = None) -> Solution:
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

        patience = self.parameters.patience_steps if patience is None else patience
        stop = StopRule(steps, tolerance=self.parameters.least_gain, patience=steps + 1, held_out_patience=patience)
        return self._optimiser().run(problem_at, theta, stop, record, score)

    def _optimiser(self, length: float = 1.0) -> GaussNewton:
        damping = self.parameters.damping
        return GaussNewton(GainRatioDamping(damping, metric=layer_scaled, geodesic=True, length=length), Cholesky())

"""The data of the global network, which `network_ladder` fits by Gauss-Newton: one term for each kind of row.

    values       f = 0                       at the points
    normals      grad f = n                  at the points
    free space   f between two shares of d   d is the coarse signed distance, across holes that of a film (`_places`)
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

from collections.abc import Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field

import numpy as np
import torch
from torch import Tensor

from gnrecon.field.networks import Siren
from gnrecon.fit.initialisation import WrongSignSearch
from gnrecon.fit.objective import FieldProblem, ObjectiveTerm, Scene
from gnrecon.fit.parameters import NetworkTermParameters
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import film_distance, is_sign_certain, sample_near_surface
from gnrecon.residuals.constraints import Residual, eikonal, interface, normal_vector, value_range


@dataclass(frozen=True)
class Deviations:
    """Standard deviations of values, in radii, and of normals, in radians."""

    values: float
    normals: float

    def followed(self, found: Deviations) -> Deviations:
        """Return those of the next step: they rise at half the rate of the field's own, so that one bad step is little.

        `found` are those of the field that the step starts at.
        """
        return Deviations(
            (min(self.values, found.values) + found.values) / 2,
            (min(self.normals, found.normals) + found.normals) / 2,
        )


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
class FreePlaces:
    """Samples of free space.

    Parameters
    ----------
    points : of shape (Q, 3)
    signed : signed distances of the surface, of shape (Q,)
    deviation : standard deviation of f beyond its bounds, of shape (Q,)
    """

    points: Tensor
    signed: Tensor
    deviation: Tensor

    def __len__(self) -> int:
        return len(self.points)

    def take(self, rows: Tensor | slice) -> FreePlaces:
        """Return some of the samples."""
        return FreePlaces(self.points[rows], self.signed[rows], self.deviation[rows])

    def joined(self, others: Sequence[FreePlaces]) -> FreePlaces:
        """Return these samples, then the others."""
        every = (self, *others)
        parts = ([one.points for one in every], [one.signed for one in every], [one.deviation for one in every])
        return FreePlaces(*map(torch.cat, parts))


@dataclass(frozen=True)
class NetworkTerms:
    """The data of a global network.

    Parameters
    ----------
    scene : the points that it sees
    points, normals : of shape (V, 3), the validation points
    free : samples of free space where the sign is certain
    gaps : those where it is not, as across holes, which a film closes
    near : places near the surface at which the eikonal residual is measured, of shape (E, 3)
    normal : the residual of the normals, of m components
    """

    scene: Scene
    points: Tensor
    normals: Tensor
    free: FreePlaces
    gaps: FreePlaces
    near: Tensor
    parameters: NetworkTermParameters
    normal: Residual = normal_vector
    _latest: list[tuple[Siren, Tensor, Tensor]] = dataclass_field(
        default_factory=list, init=False, repr=False, compare=False
    )

    @classmethod
    def draw(
        cls,
        scene: Scene,
        points: Float,
        normals: Float,
        rng: np.random.Generator,
        *,
        normal: Residual = normal_vector,
        parameters: NetworkTermParameters = NetworkTermParameters(),
    ) -> NetworkTerms:
        """Draw the samples of free space; without validation points, the points that are seen take their place."""
        if len(points) < parameters.least_validation_points:
            points, normals = scene.samples.points, scene.samples.normals
        rows = slice(None, None, -(-len(points) // parameters.most_validation_points))
        points, normals = points[rows], normals[rows]
        free, gaps = _places(scene, scene.places(parameters.pool_samples, rng), parameters)
        count = parameters.eikonal_measured
        near = sample_near_surface(scene.samples.points, parameters.near_spacings * scene.coarse.spacing, count, rng)
        validation = scene.tensor(points), scene.tensor(normals)
        return cls(scene, *validation, free, gaps, scene.tensor(near), parameters, normal)

    def with_wrong_signs(self, field: Siren, theta: Tensor, rng: np.random.Generator) -> NetworkTerms:
        """Return the terms with more samples of free space where the field has the wrong sign."""
        scene = self.scene
        known = WrongSignSearch(scene.coarse, self.free.points.cpu().numpy(), self.free.signed.sign().cpu().numpy())
        trial = scene.places(self.parameters.trial_samples, rng)
        wrong, _ = known.wrong_signs(trial, lambda x: field.value(theta, scene.tensor(x)).cpu().numpy())
        return replace(self, free=self.free.joined([_places(scene, wrong, self.parameters)[0]]))

    def with_rows(self, most: int) -> NetworkTerms:
        """Return the terms with at most so many points a step."""
        most = min(most, self.parameters.data_rows)
        return replace(self, parameters=replace(self.parameters, data_rows=most))

    def joined(self, others: Sequence[NetworkTerms]) -> NetworkTerms:
        """Return the terms with the samples that others have found in addition to these."""
        found = slice(len(self.free), None)
        return replace(self, free=self.free.joined([other.free.take(found) for other in others]))

    def noise(self, field: Siren, theta: Tensor) -> Deviations:
        """Return robust deviations of the validation points from the field."""
        distance, turn = self._misfits(field, theta)
        least, radius = self.parameters.least_deviation, self.radius
        # Medians of the length of a normal vector by its number of components; with more, nearly the root of that.
        medians, components = {1: 0.6745, 2: 1.1774, 3: 1.538}, turn.shape[1]
        values = float(distance.median()) / medians[1]
        normals = float(turn.norm(dim=1).median()) / medians.get(components, components**0.5)
        return Deviations(max(values, least * radius), max(normals, self._least_angle))

    @property
    def _least_angle(self) -> float:
        """Least deviation of all normals: neighbours' estimates err alike, which validation points do not show."""
        samples, limits = self.scene.samples, self.parameters
        if not samples.estimated or self.scene.deviations is not None:
            return limits.least_deviation
        return limits.least_estimated_deviation if samples.clean is None else limits.least_sparse_deviation

    def prediction(self, field: Siren, theta: Tensor) -> Prediction:
        """Return how the field predicts."""
        distance, turn = self._misfits(field, theta)
        wrong = self._signed(field, theta) < 0.0
        return Prediction(distance / self.radius + turn.norm(dim=1), wrong, self.parameters.wrong_sign_score)

    def score(self, field: Siren, theta: Tensor) -> float:
        """Return how badly it predicts, in disk radii."""
        return self.prediction(field, theta).score

    def eikonal_rms(self, field: Siren, theta: Tensor) -> float:
        """Return the root mean square of |grad f| - 1 near the surface."""
        gradient = field.value_and_gradient(theta, self.near)[1]
        return float((gradient.norm(dim=1) - 1.0).square().mean().sqrt())

    def problem(self, field: Siren, theta: Tensor, noise: Deviations, rng: np.random.Generator) -> FieldProblem:
        """Draw the rows of one step."""
        terms = [*self._data(field, theta, noise, rng), self._free_space(field, theta, rng), self._eikonal(rng)]
        return FieldProblem(field, terms, theta, precision=torch.float32)

    @property
    def radius(self) -> float:
        """Median radius of the disks that points stand for."""
        return self.scene.coarse.radius

    def _misfits(self, field: Siren, theta: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances of the validation points from the surface, (V,), and residuals of normals, (V, m)."""
        value, gradient = field.value_and_gradient(theta, self.points)
        slope = (gradient * self.normals).sum(1).clamp_min(self.parameters.least_slope)
        return value.abs() / slope, self.normal(value, gradient, self.normals).residual

    def _is_wrong(self, field: Siren, theta: Tensor) -> Tensor:
        """Return the samples of free space at which f is beyond half of the one-sided bound, a mask of shape (Q,)."""
        return self._signed(field, theta) < self.parameters.least_share / 2 * self.free.signed.abs()

    def _signed(self, field: Siren, theta: Tensor) -> Tensor:
        """Return f at the samples of free space, of shape (Q,), positive where its sign is right.

        In single precision, which takes a third of the time and is as good for a sign; a step asks for it twice.
        """
        for other, at, values in self._latest:
            if other is field and at is theta:
                return values
        values = field.value(theta.float(), self.free.points.float()) * self.free.signed.sign()
        self._latest[:] = [(field, theta, values)]
        return values

    def _data(
        self, field: Siren, theta: Tensor, noise: Deviations, rng: np.random.Generator
    ) -> tuple[ObjectiveTerm, ObjectiveTerm]:
        """Return values and normals at a random part of the points, with robust weights."""
        freedom = self.parameters.robust_degrees_of_freedom
        rows = self._part(len(self.scene.points), self.parameters.data_rows, rng)
        points, normals = self.scene.points[rows], self.scene.normals[rows]
        value, gradient = field.value_and_gradient(theta, points)
        off, angles = (value / noise.values).square(), torch.full_like(value, noise.normals)
        if (own := self.scene.deviations) is not None:
            angles = own[rows].maximum(angles)
        turn = self.normal(value, gradient, normals).residual
        turned = (turn / angles[:, None]).square().sum(1)
        of_values = (freedom + 1) / (freedom + off) / noise.values**2
        of_normals = (freedom + turn.shape[1]) / (freedom + turned) / angles.square()
        # A term's weight is divided by its number of rows.
        return (
            ObjectiveTerm("interface", interface, points, None, len(rows) * of_values),
            ObjectiveTerm("normal", self.normal, points, normals, len(rows) * of_normals),
        )

    def _free_space(self, field: Siren, theta: Tensor, rng: np.random.Generator) -> ObjectiveTerm:
        """Return a random part of free space, gaps as densely as the rest, and of the samples where f is wrong."""
        limits, most = self.parameters, min(len(self.scene.points), self.parameters.data_rows)
        some = self._part(len(self.free), most, rng)
        wrong = self._is_wrong(field, theta).nonzero()[:, 0]
        rows = torch.cat([some, wrong[self._part(len(wrong), most // 2, rng)]])
        share = len(self.gaps) / max(len(self.free) + len(self.gaps), 1)
        gaps = self.gaps.take(self._part(len(self.gaps), round(share * most), rng))
        places = self.free.take(rows).joined([gaps])
        ends = places.signed[:, None] * places.signed.new_tensor([limits.least_share, limits.most_share])
        weight = len(places) / places.deviation.square()
        return ObjectiveTerm("free space", value_range, places.points, ends.sort(dim=1).values, weight)

    def _eikonal(self, rng: np.random.Generator) -> ObjectiveTerm:
        """Return eikonal rows near the surface and in the box."""
        scene, limits = self.scene, self.parameters
        count = max(min(len(scene.points), limits.data_rows) // 2, 1)
        near = sample_near_surface(scene.samples.points, limits.near_spacings * scene.coarse.spacing, count, rng)
        box = scene.box.sample(max(count // 2, 1), rng)
        x = scene.tensor(np.concatenate([near, box]))
        deviations = x.new_tensor([limits.near_eikonal_deviation, limits.far_eikonal_deviation])
        weights = len(x) / deviations.square().repeat_interleave(torch.tensor([len(near), len(box)]).to(x.device))
        return ObjectiveTerm("eikonal", eikonal, x, None, weights)

    def _part(self, count: int, most: int, rng: np.random.Generator) -> Tensor:
        """Return at most `most` of so many rows, in order."""
        return torch.as_tensor(np.sort(rng.permutation(count)[:most])).to(self.points.device)


def _places(scene: Scene, x: Float, parameters: NetworkTermParameters) -> tuple[FreePlaces, FreePlaces]:
    """Return those of the places x, of shape (Q, 3), that are clear of the data: where the sign is certain, and others.

    Where it is not, the surface is that of a film across the hole; the network would bulge there, as it likes.
    """
    known, signed, _, winding = scene.coarse.at(x)
    certain = is_sign_certain(winding)
    surface = np.where(certain, signed, film_distance(signed, winding))
    share = np.where(certain, parameters.free_space_deviation_share, parameters.film_deviation_share)
    places = FreePlaces(*map(scene.tensor, (x[known], surface, share * np.abs(signed))))
    return places.take(torch.as_tensor(certain)), places.take(torch.as_tensor(~certain))

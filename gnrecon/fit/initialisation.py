"""Starts of a fit: exact linear solves for the last layer of a sine network (`wide_start`, `spectral_start`).

*Wide and linear.* One hidden layer of random sine features sin(w . x + b) is linear in its output weights, so that
f = 0, grad f = n and the coarse signed distance have one exact least-squares solution (variable projection). The
frequencies w = F / l, with a length l of 0.12 of the radius by default, follow the spectral density of a Matern kernel
(`field.random_features`); the solve is then a sketch of kernel interpolation with Hermite data.
Where the solution's sign disagrees with the coarse distance, samples are added and the solve is repeated. As the
features stay, so does J^T J of the data, and new samples only add to that of the volume.

*Spectral.* Deeper networks begin with normal frequencies of fixed standard deviation in the first layer, hidden weights
that keep the variance of sines (Sitzmann et al. 2020, theorem 1.8), uniform phases, and one exact solve of the last
layer, with a ridge that keeps its weights small: from large weights every direction of Gauss-Newton is a bad one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import pad

from gnrecon.field.networks import Siren
from gnrecon.field.random_features import Features
from gnrecon.fit.objective import FieldProblem, ObjectiveTerm, Scene, distance_weight
from gnrecon.fit.parameters import InitialisationParameters
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import CoarseDistance
from gnrecon.least_squares.direct import damped_factor, solve_factored
from gnrecon.least_squares.layer_products import gram_and_product
from gnrecon.residuals.constraints import Residual, interface, normal_vector, signed_distance
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.errors import FitError
from gnrecon.runtime.progress import ProgressCallback, ignore_progress

TermsOf = Callable[[Tensor, Tensor, int], Sequence[ObjectiveTerm]]
"""Terms of volume samples x, their coarse distances, and at most so many data points."""


@dataclass(frozen=True)
class Spectrum:
    """Of random features: their length l, in radii, and nu, the degrees of freedom: the more, the smoother."""

    length: float = InitialisationParameters.length_scale_radii
    degrees_of_freedom: float = InitialisationParameters.degrees_of_freedom


def wide_start(
    field: Siren,
    scene: Scene,
    data: Sequence[ObjectiveTerm],
    rng: np.random.Generator,
    spectrum: Spectrum = Spectrum(),
    advance: ProgressCallback = ignore_progress,
    *,
    parameters: InitialisationParameters = InitialisationParameters(),
) -> Tensor:
    """Return parameters, of shape (p,), of the one-layer network that solves terms of the data and coarse distances.

    `advance` is called with the share of the rounds that is done.

    Raises
    ------
    FitError
        When the linear system cannot be solved.
    """
    like = scene.points
    features = Features.draw(field.widths[0], rng, like, degrees_of_freedom=spectrum.degrees_of_freedom)
    first = features.frequencies / spectrum.length, features.phases
    theta = field.layout.flatten([first, (like.new_zeros(1, field.widths[0]), like.new_zeros(1))])

    def of_volume(x: Float, distance: Float, repeats: int) -> LastLayer:
        """Return the equations of coarse distances that count so often each, at a weight of one."""
        weight = float(repeats * len(x))
        term = ObjectiveTerm("distance", signed_distance, scene.tensor(x), scene.tensor(distance), weight)
        return LastLayer.of(field, [term], theta)

    x, distance = scene.volume(scene.volume_count, rng)
    search, total = WrongSignSearch(scene.coarse, x, np.sign(distance)), len(x)
    of_data, volume = LastLayer.of(field, data, theta), of_volume(x, distance, 1)
    ridge = parameters.ridge / max(len(x), *map(len, data))
    for round_number in range(parameters.rounds):
        # A few points may be so far apart that no place has a known distance.
        weight = distance_weight(total, len(scene.points)) / max(total, 1)
        solved = of_data.plus(volume, weight).solved(ridge, parameters=parameters)
        advance((round_number + 1) / parameters.rounds)
        if round_number + 1 < parameters.rounds:
            trial = scene.places(parameters.trial_factor * scene.volume_count, rng)
            wrong, expected = search.wrong_signs(trial, partial(_value, field, solved, scene))
            some = rng.permutation(len(wrong))[: scene.volume_count // 2]
            if not len(some):
                break
            volume = volume.plus(of_volume(wrong[some], expected[some], parameters.wrong_sign_repeats))
            total += parameters.wrong_sign_repeats * len(some)
    return solved


def _value(field: Siren, theta: Tensor, scene: Scene, x: Float) -> Float:
    """Return the field's values, of shape (Q,), at points, of shape (Q, 3); their signs need single precision only."""
    values: Float = field.value(theta.float(), scene.tensor(x).float()).cpu().numpy()
    return values


def spectral_start(
    field: Siren,
    scene: Scene,
    terms_of: TermsOf,
    rng: np.random.Generator,
    *,
    parameters: InitialisationParameters = InitialisationParameters(),
) -> Tensor:
    """Return parameters, of shape (p,), of a network of several layers whose last one solves `terms_of` the volume.

    Raises
    ------
    FitError
        When the linear system cannot be solved.
    """
    theta = random_network(field, rng, scene.points, parameters.hidden_weight_share)
    count = parameters.spectral_samples
    x, distance = scene.volume(count, rng)
    terms = terms_of(scene.tensor(x), scene.tensor(distance), count)
    total = sum(float(torch.as_tensor(term.weight).mean()) for term in terms)
    return solve_last_layer(field, terms, theta, parameters.spectral_ridge * total)


def random_network(
    field: Siren,
    rng: np.random.Generator,
    like: Tensor,
    hidden_weight_share: float = 1.0,
    *,
    first_layer_frequency: float = InitialisationParameters.first_layer_frequency,
) -> Tensor:
    """Return random sine layers, of shape (p,), with a last layer of zeros.

    Frequencies of the first layer have the standard deviation `first_layer_frequency`, per radius. Weights between
    hidden layers have `hidden_weight_share` of the bound that keeps the variance of sines (Sitzmann et al., theorem
    1.8).
    """
    layers = []
    for number, (out, into) in enumerate(field.layout.shapes):
        if number == 0:
            weights, bias = first_layer_frequency * rng.standard_normal((out, into)), rng.uniform(0.0, 2 * np.pi, out)
        elif number == len(field.widths):
            weights, bias = np.zeros((out, into)), np.zeros(out)
        else:
            bound = hidden_weight_share * np.sqrt(6.0 / into)
            weights, bias = rng.uniform(-bound, bound, (out, into)), rng.uniform(-np.pi, np.pi, out)
        layers.append((torch.as_tensor(weights).to(like), torch.as_tensor(bias).to(like)))
    return field.layout.flatten(layers)


@dataclass(frozen=True)
class LastLayer:
    """The normal equations of the last layer, in which the network is linear.

    Parameters
    ----------
    field : Siren
    theta : all parameters, of shape (p,), where the equations were made
    product, gradient : J^T J and J^T r of terms that are linear in f, by the last layer's parameters
    """

    field: Siren
    theta: Tensor
    product: Tensor
    gradient: Tensor

    @classmethod
    def of(cls, field: Siren, terms: Sequence[ObjectiveTerm], theta: Tensor) -> LastLayer:
        """Assemble the equations of some terms; those without points have none."""
        closed: list[ObjectiveTerm] = []
        others: list[ObjectiveTerm] = []
        for term in filter(len, terms):
            is_closed = len(field.widths) == 1 and term.residual in _ONE_LAYER_SUMS
            (closed if is_closed else others).append(term)
        problem = _last_layer_problem(field, others, theta)
        free = problem.free()
        sums = cls(field, theta, free.new_zeros(len(free), len(free)), torch.zeros_like(free))
        if problem.terms:
            jacobian, residual = problem.linearise(free)
            sums = cls(field, theta, jacobian.gram(), jacobian.tmv(residual))
        for term in closed:
            sums = sums.plus(cls(field, theta, *_ONE_LAYER_SUMS[term.residual](field, term, theta)))
        return sums

    def plus(self, other: LastLayer, weight: float = 1.0) -> LastLayer:
        """Return the equations of both, the other's with a weight."""
        product, gradient = self.product.add(other.product, alpha=weight), self.gradient + weight * other.gradient
        return replace(self, product=product, gradient=gradient)

    def solved(self, ridge: float, *, parameters: InitialisationParameters = InitialisationParameters()) -> Tensor:
        """Return theta, of shape (p,), with its last layer solved; the ridge damps the layer's change.

        Raises
        ------
        FitError
            When the system is not finite.
        """
        for _ in range(parameters.ridge_attempts):
            factor = damped_factor(self.product, torch.full_like(self.gradient, ridge))
            if factor is not None and bool(torch.isfinite(self.gradient).all()):
                problem = _last_layer_problem(self.field, (), self.theta)
                return problem.whole(problem.free() - solve_factored(factor, self.gradient))
            # Features that nearly depend on each other: what rounding takes from the smallest eigenvalue, the ridge
            # gives.
            ridge *= 10
        raise FitError("The linear start could not be solved: the system holds values that are not finite.")


# The equations of a wide layer, in closed form. Rows of a value are its sines; those of the gradient along an axis are
# cosines C times the slopes S of the features along it, so that J^T J of all three is the Hadamard product of C^T C and
# S S^T, a third of the work.


def _value_sums(field: Siren, term: ObjectiveTerm, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Return J^T J, its lower triangle valid, and J^T r of values."""
    (slopes, phases), (outer, constant) = field.layout.layers(theta)
    # Coarse distances are far less exact than sines in single precision, which take a third of the time. The products
    # of rounded sines are not rounded: those of rounded products would not be positive definite.
    stored = torch.float32 if term.residual is signed_distance else theta.dtype

    def chunks() -> Iterator[tuple[Tensor, Tensor]]:
        for rows, scale in _weighted(term, theta):
            x = term.points[rows].to(stored)
            features = torch.addmm(phases.to(stored), x, slopes.T.to(stored)).sin_().to(theta.dtype)
            features = torch.cat([features, features.new_ones(len(features), 1)], 1)
            value = features @ torch.cat([outer[0], constant])
            residual = value if term.target is None else value - term.target[rows]
            yield features.mul_(scale), scale[:, 0] * residual

    return gram_and_product(chunks(), len(slopes) + 1, theta)


def _normal_sums(field: Siren, term: ObjectiveTerm, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Return J^T J, its lower triangle valid, and J^T r of normals."""
    (slopes, phases), (outer, _) = field.layout.layers(theta)
    target = term.target
    assert target is not None

    def chunks() -> Iterator[tuple[Tensor, Tensor]]:
        for rows, scale in _weighted(term, theta):
            cosines = torch.addmm(phases, term.points[rows], slopes.T).cos_()
            residual = (cosines * outer) @ slopes - target[rows]
            yield cosines.mul_(scale), scale * residual

    product, along = gram_and_product(chunks(), len(slopes), theta, 3)
    # The constant has no slope.
    return pad(product.mul_(slopes @ slopes.T), (0, 1, 0, 1)), pad((along * slopes).sum(1), (0, 1))


def _weighted(term: ObjectiveTerm, like: Tensor, *, chunk_points: int = 2048) -> Iterator[tuple[slice, Tensor]]:
    """Yield a term's rows, chunk by chunk, which bounds the memory, and the roots of the weights, of shape (m, 1)."""
    scale = torch.as_tensor(term.weight).to(like).expand(len(term)).div(len(term)).sqrt()[:, None]
    for rows in slices(len(term), chunk_points):
        yield rows, scale[rows]


_ONE_LAYER_SUMS: dict[Residual, Callable[[Siren, ObjectiveTerm, Tensor], tuple[Tensor, Tensor]]] = {
    interface: _value_sums,
    signed_distance: _value_sums,
    normal_vector: _normal_sums,
}


def _last_layer_problem(field: Siren, terms: Sequence[ObjectiveTerm], theta: Tensor) -> FieldProblem:
    """Return the problem of which the last layer's parameters alone are free."""
    none = torch.zeros(0, dtype=torch.long, device=theta.device)
    return FieldProblem(field, terms, theta, (*(none for _ in field.widths), None))


def solve_last_layer(
    field: Siren,
    terms: Sequence[ObjectiveTerm],
    theta: Tensor,
    ridge: float | None = None,
    *,
    parameters: InitialisationParameters = InitialisationParameters(),
) -> Tensor:
    """Return theta, of shape (p,), with its last layer solved by least squares; exact for terms linear in f.

    The ridge damps the change of the last layer, by default as little as rounding allows.

    Raises
    ------
    FitError
        When the system is not finite.
    """
    ridge = parameters.ridge / max(len(term) for term in terms) if ridge is None else ridge
    return LastLayer.of(field, terms, theta).solved(ridge, parameters=parameters)


# Places in free space where a field has the wrong sign. They cause detached sheets and spikes in the mesh.
#
# The true sign is that of the winding number, which costs as much as several evaluations of the field. But it changes
# only across the data or the closing of a hole, so that it nearly always equals that of the nearest sample of known
# sign. The winding number is evaluated only where the field contradicts that sample.


@dataclass
class WrongSignSearch:
    """A search for places of the wrong sign that remembers the signs it has computed.

    Parameters
    ----------
    coarse : CoarseDistance
    points : array of shape (K, 3), samples whose sign is known; there may be none
    signs : array of shape (K,)
    """

    coarse: CoarseDistance
    points: Float
    signs: Float

    def wrong_signs(self, x: Float, value: Callable[[Float], Float]) -> tuple[Float, Float]:
        """Return those of x where the value has the wrong sign, of shape (G, 3), and the coarse distances there.

        Parameters
        ----------
        x : array of shape (Q, 3); those too near to the data for a coarse distance are ignored
        value : gives the field's values, of shape (N,), at points, of shape (N, 3)
        """
        known, size, _ = self.coarse.size(x)
        x = x[known]
        own = value(x)
        doubtful = np.flatnonzero(own * self._nearest_signs(x) <= 0)
        x, own, size = x[doubtful], own[doubtful], size[doubtful]
        sign = self.coarse.sign(x)
        self.points, self.signs = np.concatenate([self.points, x]), np.concatenate([self.signs, sign])
        wrong = own * sign <= 0
        return x[wrong], (sign * size)[wrong]

    def _nearest_signs(self, x: Float) -> Float:
        """Return the signs of the nearest known samples, of shape (Q,), or zeros where none is known."""
        if not len(self.points):
            return np.zeros(len(x))
        signs: Float = self.signs[cKDTree(self.points).query(x)[1]]
        return signs

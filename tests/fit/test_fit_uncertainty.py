"""The uncertainty against plain Bayesian regression, refits without the points that are left out, and known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scan_files import TUBE, torus
from scipy.stats import spearmanr
from torch import Tensor
from torch.func import grad, jacrev, vmap

from gnrecon.field import Siren
from gnrecon.field.random_features import Features
from gnrecon.fit import FitOptions, NeuralSDF, Uncertainty, fit
from gnrecon.fit.parameters import LaplaceParameters, UncertaintyParameters
from gnrecon.fit.posterior.laplace_approximation import DataRows, Laplace, free_units, laplace
from gnrecon.fit.posterior.uncertainty import calibration, left_out_scores
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.geometry.signed_distance import Box
from gnrecon.residuals import normal_projection, normal_vector
from gnrecon.residuals.constraints import Residual
from gnrecon.runtime.errors import FitError

UNIT = Frame(np.zeros(3), 1.0)
BOX = Box(-1.2 * np.ones(3), 1.2 * np.ones(3))


def network(widths: tuple[int, ...], seed: int = 0) -> tuple[Siren, Tensor]:
    field = Siren(widths)
    theta = torch.randn(field.layout.count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return field, theta


def directions(count: int, seed: int = 0) -> Tensor:
    x = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return x / x.norm(dim=1, keepdim=True)


def plain_rows(field: Siren, theta: Tensor, x: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives of f, (N, k), and of grad f, (N, 3, k), by some parameters, by nested autodiff."""

    def value(theta: Tensor, x: Tensor) -> Tensor:
        *hidden, (weights, bias) = field.layout.layers(theta)
        for W, b in hidden:
            x = torch.sin(W @ x + b)
        return (weights @ x + bias)[0]

    by_value = vmap(lambda p: grad(value)(theta, p))(x)
    by_gradient = vmap(lambda p: jacrev(lambda t: grad(value, argnums=1)(t, p))(theta))(x)
    return by_value[:, columns], by_gradient[:, :, columns]


def free_columns(field: Siren) -> Tensor:
    units = free_units(field, torch.device("cpu"))
    return torch.arange(field.layout.count) if units is None else field.layout.columns(units)


WEIGHT = 0.09


def plain_precision(rows: DataRows, noise: float) -> tuple[Tensor, Tensor, Tensor]:
    """C^-1, the weighted rows J and the prior's precision, all from matrices held whole."""
    columns = free_columns(rows.field)
    value, gradient = plain_rows(rows.field, rows.theta, rows.points, columns)
    along = rows.normal_residual(value[:, 0], gradient[:, :, 0], rows.normals).by_gradient
    assert along is not None
    slopes = torch.einsum("nmk,nkp->mnp", along, gradient).flatten(0, 1)
    J = torch.cat([value, rows.normal_weight**0.5 * slopes])
    prior, offsets = torch.empty(len(columns), dtype=torch.float64), rows.field.layout.offsets
    for start, stop in zip(offsets, [*offsets[1:], rows.field.layout.count], strict=True):
        group = (columns >= start) & (columns < stop)
        prior[group] = value[:, group].square().sum() / len(rows) / LaplaceParameters.prior_deviation_radii**2
    return J.T @ J / noise**2 + prior.diag(), J, prior


@pytest.mark.parametrize("widths", [(40,), (5, 4)], ids=["wide", "deep"])
def test_sigma_is_that_of_bayesian_regression(widths: tuple[int, ...]) -> None:
    field, theta = network(widths)
    data = directions(60)
    frame = Frame(np.array([100.0, 200.0, 300.0]), 25.0)
    found = Uncertainty.of(NeuralSDF(field, theta, frame, BOX), Samples(data.numpy(), data.numpy(), frame))
    x = directions(9, seed=1)
    covariance = torch.linalg.inv(plain_precision(found.deviation.rows, found.noise / frame.scale)[0])
    rows = plain_rows(field, theta, x, free_columns(field))[0]
    steep = field.value_and_gradient(theta, x)[1].norm(dim=1)
    assert (steep > 0.1).all()
    expected = found.factor * frame.scale * (rows @ covariance * rows).sum(1).sqrt() / steep
    np.testing.assert_allclose(found.sigma(frame.to_world(x.numpy())), expected.numpy(), rtol=1e-4)


def test_a_wide_last_layer_stands_for_all_parameters() -> None:
    assert free_units(Siren((32, 32, 32)), torch.device("cpu")) is None
    assert len(free_columns(Siren((1000,)))) == 1001
    deep = Siren((256, 256))
    columns = free_columns(deep)
    most = LaplaceParameters.most_free_parameters
    assert 0.9 * most < len(columns) <= most
    assert len(columns.unique()) == len(columns)
    assert torch.equal(columns[-257:], torch.arange(deep.layout.count - 257, deep.layout.count))


def noisy_rows(count: int, noise: float, seed: int) -> DataRows:
    """Data of the zero field of random features, its normals (the gradient's targets) disturbed."""
    field, rng = Siren((700,)), np.random.default_rng(seed)
    features = Features.draw(700, rng, torch.zeros(0, dtype=torch.float64), degrees_of_freedom=4.0)
    zero = torch.zeros(1, 700, dtype=torch.float64)
    theta = field.layout.flatten([(features.frequencies / 0.12, features.phases), (zero, zero[0, :1])])
    x = torch.as_tensor(rng.uniform(-1, 1, (count, 3)))
    return DataRows(field, theta, x, noise * torch.as_tensor(rng.standard_normal((count, 3))), normal_vector, 1.0)


def test_noise_balances_residuals_and_rows_that_remain() -> None:
    rows = noisy_rows(300, 0.3, seed=1)
    posterior = laplace(rows)
    precision, J, prior = plain_precision(rows, posterior.noise)
    torch.testing.assert_close((posterior.factor @ posterior.factor.T).tril(), precision.tril())
    covariance = torch.linalg.inv(precision)
    # All output weights are zero, so that the residuals are the disturbances.
    r = torch.cat([torch.zeros(300, dtype=torch.float64), -rows.normals.T.flatten()])
    torch.testing.assert_close(posterior.shift, -covariance @ J.T @ r / posterior.noise**2, rtol=1e-5, atol=1e-6)
    remaining = len(r) - float((covariance * (J.T @ J)).sum()) / posterior.noise**2
    assert 0 < remaining < len(r) - 100
    balanced = float(((r + J @ posterior.shift).square().sum() / remaining).sqrt())
    plain = float(r.square().mean().sqrt())
    assert posterior.noise == pytest.approx(max(balanced, plain), rel=0.03)
    assert (prior > 0).all()


@pytest.mark.parametrize(("size", "residual"), [(1, normal_vector), (6, normal_vector), (6, normal_projection)])
def test_left_out_errors_are_those_of_a_fit_without_the_points(size: int, residual: Residual) -> None:
    field, theta = network((40,))
    data = directions(70)
    rows = DataRows(field, theta, data, directions(70, seed=3), residual, WEIGHT)
    posterior = laplace(rows)
    scores = left_out_scores(rows, posterior, size, 4, np.random.default_rng(0))
    for number, centre in enumerate(np.random.default_rng(0).permutation(70)[:4]):
        patch = (data - data[centre]).norm(dim=1).argsort(stable=True)[:size]
        step, covariance = fit_without(rows, posterior, patch)
        J = torch.cat([chunk.clone() for chunk in rows.values(data[patch]).dense()])
        error = field.value(theta, data[patch]) + J @ step
        beside = J @ posterior.shift
        spread = ((J @ covariance * J).sum(1) + posterior.noise**2).sqrt()
        expected = torch.hypot(error, beside) / spread
        np.testing.assert_allclose(scores[number * size :][:size], expected.numpy(), rtol=1e-5, atol=1e-7)


def fit_without(rows: DataRows, posterior: Laplace, patch: Tensor) -> tuple[Tensor, Tensor]:
    """The step from the fitted parameters, and their covariance, that the other points leave with the same prior."""
    precision, _, prior = plain_precision(rows, posterior.noise)
    jacobian, residual = rows.linearise()
    # What pulls towards the prior's mean, from where all forces balance at the mode of all points.
    pull = -(precision @ posterior.shift) - jacobian.tmv(residual) / posterior.noise**2
    kept = torch.ones(len(rows), dtype=torch.bool)
    kept[patch] = False
    jacobian, residual = replace(rows, points=rows.points[kept], normals=rows.normals[kept]).linearise()
    J = torch.cat([chunk.clone() for chunk in jacobian.dense()])
    without = J.T @ J / posterior.noise**2 + prior.diag()
    return -torch.linalg.solve(without, J.T @ residual / posterior.noise**2 + pull), torch.linalg.inv(without)


def test_the_factor_covers_what_is_left_out_and_never_takes_away() -> None:
    rows = noisy_rows(500, 0.3, seed=4)
    posterior = laplace(rows)
    # With twice the precision the predictions are too sure of themselves.
    sure = replace(posterior, factor=4 * posterior.factor, noise=posterior.noise / 4)
    factor, rng = calibration(rows, sure), np.random.default_rng(0)
    assert factor > 1
    patches = zip(UncertaintyParameters.patch_sizes, UncertaintyParameters.patch_counts, strict=True)
    inside = [np.abs(left_out_scores(rows, sure, size, count, rng)) <= 2 * factor for size, count in patches]
    assert np.mean([part.mean() for part in inside]) == pytest.approx(0.9545, abs=0.01)
    assert calibration(rows, replace(posterior, factor=posterior.factor / 100, noise=100 * posterior.noise)) == 1


@pytest.fixture(scope="module")
def holed() -> tuple[Samples, Uncertainty]:
    """A torus without the points of one place, fitted."""
    points, normals = torus(900, np.random.default_rng(8))
    kept = np.linalg.norm(points - [1 + TUBE, 0, 0], axis=1) > 0.45
    points = points + 0.005 * np.random.default_rng(1).standard_normal(points.shape)
    normals = normals + 0.05 * np.random.default_rng(2).standard_normal(points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frame = Frame.of(points[kept])
    samples = Samples(frame.to_unit(points[kept]), normals[kept], frame)
    sdf, _ = fit(samples, FitOptions(widths=(700,), steps=0))
    return samples, Uncertainty.of(sdf, samples)


def surface(uncertainty: Uncertainty, count: int = 1500) -> tuple[np.ndarray, np.ndarray]:
    """Points of the fitted surface, and their distance to the torus."""
    x = torus(count, np.random.default_rng(9))[0]
    for _ in range(6):
        slope = uncertainty.sdf.gradient(x)
        x = x - (uncertainty.sdf.sdf(x) / (slope**2).sum(axis=1))[:, None] * slope
    x = x[np.abs(uncertainty.sdf.sdf(x)) < 1e-6]
    assert len(x) > 0.99 * count
    return x, np.abs(np.hypot(np.hypot(x[:, 0], x[:, 1]) - 1, x[:, 2]) - TUBE)


def test_sigma_tells_errors_on_a_holed_torus(holed: tuple[Samples, Uncertainty]) -> None:
    x, error = surface(holed[1])
    sigma = holed[1].sigma(x)
    inside = np.linalg.norm(x - [1 + TUBE, 0, 0], axis=1) < 0.3
    assert np.median(sigma[inside]) > 3 * np.median(sigma[~inside])
    assert 0.85 <= (error < 2 * sigma).mean() <= 0.995
    assert spearmanr(sigma, error).statistic > 0.3


def test_sigma_repeats_itself_and_follows_the_unit(holed: tuple[Samples, Uncertainty]) -> None:
    samples, first = holed
    x = surface(first, 50)[0]
    assert np.array_equal(first.sigma(x), Uncertainty.of(first.sdf, samples).sigma(x))
    larger = Frame(samples.frame.center, 1000 * samples.frame.scale)
    scaled = Uncertainty.of(replace(first.sdf, frame=larger), replace(samples, frame=larger))
    moved = larger.to_world(samples.frame.to_unit(x))
    np.testing.assert_allclose(scaled.sigma(moved), 1000 * first.sigma(x), rtol=1e-5)
    assert first.sigma(np.zeros((0, 3))).shape == (0,)


def test_describes_itself(holed: tuple[Samples, Uncertainty]) -> None:
    phrase = holed[1].describe()
    assert f"{holed[1].noise:.3g}" in phrase
    assert f"{holed[1].factor:.3g}" in phrase


def test_parameters_that_are_not_finite_are_refused() -> None:
    field, theta = network((40,))
    data = directions(30).numpy()
    sdf = NeuralSDF(field, torch.full_like(theta, float("nan")), UNIT, BOX)
    with pytest.raises(FitError, match="uncertainty is not available"):
        Uncertainty.of(sdf, Samples(data, data, UNIT))

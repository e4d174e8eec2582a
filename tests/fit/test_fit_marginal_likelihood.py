"""The noise of most evidence: the density of Gaussian processes, and noise that was drawn is found again."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from gnrecon.field.random_features import Features
from gnrecon.fit.global_field import FieldResiduals
from gnrecon.fit.local_solve import Patch, data_kernel
from gnrecon.fit.marginal_likelihood import MarginalLikelihood, SurfaceLikelihood, log_density
from gnrecon.fit.model_selection import CrossValidation, select_hyperparameters
from gnrecon.fit.parameters import LocalSolveParameters, MarginalLikelihoodParameters, SurfaceLikelihoodParameters

LENGTH, RADIUS = 0.4, 0.05


def patches(count: int, points: int, rng: np.random.Generator) -> tuple[list[Patch], Features]:
    """Patches of random functions of size one, without noise, and the features that make them up."""
    features = Features.draw(300, rng, torch.zeros(0, dtype=torch.float64))
    center, none = torch.zeros(3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    made = []
    for _ in range(count):
        x = torch.as_tensor(np.append(rng.uniform(-0.5, 0.5, (points, 2)), np.zeros((points, 1)), axis=1))
        amplitudes = torch.as_tensor(rng.standard_normal(300)) * (2 / 300) ** 0.5
        value, gradient = features.sums(amplitudes, x, center, LENGTH, 1)
        made.append(Patch(x, value, gradient, none.reshape(0, 3), none, none, none, none, none, center))
    return made, features


def noisy(patch: Patch, position: float, angle: float, rng: np.random.Generator) -> Patch:
    """The same patch with noise of its values and gradients."""

    def off(values: Tensor, deviation: float) -> Tensor:
        return values + deviation * torch.as_tensor(rng.standard_normal(values.shape))

    return replace(patch, value=off(patch.value, position), gradient=off(patch.gradient, angle))


def test_log_density_is_that_of_a_normal_distribution(rng: np.random.Generator) -> None:
    (patch,), features = patches(1, 12, rng)
    kernel = data_kernel(patch, features, LENGTH, 0.7)
    noise = torch.tensor([0.02**2] * 12 + [0.3**2] * 36, dtype=torch.float64)
    whole = MultivariateNormal(torch.zeros(48, dtype=torch.float64), kernel + noise.diag())
    seen = torch.cat([patch.value, patch.gradient.T.flatten()])
    expected = float(whole.log_prob(seen)) + 24 * math.log(2 * math.pi)
    assert log_density(patch, kernel, 0.02, 0.3) == pytest.approx(expected, rel=1e-9)
    assert log_density(patch, -kernel, 1e-9, 1e-9) == -np.inf


@pytest.mark.parametrize(("position", "angle"), [(0.01, 0.3), (0.3, 0.05), (0.1, 0.1), (0.4, 0.4)])
def test_noise_is_found_again(position: float, angle: float, rng: np.random.Generator) -> None:
    exact, features = patches(6, 60, rng)
    drawn = [noisy(patch, position * RADIUS, angle, rng) for patch in exact]
    found = MarginalLikelihood(drawn, features, RADIUS, "cpu").likeliest(LENGTH)
    # What the prior's size, which is not the functions' own, makes of it moves it by a place in the tables at most.
    tables = MarginalLikelihoodParameters
    for value, wanted, table in (
        (found[0] / RADIUS, position, tables.position_noises_disk_radii),
        (found[1], angle, tables.angle_noises_radians),
    ):
        nearest = int(np.argmin(np.abs(np.log(np.array(table) / wanted))))
        assert table[max(nearest - 1, 0)] - 1e-9 <= value <= table[min(nearest + 1, len(table) - 1)] + 1e-9


@pytest.mark.parametrize("angle", [0.05, 1.0])
@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_a_length_is_found_again(factor: float, angle: float, rng: np.random.Generator) -> None:
    """With normals, and by positions alone where these are exact."""
    position, exact = 0.01, patches(6, 60, rng)[0]
    drawn = [noisy(patch, position, angle, rng) for patch in exact]
    likelihood = MarginalLikelihood.of(drawn, RADIUS, rng, "cpu")
    # From well below the length of the functions to well above it.
    lengths = [LENGTH * factor * 2.0 ** (step / 2) for step in range(-5, 4)]
    found = likelihood.likeliest_length(lengths, position, angle)
    # A finite number of features shows longer functions less exactly, which makes shorter lengths likelier.
    assert LENGTH / 2.1 < found < 1.5 * LENGTH
    assert likelihood.likeliest_length([LENGTH], position, angle) == LENGTH


def test_exact_points_with_tilted_normals_are_believed(rng: np.random.Generator) -> None:
    """Left-out points say little there, because the noise of their own normals hides what a fit adds to it."""
    x = rng.standard_normal((1500, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    tilted = x + 0.3 * rng.standard_normal(x.shape)
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    # Left over are waves a tenth of the radius long, of which the normals tell nothing.
    value = 0.01 * np.sin(20.0 * x[:, 0])
    gradient = x + 0.2 * np.cos(20.0 * x[:, :1]) * np.array([1.0, 0.0, 0.0])
    residuals = FieldResiduals(x, tilted, value, gradient)
    radius = residuals.density.radius
    held = rng.random(1500) < 1 / 6
    validation = CrossValidation.draw(residuals, held, radius, rng, "cpu")
    hyperparameters = validation.select()
    assert hyperparameters.position <= 0.05 * radius
    assert 0.17 <= hyperparameters.angle <= 0.4


def test_few_points_have_a_likeliest_noise_and_estimated_normals_have_none(rng: np.random.Generator) -> None:
    x = rng.standard_normal((40, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    residuals = FieldResiduals(x, x, 0.01 * x[:, 0], x)
    assert len(x) < MarginalLikelihoodParameters.patch_points
    held = np.arange(40) % 6 == 0
    given, estimated = (
        CrossValidation.draw(each, held, residuals.density.radius, rng, "cpu")
        for each in (residuals, replace(residuals, estimated=True))
    )
    found = given.select()
    assert found.by_place
    assert (found.position, found.angle) == given.noises(found.length)[-1]
    assert not replace(given, likelihood=None).select().by_place
    assert estimated.likelihood is None
    assert not estimated.select().by_place


def test_size_of_a_kernel(rng: np.random.Generator) -> None:
    (patch,), features = patches(1, 200, rng)
    kernel = data_kernel(patch, features, LENGTH, patch.size)
    # The mean variance of its values is the square of the size that is taken for that of the patch's function.
    assert float(kernel.diagonal()[:200].mean()) == pytest.approx(patch.size**2, rel=0.2)
    assert patch.size == pytest.approx(
        LocalSolveParameters.correction_rms_factor * float(patch.value.square().mean().sqrt())
    )


@pytest.mark.parametrize("ripple", [0.0, 0.02])
def test_positions_show_noise_and_size_of_what_a_sphere_lacks(ripple: float, rng: np.random.Generator) -> None:
    x = rng.standard_normal((3000, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    height = ripple * np.sqrt(2.0) * np.sin(7.0 * x[:, 0]) + 0.01 * rng.standard_normal(len(x))
    # A few points are none of the surface.
    height[::300] = 0.5
    likelihood = SurfaceLikelihood.of(x * (1 + height[:, None]), height, x, rng, "cpu")
    length, size, noise = likelihood.likeliest([0.1, 0.2, 0.4, 0.8])
    assert noise == pytest.approx(0.01, rel=0.1)
    if ripple:
        assert length >= 0.2
        assert 0.5 * ripple < size < 3 * ripple
    else:
        assert size < 0.3 * noise


def test_estimated_normals_are_left_out_of_the_choice(rng: np.random.Generator) -> None:
    x = rng.standard_normal((600, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    height = 0.02 * rng.standard_normal(len(x))
    wrong = x + 0.4 * rng.standard_normal(x.shape)
    wrong /= np.linalg.norm(wrong, axis=1, keepdims=True)
    held = np.arange(600) % 6 == 0
    points = x * (1 + height[:, None])
    found = [
        select_hyperparameters(
            FieldResiduals(points, normals, height, x, estimated=True), held, 0.05, np.random.default_rng(0)
        )
        for normals in (x, wrong)
    ]
    assert found[0] == found[1]
    assert found[0].position == pytest.approx(0.02, rel=0.15)
    assert found[0].angle == SurfaceLikelihoodParameters.angle_radians
    # The field explains all but the noise.
    assert found[0].rms_factor < 0.3

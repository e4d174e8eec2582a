"""Features bent to residuals of curvature: exact rows, and surfaces that become what was asked for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from gnrecon.field.random_features import Features
from gnrecon.fit.parameters import PenaltyFitParameters
from gnrecon.fit.penalties.regularisers import PenaltyProblem, PenaltyTerm, SineSum, minimise_penalised, regularisers
from gnrecon.residuals import SecondOrder, free_space, gauss_curvature, interface, mean_curvature, surface_strain
from gnrecon.runtime.errors import UsageError

RESIDUALS = [mean_curvature, gauss_curvature, surface_strain]


def sphere(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The jet of (|x|^2 - 1) / 2."""
    return (x.square().sum(1) - 1) / 2, x, torch.eye(3).to(x).expand(len(x), 3, 3)


def sines(rng: np.random.Generator, count: int = 80) -> SineSum:
    like = torch.zeros(0, dtype=torch.float64)
    return SineSum(Features.draw(count, rng, like), torch.tensor([0.1, 0.0, 0.9]).double(), 0.5, 0.2, sphere)


def cap(rng: np.random.Generator, count: int = 150) -> Tensor:
    """Points near the top of the unit sphere."""
    flat = rng.uniform(-0.4, 0.4, (count, 2))
    return torch.as_tensor(np.column_stack([flat, np.sqrt(1 - (flat**2).sum(1)) + rng.uniform(-0.05, 0.05, count)]))


@pytest.mark.parametrize("residual", RESIDUALS, ids=lambda one: one.name)
def test_rows_are_the_derivatives(residual: SecondOrder, rng: np.random.Generator) -> None:
    """By the loss, because strain's entries depend on a frame that may spin, and only their squares' sum does not."""
    field, points = sines(rng, 9), cap(rng, 7)
    amplitudes, change = torch.as_tensor(rng.normal(size=(2, 9)) * 0.05)
    scale = torch.as_tensor(rng.uniform(0.5, 2, (7, 1)))

    def at(a: Tensor) -> Tensor:
        return (scale * residual(*field.jet(a, points, sphere(points))).residual).T.flatten()

    rows = field.rows(points, residual(*field.jet(amplitudes, points, sphere(points))), scale)
    ahead, behind = at(amplitudes + 1e-6 * change), at(amplitudes - 1e-6 * change)
    difference = (ahead.square().sum() - behind.square().sum()) / 4e-6
    torch.testing.assert_close(at(amplitudes) @ (rows @ change), difference, rtol=1e-6, atol=1e-8)


@pytest.mark.seed(1861434696)
def test_points_arrive_on_the_surface(rng: np.random.Generator) -> None:
    field, points = sines(rng), cap(rng)
    amplitudes = 0.01 * torch.as_tensor(rng.normal(size=80))
    there = field.on_surface(amplitudes, points)
    assert field.jet(amplitudes, points, sphere(points))[0].abs().max() > 0.03
    assert field.jet(amplitudes, there, sphere(there))[0].abs().max() < 1e-6
    assert (there - points).norm(dim=1).max() < 0.2


def curvature_left(residual: SecondOrder, weight: float, rng: np.random.Generator) -> tuple[float, float]:
    """The residual's root mean square on a sphere's top, before and after features are bent to it.

    Data holds the surface around the top, where it is a sphere.
    """
    field, points = sines(rng), cap(rng)
    none = torch.zeros(80, dtype=torch.float64)
    rim = points[points[:, :2].norm(dim=1) > 0.35]
    rim = torch.nn.functional.normalize(rim, dim=1)
    rows = field.rows(rim, interface(*sphere(rim)[:2], None), torch.full((len(rim), 1), len(rim) ** -0.5).double())
    factor = torch.linalg.cholesky(rows.T @ rows + 1e-4 * torch.eye(80).double())
    term = PenaltyTerm(residual, points, torch.full((150, 1), (weight / 150) ** 0.5, dtype=torch.float64))
    found = minimise_penalised(field, factor, none, [term], none, 8)

    def left(a: Tensor) -> float:
        there = field.on_surface(a, points)
        return float(residual(*field.jet(a, there, sphere(there))).residual.square().sum(1).mean().sqrt())

    return left(none), left(found)


@pytest.mark.parametrize("residual", RESIDUALS, ids=lambda one: one.name)
def test_a_cap_becomes_what_is_asked_for(residual: SecondOrder, rng: np.random.Generator) -> None:
    before, after = curvature_left(residual, 0.01, rng)
    assert before == pytest.approx({"mean curvature": 2, "Gauss curvature": 1}.get(residual.name, 2**0.5), rel=0.05)
    assert after < 0.6 * before


def test_a_weight_of_nearly_nothing_changes_nearly_nothing(rng: np.random.Generator) -> None:
    before, after = curvature_left(mean_curvature, 1e-12, rng)
    assert after == pytest.approx(before, rel=1e-3)


def test_points_that_stay_keep_what_is_asked_of_their_values(rng: np.random.Generator) -> None:
    """A cap that is bent flat would leave the points below it on its other side."""
    field, points = sines(rng), cap(rng)
    none = torch.zeros(80, dtype=torch.float64)
    flat = PenaltyTerm(mean_curvature, points, torch.full((150, 1), 0.1).double())
    below = 0.85 * torch.nn.functional.normalize(points, dim=1)
    least = torch.full((150,), -0.1).double()
    keeps = SecondOrder("free space", lambda f, g, _, target: free_space(f, g, target))
    held = PenaltyTerm(keeps, below, torch.full((150, 1), 1.0).double(), target=least, fixed_value=sphere(below)[0])
    factor = 1e-2 * torch.eye(80).double()

    def highest(*terms: PenaltyTerm) -> float:
        found = minimise_penalised(field, factor, none, terms, none, 8)
        return float((sphere(below)[0] + field.features.sums(found, below, field.center, field.length, 0)[0]).max())

    assert highest(flat) > -0.05
    assert highest(flat, held) < -0.07


def test_creases_hardly_count(rng: np.random.Generator) -> None:
    """The tangent of r^2 / (1 + r^2) at r = 10 is a multiple of r^2 that weighs 1 / 101^2."""
    field, points = sines(rng), cap(rng, 5)
    none = torch.zeros(80, dtype=torch.float64)
    term = PenaltyTerm(mean_curvature, points, torch.ones(5, 1).double(), robust=0.2)
    problem = PenaltyProblem.at(field, torch.eye(80).double(), none, [term], none)
    # On the unit sphere k1 + k2 is 2, which is ten times 0.2.
    torch.testing.assert_close(problem.residual(none)[80:], torch.full((5,), 2 / 101).double(), rtol=1e-4, atol=0)


def test_what_is_asked_for_is_read() -> None:
    smooth, fill, prior = regularisers("strain=2e-5", "minimal", "developable=0.5")
    assert (smooth.residual, smooth.weight, smooth.holes, smooth.crease) == (surface_strain, 2e-5, False, None)
    assert (fill.residual, fill.weight, fill.holes) == (mean_curvature, PenaltyFitParameters.minimal_weight, True)
    assert (prior.residual, prior.weight, prior.holes, prior.crease) == (
        gauss_curvature,
        0.5,
        False,
        PenaltyFitParameters.crease_curvature,
    )
    assert regularisers(None, None, None) == ()
    with pytest.raises(UsageError, match="strain=WEIGHT"):
        regularisers("bending=1", None, None)

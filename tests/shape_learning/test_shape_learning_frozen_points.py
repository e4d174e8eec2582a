"""A step's problem: its loss by the definition, and its Jacobian against differences of what a trial measures."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from torch import Tensor

from gnrecon.field import SINE, WAVELET, Network
from gnrecon.residuals import eikonal, gauss_curvature, interface, mean_curvature, normal_vector, surface_strain
from gnrecon.shape_learning import LearnedField, cube
from gnrecon.shape_learning.frozen_points import FrozenProblem, FrozenTerm
from gnrecon.shape_learning.learn import pretrained
from gnrecon.shape_learning.shape_problem import ShapeProblem, StepState, on_surface, z_cylinder

F64 = torch.float64
NETWORK = Network((6, 5))


@pytest.fixture(scope="module")
def tube() -> tuple[Tensor, Tensor]:
    """Parameters of a network that is about a cylinder, and points of its surface."""
    problem = ShapeProblem("tube", (), cube(1.0), z_cylinder(0.6), NETWORK)
    rng = np.random.default_rng(0)
    theta = pretrained(problem, 0, rng)
    drawn = on_surface(40, nodes=8000)(StepState(1, problem.level_set(theta), rng))
    assert drawn.on_surface
    assert float(NETWORK.value(theta, drawn.points).abs().max()) < 1e-10
    return theta, drawn.points


def dense(problem: FrozenProblem, theta: Tensor) -> tuple[Tensor, Tensor]:
    jacobian, residual = problem.linearise(theta)
    return torch.cat([rows.clone() for rows in jacobian.dense()]), residual


def test_the_loss_is_the_weighted_mean_square(tube: tuple[Tensor, Tensor]) -> None:
    theta, points = tube
    off = points + 0.1
    normals = torch.nn.functional.normalize(points, dim=1)
    terms = [
        FrozenTerm("interface", interface, off, None, 2.0),
        FrozenTerm("normal", normal_vector, off, normals, 0.5),
        FrozenTerm("normal", normal_vector, points, normals, 1.0),
    ]
    problem = FrozenProblem(NETWORK, terms, theta)
    value, gradient = NETWORK.value_and_gradient(theta, off)
    at_surface = NETWORK.value_and_gradient(theta, points)[1]
    expected = [
        2.0 * float(value.square().mean()) / 2,
        0.5 * float((gradient - normals).square().sum(1).mean()) / 2
        + float((at_surface - normals).square().sum(1).mean()) / 2,
    ]
    shares = problem.shares(theta)
    assert list(shares) == ["interface", "normal"]
    np.testing.assert_allclose(list(shares.values()), expected, rtol=1e-12)
    residual = problem.residual(theta)
    np.testing.assert_allclose(0.5 * float(residual @ residual), sum(expected), rtol=1e-12)


@pytest.mark.parametrize("residual", [interface, eikonal, mean_curvature, gauss_curvature, surface_strain])
@pytest.mark.parametrize("moves", [False, True])
def test_the_jacobian_is_the_derivative_of_what_a_trial_measures(
    tube: tuple[Tensor, Tensor], residual: object, moves: bool
) -> None:
    theta, points = tube
    problem = FrozenProblem(NETWORK, [FrozenTerm("term", residual, points, None, 1.0, moves)], theta)
    J, r = dense(problem, theta)
    torch.testing.assert_close(r, problem.residual(theta), rtol=1e-12, atol=1e-14)
    generator = torch.Generator().manual_seed(1)
    for _ in range(3):
        direction = torch.randn(len(theta), generator=generator, dtype=F64)
        h = 1e-4
        ahead, behind = problem.residual(theta + h * direction), problem.residual(theta - h * direction)
        if residual is surface_strain:
            # Its entries belong to a frame that turns with the normal; its square does not.
            ahead, behind, along = ahead @ ahead, behind @ behind, 2 * (r @ J @ direction)
        else:
            along = J @ direction
        found = (ahead - behind) / (2 * h)
        # How points move is known in float32, whose rounding shows in the product of curvatures, one of them zero here.
        least = (5e-3 if moves and residual is gauss_curvature else 1e-4) * float(found.abs().max() + 1e-6)
        torch.testing.assert_close(along, found, rtol=1e-3, atol=least)


def test_the_strains_rows_are_right_where_its_frame_jumps() -> None:
    """Frames are chosen by the sign of the normal's z; along the normal of such a point it changes."""
    theta = 0.7 * torch.randn(NETWORK.layout.count, generator=torch.Generator().manual_seed(3), dtype=F64)

    def upward(t: float) -> float:
        return float(NETWORK.value_and_gradient(theta, torch.tensor([[0.1, t, 0.2]], dtype=F64))[1][0, 2])

    places = np.linspace(-2.0, 2.0, 41)
    before = next(a for a, b in pairwise(places) if upward(a) * upward(b) < 0.0)
    level = brentq(upward, before, before + 0.1, xtol=1e-14)
    points = torch.tensor([[0.1, level, 0.2]], dtype=F64)
    normal = torch.nn.functional.normalize(NETWORK.value_and_gradient(theta, points)[1], dim=1)
    beside = [NETWORK.value_and_gradient(theta, points + side * 1e-5 * normal)[1][0, 2] for side in (-1, 1)]
    assert float(beside[0] * beside[1]) < 0.0
    problem = FrozenProblem(NETWORK, [FrozenTerm("strain", surface_strain, points, None, 1.0, True)], theta)
    J, r = dense(problem, theta)
    direction = torch.randn(len(theta), generator=torch.Generator().manual_seed(1), dtype=F64)
    ahead, behind = problem.residual(theta + 1e-5 * direction), problem.residual(theta - 1e-5 * direction)
    found = (ahead @ ahead - behind @ behind) / 2e-5
    torch.testing.assert_close(2 * (r @ J @ direction), found, rtol=1e-3, atol=0.0)


def test_points_that_move_stay_on_the_surface(tube: tuple[Tensor, Tensor]) -> None:
    theta, points = tube
    problem = FrozenProblem(NETWORK, [FrozenTerm("stays", interface, points, None, 1.0, True)], theta)
    moved = theta.clone()
    moved[-1] -= 0.02
    assert float(problem.residual(moved).abs().max()) < 1e-6
    still = FrozenProblem(NETWORK, [FrozenTerm("left behind", interface, points, None, 1.0, False)], theta)
    assert float(still.residual(moved).abs().min()) > 1e-3
    assert torch.equal(problem.whole(problem.free()), theta)


@pytest.mark.parametrize(
    "network", [Network((5,), SINE), Network((4, 3), WAVELET, (3.0, 1.0))], ids=["sine", "wavelet"]
)
def test_other_networks_and_no_points(network: Network) -> None:
    theta = network.initial(torch.Generator().manual_seed(0))
    points = torch.randn(9, 3, generator=torch.Generator().manual_seed(1), dtype=F64)
    terms = [
        FrozenTerm("curvature", mean_curvature, points, None, 1.0),
        FrozenTerm("nothing", interface, points[:0], None, 1.0),
    ]
    J, r = dense(FrozenProblem(network, terms, theta), theta)
    assert J.shape == (9, network.layout.count)
    assert r.shape == (9,)
    assert FrozenProblem(network, [], theta).residual(theta).shape == (0,)


def test_a_learned_field_answers_as_its_network() -> None:
    theta = NETWORK.initial(torch.Generator().manual_seed(2))
    field = LearnedField(NETWORK, theta, cube(2.0))
    points = np.random.default_rng(0).uniform(-2, 2, (7, 3))
    value, gradient = field.sdf_and_gradient(points)
    np.testing.assert_array_equal(value, field.sdf(points))
    np.testing.assert_array_equal(gradient, field.gradient(points))
    steps = 1e-5 * np.eye(3)
    numeric = np.stack([(field.sdf(points + e) - field.sdf(points - e)) / 2e-5 for e in steps], 1)
    np.testing.assert_allclose(gradient, numeric, atol=1e-8)
    bent = np.stack([(field.gradient(points + e) - field.gradient(points - e)) / 2e-5 for e in steps], 2)
    np.testing.assert_allclose(field.hessian(points), bent, atol=1e-8)
    np.testing.assert_allclose(field.frame.to_unit(field.bounds), [[-(3**-0.5)] * 3, [3**-0.5] * 3])

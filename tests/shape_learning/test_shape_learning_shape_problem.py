"""Samplers, weights, and the pieces that problems are stated with."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gnrecon.geometry.signed_distance import Box
from gnrecon.level_set import LevelSet
from gnrecon.residuals import interface
from gnrecon.runtime.errors import FitError, UsageError
from gnrecon.shape_learning import (
    PROBLEMS,
    StepState,
    Term,
    at_points,
    circle,
    cube,
    fading,
    in_box,
    minimal_surface,
    on_surface,
    plane_through,
    rising,
    z_cylinder,
)
from gnrecon.shape_learning.learning_parameters import ShapeLearningParameters
from gnrecon.shape_learning.shape_problem import falling, growing

LAST = ShapeLearningParameters.measurement_step


def moment(value: object, box: Box, step: int = 1) -> StepState:
    def both(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            f = value(x)
            return f.detach(), torch.autograd.grad(f.sum(), x)[0]

    return StepState(step, LevelSet(value, both, box), np.random.default_rng(0))


def ball(x: torch.Tensor) -> torch.Tensor:
    return x.norm(dim=1) - 0.5


def test_known_points_are_all_used_or_some_of_them() -> None:
    points, targets = np.arange(30.0).reshape(10, 3), np.arange(10.0)
    everything = at_points(points, targets)(moment(ball, cube(1.0)))
    np.testing.assert_array_equal(everything.points, points)
    np.testing.assert_array_equal(everything.target, targets)
    sampler = at_points(points, targets, count=4)
    now = moment(ball, cube(1.0))
    first, second = sampler(now), sampler(now)
    assert len(first.points) == len(second.points) == 4
    assert not torch.equal(first.points, second.points)
    np.testing.assert_array_equal(first.points[:, 0], 3 * first.target)
    assert at_points(points)(now).target is None
    assert len(at_points(points, count=50)(now).points) == 10


def test_volume_and_surface_samples_are_where_they_say() -> None:
    now = moment(ball, cube(1.0))
    inside = in_box(200)(now).points
    assert float(inside.abs().max()) <= 1.0
    far = torch.linalg.vector_norm(inside - inside.flip(0), dim=1).median()
    assert float(torch.linalg.vector_norm(inside.diff(dim=0), dim=1).median()) < float(far) / 2, "neighbours are near"
    corner = Box(np.zeros(3), np.full(3, 0.1))
    assert float(in_box(50, corner)(now).points.max()) <= 0.1
    drawn = on_surface(100, nodes=10_000)(now)
    assert drawn.on_surface
    assert float(ball(drawn.points).abs().max()) < 1e-10


def test_a_surface_that_is_gone_is_told() -> None:
    with pytest.raises(FitError, match="step 7"):
        on_surface(100, nodes=5000)(moment(lambda x: x.norm(dim=1) + 1.0, cube(1.0), step=7))


def test_weights_fade_to_nothing() -> None:
    weight = fading(2.0, 5, 0.5, least=0.1)
    assert [weight(step) for step in (1, 5, 6, 7, 9, 10, LAST)] == [2.0, 2.0, 1.0, 0.5, 0.125, 0.0, 0.0]
    term = Term("eikonal", interface, in_box(3), weight)
    assert term.weight_at(6) == 1.0
    assert Term("fixed", interface, in_box(3), 3.0).weight_at(LAST) == 3.0


def test_weights_rise_to_the_most_and_are_reported_as_asked() -> None:
    weight = rising(1.0, 10, 2.0, most=5.0)
    assert [weight(step) for step in (1, 10, 11, 12, 13, 14, LAST)] == [1.0, 1.0, 2.0, 4.0, 5.0, 5.0, 5.0]
    term = Term("interface", interface, in_box(3), weight, reported=1.0)
    assert [term.weight_at(step) for step in (1, 12, LAST)] == [1.0, 4.0, 1.0]


def test_weights_fall_to_the_least() -> None:
    weight = falling(4.0, 0.5, least=0.75)
    assert [weight(step) for step in (1, 2, 3, LAST)] == [2.0, 1.0, 0.75, 0.75]


def test_starts() -> None:
    points = torch.tensor([[0.5, 0.0, 7.0], [0.0, 2.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(z_cylinder(0.5)(points), torch.tensor([0.0, 3.75], dtype=torch.float64))
    tilted = circle(1.0, 0.0, 50) @ np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0] + [1.0, 2.0, 3.0]
    start = plane_through(tilted)
    torch.testing.assert_close(start(torch.as_tensor(tilted)), torch.zeros(50, dtype=torch.float64), rtol=0, atol=1e-12)
    off = torch.as_tensor(tilted) + torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert float(start(off).abs().max()) > 0.1


@pytest.mark.parametrize("name", PROBLEMS)
def test_known_solutions_satisfy_their_problems(name: str) -> None:
    """The curves lie on the known surface, within the box."""
    problem = PROBLEMS[name]()
    curve = problem.terms[0].sampler(moment(ball, problem.box)).points
    assert problem.known is not None
    nearest, _ = problem.known.nearest(curve)
    torch.testing.assert_close(nearest, curve, rtol=0, atol=1e-9)
    assert bool((curve.numpy() >= problem.box.lower).all())
    assert bool((curve.numpy() <= problem.box.upper).all())


@pytest.mark.parametrize("curve", [np.zeros((2, 3)), np.zeros((5, 2)), np.full((4, 3), np.nan)])
def test_what_is_no_curve_is_refused(curve: np.ndarray) -> None:
    with pytest.raises(UsageError, match="curve"):
        minimal_surface(curve)


def test_points_grow_quickly_and_then_slowly() -> None:
    count = growing(100, 2.0, 800, 1.1)
    assert [count(step) for step in (1, 2, 3, 4)] == [100, 200, 400, 800]
    assert [count(step) for step in (5, 6)] == [880, 968]
    assert count(LAST) == LAST, "a measurement takes all points"
    assert count(LAST - 1) > 10**9

"""A scan as a problem of shape learning: it is learned, and measured against its own points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.least_squares import Iterative, NeighbourSums
from gnrecon.level_set import LevelSet
from gnrecon.shape_learning import ScannedSurface, learn, scanned
from gnrecon.shape_learning.learning_parameters import ShapeLearningParameters
from gnrecon.shape_learning.shape_problem import SampledPoints, StepState

LAST = ShapeLearningParameters.measurement_step


def ball(count: int = 300) -> Samples:
    """Points of an ellipsoid's surface, with its normals."""
    x = np.random.default_rng(2).standard_normal((count, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    axes = np.array([0.9, 0.7, 0.6])
    normals = x / axes
    return Samples(x * axes, normals / np.linalg.norm(normals, axis=1, keepdims=True), Frame(np.zeros(3), 1.0))


def test_a_scan_is_learned() -> None:
    learned = learn(scanned(ball()), budget=None, steps=4)
    start, best = learned.history[0], learned.best
    assert set(best.shares) == {"interface", "normal"}
    assert best.loss < 0.05 * start.loss
    assert best.chamfer is not None
    assert best.chamfer < 0.02
    middle = learned.field.sdf(np.array([[0.0, 0, 0], [1.0, 0, 0]]))
    assert middle[0] < 0 < middle[1]


def test_the_eikonal_weight_falls_and_is_not_reported() -> None:
    eikonal = next(term for term in scanned(ball(30)).terms if term.name == "eikonal")
    weights = [eikonal.weight_at(step) for step in (1, 2, 5, 50)]
    assert weights == sorted(weights, reverse=True)
    assert weights[-1] == pytest.approx(1e-4)
    assert eikonal.weight_at(LAST) == 0


def test_the_eikonal_term_ends_where_the_points_determine_the_network() -> None:
    eikonal = next(term for term in scanned(ball(5000)).terms if term.name == "eikonal")
    assert eikonal.weight_at(1) > 1e-3
    assert eikonal.weight_at(12) > 0
    assert eikonal.weight_at(20) == 0


@pytest.mark.parametrize(
    ("count", "error", "step", "held"),
    [(5000, 1e-3, 251, False), (5000, 1e-3, 250, True), (5000, 1e-2, 251, True), (2000, 1e-3, 251, True)],
    ids=["settled", "early", "far from the points", "too few points"],
)
def test_the_free_space_is_let_go_once_the_points_determine_the_network(
    count: int, error: float, step: int, held: bool
) -> None:
    problem = scanned(ball(count))
    sampler = next(term for term in problem.terms if term.name == "free space").sampler

    def values(x: torch.Tensor) -> torch.Tensor:
        # About the distance to the ellipsoid, and of the wrong sign in a corner of the box.
        near = (x / torch.tensor([0.9, 0.7, 0.6])).norm(dim=1) - 1.0
        return torch.where((x > 0.7).all(1), -1.0, near) + error

    level_set = LevelSet(values, lambda x: (values(x), torch.zeros_like(x)), problem.box)
    drawn = sampler(StepState(step, level_set, np.random.default_rng(0)))
    assert (len(drawn.points) > 0) == held


def test_the_free_space_is_asked_for_where_the_field_has_lost_its_sign() -> None:
    problem = scanned(ball(400))
    (free,) = (term for term in problem.terms if term.name == "free space")

    def drawn(value: Callable[[torch.Tensor], torch.Tensor]) -> SampledPoints:
        level_set = LevelSet(value, lambda x: (value(x), torch.zeros_like(x)), problem.box)
        return free.sampler(StepState(1, level_set, np.random.default_rng(0)))

    axes = torch.tensor([0.9, 0.7, 0.6], dtype=torch.float64)
    right = drawn(lambda x: (x / axes).norm(dim=1) - 1)
    assert len(right.points) == 0
    assert right.share == 0

    # A sheet around a corner of the box, and a hollow in the middle.
    def wrong(x: torch.Tensor) -> torch.Tensor:
        body = (x / axes).norm(dim=1) - 1
        corner = torch.as_tensor(problem.box.upper)
        return torch.where((x - corner).norm(dim=1) < 0.5, -body, torch.where(x.norm(dim=1) < 0.2, -body, body))

    lost = drawn(wrong)
    assert lost.target is not None
    assert 0 < lost.share < 0.3
    inside = (lost.points / axes).norm(dim=1) < 1
    assert inside.any()
    assert not inside.all()
    assert ((lost.target < 0) == inside).all()
    assert free.weight_at(LAST) == 0


def test_what_was_lost_once_is_looked_at_again_until_the_next_run() -> None:
    problem = scanned(ball(400))
    (free,) = (term for term in problem.terms if term.name == "free space")
    axes = torch.tensor([0.9, 0.7, 0.6], dtype=torch.float64)

    def body(x: torch.Tensor) -> torch.Tensor:
        return (x / axes).norm(dim=1) - 1

    def lost(step: int, value: Callable[[torch.Tensor], torch.Tensor], seed: int) -> set[tuple[float, ...]]:
        level_set = LevelSet(value, lambda x: (value(x), torch.zeros_like(x)), problem.box)
        drawn = free.sampler(StepState(step, level_set, np.random.default_rng(seed)))
        return {tuple(point) for point in drawn.points.tolist()}

    def inverted(x: torch.Tensor) -> torch.Tensor:
        return -body(x)

    first = lost(1, inverted, 0)
    assert first
    assert not lost(2, body, 1)
    assert first < lost(3, inverted, 2)
    assert first - lost(1, inverted, 3)


def test_a_cloud_of_few_points_has_no_known_free_space() -> None:
    learned = learn(scanned(ball(20)), budget=None, steps=2)
    assert np.isfinite(learned.best.loss)


def test_points_as_a_surface() -> None:
    surface = ScannedSurface(torch.arange(30).double().reshape(10, 3))
    points, shares = surface.sample(4)
    assert points.tolist() == surface.points[::3].tolist()
    assert shares.sum() == pytest.approx(1)
    feet, inside = surface.nearest(surface.points[[7, 2]] + 0.1)
    assert feet.tolist() == surface.points[[7, 2]].tolist()
    assert inside.all()


def test_neighbours_come_together_for_the_solver() -> None:
    problem = scanned(ball(2000))
    drawn = next(term for term in problem.terms if term.name == "interface").sampler(
        StepState(
            5, problem.level_set(problem.network.initial(torch.Generator().manual_seed(0))), np.random.default_rng(0)
        )
    )
    sides = [float(np.ptp(run.numpy(), axis=0).max()) for run in drawn.points.split(4)]
    assert np.mean(sides) < 6 * np.sqrt(4 * np.pi / len(drawn.points))
    solver = problem.solver()
    assert isinstance(solver, Iterative)
    assert solver.adapt is not None
    longest = []
    for iterations in [5.0] * 10 + [50.0] * 30:
        solver.preconditioner = solver.adapt(solver.preconditioner, iterations)
        assert isinstance(solver.preconditioner, NeighbourSums)
        longest.append(solver.preconditioner.longest)
    assert longest == [4] * 10 + [2] * 8 + [1] * 22, "shorter runs wait until they have shown what they do"

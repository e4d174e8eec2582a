"""Samples of level sets: on the surface, uniform by area, none where there is none, and no number ever undefined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from implicit_shapes import SHAPES, Shape, cube, level_set, sphere
from scipy import stats
from scipy.spatial import cKDTree

from gnrecon.geometry.signed_distance import Box
from gnrecon.level_set import LevelSet, find_crossings, project, sample_surface
from gnrecon.level_set.surface_search import near_values


@pytest.fixture(params=SHAPES, scope="module")
def shape(request: pytest.FixtureRequest) -> Shape:
    return SHAPES[request.param]()


def chi_square(shape: Shape, points: torch.Tensor) -> tuple[float, float]:
    """The statistic of the counts in parts of known area, and the value it exceeds once in 100,000 random samples."""
    counts = np.bincount(shape.bins(points).numpy(), minlength=len(shape.shares))
    expected = shape.shares * len(points)
    return float(((counts - expected) ** 2 / expected).sum()), float(stats.chi2.isf(1e-5, len(shape.shares) - 1))


def test_points_lie_on_the_level_set(shape: Shape, rng: np.random.Generator) -> None:
    sample = sample_surface(shape.level_set, 2000, rng)
    assert len(sample) >= 1980
    assert shape.distance(sample.points).max() < 1e-12
    assert shape.level_set.contains(sample.points).all()
    gradient = shape.level_set.value_and_gradient(sample.points)[1]
    torch.testing.assert_close(sample.normals, gradient / gradient.norm(dim=1, keepdim=True))


def test_neighbours_come_together(shape: Shape, rng: np.random.Generator) -> None:
    sample = sample_surface(shape.level_set, 2000, rng)
    sides = [float(np.ptp(run.numpy(), axis=0).max()) for run in sample.points.split(8)]
    # A square of eight points' area has sides of three spacings; at random places their patches are the larger.
    assert np.mean(sides) < 5 * np.sqrt(sample.area / 2000)


@pytest.mark.seed(1902792177)
def test_rough_values_find_the_same_surface(shape: Shape, rng: np.random.Generator) -> None:
    exact = shape.level_set

    def roughly(x: torch.Tensor) -> torch.Tensor:
        return exact.value(x.float().double()).float().to(x)

    rough = replace(exact, roughly=roughly)
    sample = sample_surface(rough, 2000, rng)
    assert len(sample) >= 1980
    assert shape.distance(sample.points).max() < 1e-12
    assert abs(sample.area / sample_surface(exact, 2000, rng).area - 1) < 0.05
    # Values that are needed to rounding are never rough ones.
    assert torch.equal(rough.values(sample.points), exact.values(sample.points))


@pytest.mark.parametrize("sweeps", [0, 3])
def test_points_are_uniform_by_area(shape: Shape, rng: np.random.Generator, sweeps: int) -> None:
    statistic, limit = chi_square(shape, sample_surface(shape.level_set, 3000, rng, sweeps=sweeps).points)
    assert statistic < limit


def test_the_test_of_uniformity_sees_what_the_weights_correct(rng: np.random.Generator) -> None:
    ball = sphere()
    crossings = find_crossings(ball.level_set, 300_000, rng)
    # The crossings of a grid without their weights are denser where the normal is diagonal.
    octants = (crossings.normals.abs().sum(1) > 1.5).double()
    assert octants.mean() > 1.03 * (octants * crossings.areas).sum() / crossings.areas.sum()
    assert crossings.areas.sum() == pytest.approx(ball.area, rel=0.01)


def test_the_area_is_right_on_average(shape: Shape, rng: np.random.Generator) -> None:
    # A part that is parallel to the grid makes single estimates vary: the rim of the torus by 4 %.
    areas = [float(find_crossings(shape.level_set, 20_000, rng).areas.sum()) for _ in range(40)]
    assert np.mean(areas) == pytest.approx(shape.area, rel=0.02)


def test_repulsion_evens_the_spacing(shape: Shape, rng: np.random.Generator) -> None:
    def unevenness(sweeps: int) -> float:
        points = sample_surface(shape.level_set, 1500, rng, sweeps=sweeps).points.numpy()
        nearest = cKDTree(points).query(points, 2)[0][:, 1]
        return float(nearest.std() / nearest.mean())

    assert unevenness(6) < 0.5 * unevenness(0)


def test_even_points_integrate_better_than_random_ones(rng: np.random.Generator) -> None:
    ball = sphere()
    # The mean of (3 z^2 - r^2)^2 over a sphere of radius r is 4 r^4 / 5; of N random points it errs by s / sqrt(N).
    errors = []
    for _ in range(12):
        z = sample_surface(ball.level_set, 1000, rng, nodes=20_000).points[:, 2]
        errors.append(float(((3 * z**2 / 0.64 - 1) ** 2).mean()) - 0.8)
    uniform = rng.uniform(-1, 1, 100_000)
    random = np.std((3 * uniform**2 - 1) ** 2) / np.sqrt(1000)
    assert np.sqrt(np.mean(np.square(errors))) < 0.5 * random


def test_more_points_than_crossings(rng: np.random.Generator) -> None:
    ball = sphere()
    sample = sample_surface(ball.level_set, 3000, rng, nodes=2000)
    assert len(np.unique(sample.points.numpy(), axis=0)) == len(sample) >= 2970
    statistic, limit = chi_square(ball, sample.points)
    assert statistic < limit


def test_samples_are_fresh_and_reproducible() -> None:
    ball = sphere().level_set
    first, again, other = (sample_surface(ball, 200, np.random.default_rng(seed)).points for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert torch.cdist(first, other).amin(1).max() > 1e-3


@pytest.mark.parametrize("constant", [-1.0, 0.5, 0.0, np.nan, np.inf])
def test_an_empty_level_set_gives_no_points(constant: float, rng: np.random.Generator) -> None:
    flat = LevelSet(
        lambda x: torch.full_like(x[:, 0], constant),
        lambda x: (torch.full_like(x[:, 0], constant), torch.zeros_like(x)),
        cube(1.0),
    )
    sample = sample_surface(flat, 100, rng, nodes=1000)
    assert (len(sample), sample.area) == (0, 0.0)
    assert sample.points.shape == sample.normals.shape == (0, 3)


def test_values_that_are_no_numbers_bound_no_surface(rng: np.random.Generator) -> None:
    def half(x: torch.Tensor) -> torch.Tensor:
        return torch.where(x[:, 0] < 0, torch.nan, (x**2).sum(1) - 0.5)

    points = sample_surface(level_set(half, cube(1.0)), 500, rng, nodes=20_000).points
    assert points[:, 0].min() >= 0
    assert len(points) > 450


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x[:, 0] * x[:, 1] * x[:, 2],
        lambda x: (x**2).sum(1) ** 2 - x[:, 0] ** 2,
        lambda x: x[:, 0] ** 3,
        lambda x: (x**2).sum(1),
        lambda x: torch.where(x[:, 0] > 0.2, 1.0, -1.0) + 0 * x[:, 1],
    ],
    ids=["three planes that meet", "pinched", "flat of third order", "one point", "a jump without a zero"],
)
def test_critical_points_give_numbers(function: object, rng: np.random.Generator) -> None:
    singular = level_set(function, cube(1.0))  # type: ignore[arg-type]
    sample = sample_surface(singular, 500, rng, nodes=20_000)
    assert sample.points.isfinite().all()
    assert sample.normals.isfinite().all()
    value, gradient = singular.value_and_gradient(sample.points)
    assert (value.abs() <= 1e-11 * gradient.norm(dim=1)).all()


def test_a_projection_stays_at_a_critical_point_and_says_so() -> None:
    ball = sphere().level_set
    starts = torch.tensor([[0.0, 0, 0], [1e-9, 0, 0], [0.0, 0.5, 0]], dtype=torch.float64)
    projected = project(ball, starts, cap=0.1)
    assert projected.converged.tolist() == [False, True, True]
    assert projected.points.isfinite().all()


def test_steps_are_capped() -> None:
    ball = sphere().level_set
    start = torch.tensor([[0.01, 0.0, 0.0]], dtype=torch.float64)
    points = [project(ball, start, cap=0.05, iterations=n).points[0, 0].item() for n in (1, 2, 30)]
    assert points == pytest.approx([0.06, 0.11, 0.8], abs=1e-12)


def test_the_search_by_blocks_misses_no_crossing(shape: Shape) -> None:
    axes = [torch.linspace(-1.05, 1.2, 31, dtype=torch.float64)] * 3
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    near = near_values(shape.level_set, grid)
    every = shape.level_set.values(grid.reshape(-1, 3)).reshape(grid.shape[:-1])
    for axis in range(3):
        # The product of two values is negative where their edge crosses the level, and never where one is no number.
        found, there = ((v.narrow(axis, 0, 30) * v.narrow(axis, 1, 30) < 0) for v in (near, every))
        assert torch.equal(found, there)
    assert near.isnan().any()


def test_a_long_box_is_searched_with_cubic_cells(rng: np.random.Generator) -> None:
    box = Box(np.array([-5.0, -1.0, -1.0]), np.array([5.0, 1.0, 1.0]))
    rod = level_set(lambda x: torch.hypot(x[:, 1], x[:, 2]) - 0.5, box)
    sample = sample_surface(rod, 2000, rng)
    assert sample.area == pytest.approx(10 * np.pi, rel=0.02)
    counts = np.histogram(sample.points[:, 0].numpy(), 10, (-5, 5))[0]
    assert np.ptp(counts) < 60

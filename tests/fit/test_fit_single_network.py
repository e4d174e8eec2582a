"""Whole fits of an analytic sphere, wide and deep, small enough for seconds."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from made_shapes import bored_plate
from numpy.typing import NDArray

from gnrecon.fit import FitOptions, NeuralSDF, fit
from gnrecon.fit.fit_options import NORMAL_RESIDUALS, OPTIMISERS, SEARCHES
from gnrecon.fit.objective import Scene
from gnrecon.fit.parameters import SingleNetworkParameters
from gnrecon.fit.single_network import hold_out
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.least_squares import SOLVERS
from gnrecon.optim import Record
from gnrecon.runtime.errors import FitError, UsageError

Float = NDArray[np.float64]

RADIUS = 0.9
FRAME = Frame(np.array([500_000.0, 4_500_000.0, 100.0]), 20.0)


def directions(count: int, seed: int) -> Float:
    rows = np.random.default_rng(seed).standard_normal((count, 3))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def sphere(count: int = 600) -> Samples:
    normals = directions(count, 0)
    return Samples(RADIUS * normals, normals, FRAME)


def radii(sdf: NeuralSDF, rays: Float) -> Float:
    """Where the rays from the centre, of shape (N, 3), leave the surface, in unit coordinates, by bisection."""
    inner, outer = np.full(len(rays), 0.85 * RADIUS), np.full(len(rays), 1.1 * RADIUS)
    for inside, ends in ((True, inner), (False, outer)):
        assert np.all((sdf.sdf(FRAME.to_world(ends[:, None] * rays)) < 0) == inside)
    for _ in range(30):
        middle = (inner + outer) / 2
        within = sdf.sdf(FRAME.to_world(middle[:, None] * rays)) < 0
        inner, outer = np.where(within, middle, inner), np.where(within, outer, middle)
    return (inner + outer) / 2


def mean_angle(sdf: NeuralSDF, rays: Float) -> float:
    """Mean angle between the field's normals and the sphere's, in degrees."""
    cosines = np.einsum("ij,ij->i", sdf.normals(FRAME.to_world(RADIUS * rays)), rays)
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).mean())


def test_wide_fit_of_a_sphere() -> None:
    samples = sphere()
    # With 400 features three of eight seeds leave the sphere somewhere; with 600 none does.
    sdf, solution = fit(samples, FitOptions(widths=(600,), steps=1))
    rays = directions(500, 1)
    error = np.abs(radii(sdf, rays) / RADIUS - 1)
    assert error.mean() < 0.01
    assert np.quantile(error, 0.95) < 0.02
    assert mean_angle(sdf, rays) < 6
    deep = np.linspace(0.1, 0.8, 500)[:, None] * rays
    assert np.all(sdf.sdf(FRAME.to_world(deep)) < 0), "no second sheet within"
    at_data = FRAME.to_world(samples.points)
    assert np.abs(sdf.sdf(at_data)).mean() < 0.01 * RADIUS * FRAME.scale
    assert np.linalg.norm(sdf.gradient(at_data), axis=1).mean() == pytest.approx(1.0, abs=0.1)
    assert len(solution.history) == 1
    assert not solution.interrupted
    assert sdf.theta.dtype == torch.float64
    assert sdf.frame is samples.frame


@pytest.mark.parametrize("normals", NORMAL_RESIDUALS)
def test_deep_fit_of_a_sphere(normals: str) -> None:
    records: list[Record] = []
    sdf, solution = fit(sphere(), FitOptions(widths=(24, 24), steps=40, normals=normals), records.append)
    rays = directions(500, 1)
    assert np.abs(radii(sdf, rays) / RADIUS - 1).mean() < 0.025
    assert mean_angle(sdf, rays) < 6
    assert tuple(records) == solution.history
    assert len(records) == 40
    assert all(record.loss < record.before for record in records)
    assert "geodesic" in solution.method


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("widths", [(40,), (8, 8)], ids=str)
def test_every_search_lowers_the_loss(search: str, widths: tuple[int, ...]) -> None:
    sdf, solution = fit(sphere(), FitOptions(widths=widths, steps=2, search=search))
    assert all(record.loss < record.before for record in solution.history)
    assert np.all(np.isfinite(sdf.sdf(FRAME.to_world(directions(50, 2)))))


@pytest.mark.parametrize(("optimiser", "steps"), [("gn", 20), ("adam", 1000), ("lbfgs", 10)])
def test_every_optimiser_lowers_the_loss_of_a_deep_network(optimiser: str, steps: int) -> None:
    sdf, solution = fit(sphere(), FitOptions(widths=(16, 16), steps=steps, optimiser=optimiser))
    assert len(solution.history) == steps
    losses, third = [record.loss for record in solution.history], steps // 3
    assert np.mean(losses[-third:]) < np.mean(losses[:third])
    assert np.abs(sdf.sdf(FRAME.to_world(RADIUS * directions(50, 2)))).mean() < 0.05 * FRAME.scale


@pytest.mark.parametrize("optimiser", OPTIMISERS)
def test_every_optimiser_lowers_the_loss_of_a_wide_network(optimiser: str) -> None:
    solution = fit(sphere(150), FitOptions(widths=(40,), steps=12, optimiser=optimiser))[1]
    assert solution.history[-1].loss < solution.history[0].before


# In row space a step's ten thousand rows take minutes; `tests/linalg` and `tests/optim` have it on smaller ones.
@pytest.mark.parametrize("solver", [name for name in SOLVERS if name != "row-space"])
def test_every_solver_fits(solver: str) -> None:
    # GMRES takes a second for a step.
    steps = 10 if solver == "gmres" else 20
    sdf, solution = fit(sphere(), FitOptions(widths=(16, 16), steps=steps, solver=solver))
    assert all(record.loss < record.before for record in solution.history)
    assert np.abs(sdf.sdf(FRAME.to_world(RADIUS * directions(50, 2)))).mean() < 0.03 * FRAME.scale


def test_held_out_points_are_not_fitted_and_end_the_fit() -> None:
    rng = np.random.default_rng(0)
    scene = Scene.of(sphere(1200), "cpu", rng)
    fitted, held = hold_out(scene, rng)
    assert held is not None
    assert len(held.points) == 60
    together = torch.cat([fitted.points, held.points])
    assert torch.equal(together[together[:, 0].argsort()], scene.points[scene.points[:, 0].argsort()])
    few, none = hold_out(Scene.of(sphere(999), "cpu", rng), rng)
    assert none is None
    assert len(few.points) == 999


def test_a_fit_keeps_the_parameters_of_the_least_held_out_residuals() -> None:
    noise = 0.02 * np.random.default_rng(1).standard_normal((1000, 1))
    samples = sphere(1000)
    noisy = Samples(samples.points * (1 + noise), samples.normals, FRAME)
    sdf, solution = fit(noisy, FitOptions(widths=(16, 16), steps=80))
    values = [record.held_out for record in solution.history]
    assert all(value is not None for value in values)
    assert "held-out" in solution.status
    assert len(values) < 80  # 36 to 43, by the rounding of the processor and its threads
    assert np.abs(sdf.sdf(FRAME.to_world(RADIUS * directions(200, 2)))).mean() < 0.01 * FRAME.scale


@pytest.mark.parametrize("widths", [(40,), (8, 8)], ids=str)
def test_same_seed_same_bits(widths: tuple[int, ...]) -> None:
    first, again, other = (fit(sphere(150), FitOptions(widths=widths, steps=2, seed=seed))[0] for seed in (3, 3, 4))
    assert torch.equal(first.theta, again.theta)
    assert not torch.equal(first.theta, other.theta)


def test_a_scan_with_a_narrow_gap_gets_no_sheet_across_free_space() -> None:
    # Two plates a tenth of their side apart: a field that is only near the points may have any sign elsewhere.
    rng = np.random.default_rng(3)
    lower, upper = (bored_plate(1500, 0.6, 0.05, 0.2, seed=seed) for seed in (1, 2))
    points = np.concatenate([lower[0] - [0, 0, 0.11], upper[0] + [0, 0, 0.11]])
    sdf, _ = fit(
        Samples(points, np.concatenate([lower[1], upper[1]]), FRAME), FitOptions(widths=(24, 24, 24), steps=60)
    )
    x = rng.uniform(-0.75, 0.75, (4000, 3))
    offset = np.abs(np.abs(x[:, 2]) - 0.11) - 0.05
    across, bore = np.abs(x[:, :2]).max(axis=1) - 0.6, 0.2 - np.hypot(x[:, 0], x[:, 1])
    outside = np.max([offset, across, bore], axis=0)
    clear = np.abs(outside) > 0.03
    wrong = (sdf.sdf(FRAME.to_world(x[clear])) < 0) != (outside[clear] < 0)
    assert wrong.mean() < 0.005


def test_more_points_than_a_step_takes() -> None:
    assert SingleNetworkParameters.step_points < 4500
    sdf, solution = fit(sphere(4500), FitOptions(widths=(40,), steps=1))
    assert np.abs(sdf.sdf(FRAME.to_world(RADIUS * directions(50, 2)))).mean() < 0.03 * FRAME.scale
    assert solution.history[0].loss < solution.history[0].before


def test_no_steps_leave_the_start() -> None:
    sdf, solution = fit(sphere(150), FitOptions(widths=(40,), steps=0))
    assert solution.history == ()
    assert float(sdf.theta.abs().max()) > 0


def test_an_interrupt_keeps_the_field_so_far() -> None:
    def callback(record: Record) -> None:
        if record.step == 2:
            raise KeyboardInterrupt

    options = FitOptions(widths=(40,), steps=50)
    sdf, solution = fit(sphere(150), options, callback)
    assert solution.interrupted
    assert len(solution.history) == 2
    assert torch.equal(sdf.theta, solution.theta)
    assert np.all(np.isfinite(sdf.sdf(FRAME.to_world(directions(50, 2)))))


def test_normals_that_are_not_finite_end_with_a_sentence() -> None:
    samples = sphere(150)
    broken = samples.normals.copy()
    broken[7] = np.nan
    with pytest.raises(FitError, match="not finite"):
        fit(Samples(samples.points, broken, FRAME), FitOptions(widths=(40,), steps=1))


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"widths": ()}, r"\(\)"),
        ({"widths": (20, 0)}, "20, 0"),
        ({"steps": -1}, "-1"),
        ({"normals": "sideways"}, "sideways"),
        ({"search": "blind"}, "blind"),
        ({"solver": "gauss"}, "gauss"),
        ({"optimiser": "sgd"}, "sgd"),
    ],
)
def test_options_out_of_range(wrong: dict[str, object], named: str) -> None:
    with pytest.raises(UsageError, match=named):
        FitOptions(**wrong)  # type: ignore[arg-type]


def test_every_choice_of_the_options_is_accepted() -> None:
    for search in SEARCHES:
        for normals in NORMAL_RESIDUALS:
            options = FitOptions(search=search, normals=normals)
            assert FitOptions(**options.as_dict()) == options
    assert FitOptions(steps=7).steps_for(10) == 7
    wide = FitOptions(widths=(1000,))
    assert FitOptions(widths=(32, 32)).steps_for(500) > wide.steps_for(1000) > wide.steps_for(999) == 0
    assert FitOptions(quality="draft").steps_for(1000) == 0 < FitOptions().steps_for(1000)


def test_the_network_grows_with_the_points() -> None:
    widths = [FitOptions().widths_for(points) for points in (100, 500, 5000, 10_000, 100_000)]
    assert widths == [(1000,), (1500,), (2000,), (2500,), (3000,)]
    assert FitOptions(widths=(8, 9)).widths_for(100_000) == (8, 9)


def test_normals_as_cosines_start_from_a_linear_solve(rng: np.random.Generator) -> None:
    points = rng.standard_normal((400, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    samples = Samples(points, points, Frame(np.zeros(3), 1.0))
    sdf, _ = fit(samples, FitOptions(widths=(300,), steps=1, normals="cosine"))
    assert np.abs(sdf.sdf(points)).mean() < 0.01

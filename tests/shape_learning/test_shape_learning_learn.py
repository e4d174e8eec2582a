"""Learning: constraints are met, runs are reproducible, and what goes wrong is said."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from gnrecon.export import require_bordered, require_sound
from gnrecon.field import Network
from gnrecon.geometry.signed_distance import Box
from gnrecon.residuals import eikonal, interface, mean_curvature
from gnrecon.runtime.errors import MeshError, UsageError
from gnrecon.shape_learning import (
    Measurement,
    ShapeProblem,
    Term,
    at_points,
    catenoid,
    cube,
    in_box,
    learn,
    mesh_of,
    on_surface,
)

learning = sys.modules["gnrecon.shape_learning.learn"]  # the package has a function of that name

SMALL = Network((10, 10))


def half_ball() -> ShapeProblem:
    """A sphere of radius 0.5 from its own points alone; the start is a cube's rounded inside."""
    directions = np.random.default_rng(5).normal(size=(300, 3))
    points = 0.5 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return ShapeProblem(
        "ball",
        (Term("interface", interface, at_points(points)), Term("eikonal", eikonal, in_box(200), 1e-4)),
        cube(0.8),
        lambda x: (x.square().sum(1) - 0.1) / 2,
        SMALL,
    )


def sheet(target: float = 0.3) -> ShapeProblem:
    """A plane at a height, from four of its points and mean curvature."""
    corners = np.array([[x, y, target] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    return ShapeProblem(
        "sheet",
        (
            Term("interface", interface, at_points(corners)),
            Term("mean curvature", mean_curvature, on_surface(60, nodes=4000)),
        ),
        cube(1.0),
        lambda x: x[:, 2] + 0.2 * x[:, 0] ** 2,
        SMALL,
    )


@pytest.mark.parametrize(("optimiser", "steps", "share"), [("gn", 12, 0.1), ("lbfgs", 2, 0.2), ("adam", 60, 0.9)])
def test_each_optimiser_lowers_the_loss(optimiser: str, steps: int, share: float) -> None:
    measurements: list[Measurement] = []
    learned = learn(half_ball(), optimiser, budget=None, steps=steps, learning_rate=3e-3, callback=measurements.append)
    assert measurements == list(learned.history)
    assert measurements[0].step == 0
    assert learned.best.loss == min(found.loss for found in measurements)
    assert learned.best.loss < share * measurements[0].loss
    assert learned.best.loss == pytest.approx(sum(learned.best.shares.values()))
    assert learned.best.chamfer is None


def test_the_loss_is_that_of_the_field_that_is_returned() -> None:
    learned = learn(half_ball(), budget=None, steps=20)
    mesh = mesh_of(learned.field, cube(0.8), 24)
    require_sound(mesh)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.5, atol=5e-3)


def test_a_surface_follows_its_curvature_to_a_plane() -> None:
    learned = learn(sheet(), budget=None, steps=15)
    assert learned.best.loss < 1e-5 * learned.history[0].loss
    mesh = mesh_of(learned.field, Box(np.full(3, -0.5), np.full(3, 0.5)), 16)
    facts = require_bordered(mesh)
    assert not facts.closed
    np.testing.assert_allclose(mesh.vertices[:, 2], 0.3, atol=0.02)
    np.testing.assert_allclose(mesh.vertices[:, :2].min(axis=0), -0.5, atol=1e-6)
    np.testing.assert_allclose(mesh.vertices[:, :2].max(axis=0), 0.5, atol=1e-6)
    assert mesh.normals is not None


def test_the_same_seed_gives_the_same_parameters() -> None:
    one, two, other = (learn(sheet(), budget=None, steps=3, seed=seed) for seed in (4, 4, 5))
    assert torch.equal(one.field.theta, two.field.theta)
    assert not torch.equal(one.field.theta, other.field.theta)


def test_the_catenoid_is_approached() -> None:
    found: list[Measurement] = []
    learned = learn(replace(catenoid(), network=Network((16, 16))), budget=None, steps=12, callback=found.append)
    assert learned.best.chamfer is not None
    assert learned.best.chamfer < 0.5 * found[0].chamfer
    assert learned.best.loss < 0.01 * found[0].loss


def test_a_budget_ends_the_run() -> None:
    learned = learn(sheet(), budget=1.5)
    assert learned.seconds < 60.0
    assert "Stopped after" in learned.solution.status or not learned.solution.history


def test_a_vanished_surface_keeps_the_best_until_then() -> None:
    # Far below the box: the surface follows its points out of it.
    problem = sheet(target=-3.0)
    learned = learn(problem, budget=None, steps=40)
    assert "no zero level" in learned.solution.status
    assert np.isfinite(learned.best.loss)


def test_the_mean_of_the_last_steps_is_returned_where_it_is_better(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[torch.Tensor] = []

    def measured(run: object, step: int, theta: torch.Tensor) -> Measurement:
        del run
        seen.append(theta)
        # Of each pair, the later one is the mean.
        return Measurement(step, 0.0, 1.0 / len(seen), {}, None, None)

    monkeypatch.setattr(learning._LearningRun, "measured", measured)
    learned = learn(half_ball(), budget=None, steps=4)
    start, one, two = seen[0], learned.solution.theta, learned.field.theta
    assert not torch.equal(one, two)
    assert torch.equal(two, seen[-1])
    assert torch.equal(one, seen[-2])
    assert learned.best.loss == learned.history[-1].loss
    # Nearer to the last parameters than to the first.
    assert float((two - one).norm()) < 0.6 * float((start - one).norm())


def test_what_makes_no_sense_is_refused() -> None:
    with pytest.raises(UsageError, match="newton"):
        learn(sheet(), "newton")
    for keywords in ({"budget": None}, {"budget": -1.0}, {"steps": 0}):
        with pytest.raises(UsageError, match="budget"):
            learn(sheet(), **keywords)


def test_a_box_without_surface_is_no_mesh() -> None:
    learned = learn(sheet(), budget=None, steps=1)
    with pytest.raises(MeshError, match="no"):
        mesh_of(learned.field, Box(np.full(3, 0.9), np.full(3, 1.0)), 16)

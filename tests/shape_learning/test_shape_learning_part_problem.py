"""The design of a part: its terms draw what they should, and a few steps bring the part nearer to its design."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gnrecon.field import Network
from gnrecon.field.layers import WAVELET
from gnrecon.level_set import LevelSet
from gnrecon.shape_learning import ShapeProblem, bracket, learn
from gnrecon.shape_learning.design import Design, read_design
from gnrecon.shape_learning.learn import pretrained
from gnrecon.shape_learning.learning_parameters import ShapeLearningParameters
from gnrecon.shape_learning.shape_problem import SampledPoints, StepState

LAST = ShapeLearningParameters.measurement_step

part = ShapeLearningParameters.part
SMALL = Network((8, 8), WAVELET, (6.0, 2.0))


@pytest.fixture(scope="module")
def design(repository: Path) -> Design:
    data = repository / "sample_data"
    return read_design(data / "design_region.stl", data / "design_interfaces.stl")


@pytest.fixture(scope="module")
def problem(design: Design) -> ShapeProblem:
    return bracket(design, network=SMALL)


def balls(x: torch.Tensor) -> torch.Tensor:
    """Two balls apart, one in each foot of the sample's region."""
    centers = torch.tensor([[-0.6, 0.0, -0.5], [0.6, 0.0, -0.5]], dtype=x.dtype)
    return (x[:, None] - centers).norm(dim=2).amin(1) - 0.1


def moment(problem: ShapeProblem, step: int, shift: float = 0.0) -> StepState:
    def value_and_gradient(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        with torch.enable_grad():
            leaf = x.detach().requires_grad_()
            value = balls(leaf) + shift
            (gradient,) = torch.autograd.grad(value.sum(), leaf)
        return value.detach(), gradient

    level_set = LevelSet(lambda x: balls(x) + shift, value_and_gradient, problem.box)
    return StepState(step, level_set, np.random.default_rng(0))


def drawn(problem: ShapeProblem, name: str, when: StepState) -> SampledPoints:
    (term,) = (term for term in problem.terms if term.name == name)
    return term.sampler(when)


def test_points_to_be_kept_free_are_outside_or_just_inside(problem: ShapeProblem, design: Design) -> None:
    found = drawn(problem, "design region", moment(problem, 1, shift=-0.5))
    distance = design.region.distance(found.points.numpy())
    assert distance.min() > -1.1 * part.layer_depth
    assert 0.02 < (distance < 0).mean() < 0.3
    # Half the distance is the least value, and the others are farther from the part than a step will take it.
    assert found.target is not None
    np.testing.assert_allclose(found.target, np.maximum(distance, 0) / 2, atol=1e-6)
    assert (balls(found.points) - 0.5 - found.target < part.active_value).all()
    assert 0.1 < found.share < 1


def test_the_layer_within_the_border_leaves_the_interfaces_alone(problem: ShapeProblem, design: Design) -> None:
    found = drawn(problem, "design region", moment(problem, 1, shift=-3.0)).points.numpy()
    assert drawn(problem, "design region", moment(problem, 1, shift=-3.0)).share == 1
    walls = design.interfaces.sample(6000, np.random.default_rng(1)).points
    nearest = np.linalg.norm(found[:, None] - walls[None, ::3], axis=2).min(axis=1)
    inside = -design.region.distance(found)
    assert (inside < part.layer_depth_per_interface_distance * nearest + 1e-3).all()


def test_the_strain_is_that_of_the_free_surface(problem: ShapeProblem, design: Design) -> None:
    found = drawn(problem, "surface strain", moment(problem, 1))
    assert found.on_surface
    assert balls(found.points).abs().max() < 1e-10
    walls = design.interfaces.sample(30_000, np.random.default_rng(1)).points
    nearest = np.linalg.norm(found.points.numpy()[:100, None] - walls[None], axis=2).min(axis=1)
    assert nearest.min() > 0.015


def test_interfaces_come_with_their_normals(problem: ShapeProblem) -> None:
    found = drawn(problem, "normal", moment(problem, 1))
    assert found.target is not None
    torch.testing.assert_close(found.target.norm(dim=1), torch.ones(len(found.target), dtype=torch.float64))


def test_components_are_joined_one_step_later(design: Design) -> None:
    fresh = bracket(design, network=SMALL)
    # The first answer is to its own field; from then on each is to the one before.
    assert len(drawn(fresh, "connectedness", moment(fresh, 1)).points) == 1
    apart = drawn(fresh, "connectedness", moment(fresh, 2, shift=-0.9))
    assert apart.target is not None
    assert apart.target.tolist() == [-0.02]
    assert float(apart.points[0, 0]) == pytest.approx(0.0, abs=0.05)
    assert len(drawn(fresh, "connectedness", moment(fresh, 3)).points) == 0
    # A measurement waits for its own.
    assert len(drawn(fresh, "connectedness", moment(fresh, LAST, shift=-0.9)).points) == 0


def test_the_strain_can_be_clipped(design: Design) -> None:
    names = [term.residual.name for term in bracket(design, clip=50.0).terms if term.name == "surface strain"]  # type: ignore[union-attr]
    assert names == ["surface strain, at most 50"]


def test_clipping_begins_far_above_its_maximum(design: Design) -> None:
    clipped, whole = (bracket(design, network=SMALL, clip=clip) for clip in (50.0, None))
    assert drawn(whole, "surface strain", moment(whole, 1)).target is None
    found = [drawn(clipped, "surface strain", moment(clipped, step)) for step in (1, 100, 1000, LAST)]
    maxima = [float(one.target.unique()) for one in found if one.target is not None]
    assert maxima == pytest.approx([50 * 99.0, 50 * 100 * 0.99**100, 50.0, 50.0])


def test_the_start_is_the_region_eroded_except_at_the_interfaces(problem: ShapeProblem, design: Design) -> None:
    walls = design.interfaces.sample(2000, np.random.default_rng(2)).points
    np.testing.assert_allclose(problem.start(torch.as_tensor(walls)), design.region.distance(walls), atol=2e-3)
    points = design.region.around(5000, np.random.default_rng(3))
    off = cKDTree(design.interfaces.sample(30_000, np.random.default_rng(2)).points).query(points)[0]
    worn = problem.start(torch.as_tensor(points)).numpy() - design.region.distance(points)
    np.testing.assert_allclose(worn[off > 0.1], part.erosion_depth, atol=1e-6)
    assert (worn > -1e-6).all()


def test_pretraining_brings_the_part_to_its_interfaces(design: Design) -> None:
    problem = bracket(design, network=SMALL)
    theta = pretrained(problem, 0, np.random.default_rng(0), seconds=20.0)
    plain = pretrained(replace(problem, pretraining=None), 0, np.random.default_rng(0))
    walls = torch.as_tensor(design.interfaces.sample(2000, np.random.default_rng(2)).points)
    away, plainly = (float(problem.level_set(found).values(walls).abs().mean()) for found in (theta, plain))
    assert away < 0.2 * plainly


def test_a_few_steps_bring_the_part_nearer_to_its_design(design: Design) -> None:
    quick = replace(part, pretraining_steps=10, pool_points=30_000, region_points=2000, component_cells=32)
    learned = learn(bracket(design, network=SMALL, parameters=quick), budget=None, steps=3)
    first, last = learned.history[0], learned.best
    assert last.loss < 0.9 * first.loss
    assert set(last.shares) == {"design region", "interface", "normal", "surface strain", "connectedness", "eikonal"}
    # Work in parallel to the steps does not make a run depend on the load of the machine.
    again = learn(bracket(design, network=SMALL, parameters=quick), budget=None, steps=3)
    assert torch.equal(again.field.theta, learned.field.theta)

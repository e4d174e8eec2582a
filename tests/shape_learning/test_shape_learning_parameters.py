"""The parameters of shape learning: frozen, all of them used, and with effect."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
import torch
from parameter_checks import assert_frozen, read_attributes

import gnrecon.shape_learning
from gnrecon.field import Network
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.shape_learning import ShapeLearningParameters, catenoid, learn, minimal_surface, scanned
from gnrecon.shape_learning.learn import pretrained
from gnrecon.shape_learning.learning_parameters import (
    CurveParameters,
    PartParameters,
    RunParameters,
    ScanParameters,
)
from gnrecon.shape_learning.problems import box_around

EACH = pytest.mark.parametrize(
    "parameters", [RunParameters(), CurveParameters(), PartParameters(), ScanParameters(), ShapeLearningParameters()]
)
CURVE = np.stack([np.cos(np.arange(40)), np.sin(np.arange(40)), 0.2 * np.cos(2 * np.arange(40))], axis=1)


@EACH
def test_they_are_frozen(parameters: object) -> None:
    assert is_dataclass(parameters)
    assert_frozen(parameters)


@EACH
def test_each_is_used(parameters: object) -> None:
    assert is_dataclass(parameters)
    assert {field.name for field in fields(parameters)} <= read_attributes(gnrecon.shape_learning)


def test_points_and_weights_of_curves() -> None:
    default = ShapeLearningParameters.curves
    changed = replace(default, curve_points=7, weight_hold_steps=2, box_margin_sides=1.0)
    plain, given, other = (
        minimal_surface(CURVE, **options)  # type: ignore[arg-type]
        for options in ({}, {"parameters": default}, {"parameters": changed})
    )
    for step in (1, 3, 45, 10**6):
        assert plain.terms[0].weight_at(step) == given.terms[0].weight_at(step)
    assert [problem.terms[0].weight_at(3) for problem in (plain, other)] == [1.0, changed.weight_growth]
    np.testing.assert_array_equal(plain.box.lower, box_around(CURVE).lower)
    assert (other.box.lower < plain.box.lower).all()
    theta = torch.zeros(plain.network.layout.count, dtype=torch.float64)
    drawn = [
        len(problem.freeze(1, theta, np.random.default_rng(0), problem.terms[:1]).terms[0].points)
        for problem in (plain, given, other)
    ]
    assert drawn == [40, 40, 7]


def test_the_network_and_the_box_of_a_scan() -> None:
    points = np.random.default_rng(0).standard_normal((60, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    samples = Samples(points, points, Frame(np.zeros(3), 1.0))
    plain = scanned(samples)
    assert plain.network == scanned(samples, parameters=ScanParameters()).network
    other = scanned(samples, parameters=replace(ScanParameters(), widths=(5,), box_margin_radii=0.5))
    assert other.network.widths == (5,)
    np.testing.assert_allclose(plain.box.upper - other.box.upper, -0.3)


def test_pretraining_and_the_first_measurement_of_a_run() -> None:
    problem = replace(catenoid(), network=Network((4,)))
    short = replace(ShapeLearningParameters.run, pretraining_steps=1, first_measurement=1.0)

    def start(*parameters: RunParameters) -> torch.Tensor:
        return pretrained(problem, 0, np.random.default_rng(0), None, *parameters)

    assert torch.equal(start(), start(RunParameters()))
    assert not torch.equal(start(), start(short))
    learned = learn(problem, budget=None, steps=2, parameters=short)
    assert [found.step for found in learned.history] == [0, 1, 2]

"""Tuning constants of the fit: frozen, all of them used, and their defaults are what a fit uses."""

from __future__ import annotations

import dataclasses
import inspect

import numpy as np
import pytest
import torch
from parameter_checks import assert_frozen, read_attributes

import gnrecon.fit
from gnrecon.fit import FitOptions, fit, parameters, two_level
from gnrecon.fit.consistency import find_outliers
from gnrecon.fit.local_fields import cube_length
from gnrecon.fit.model_selection import Hyperparameters
from gnrecon.fit.objective import normal_weight
from gnrecon.fit.parameters import (
    FitParameters,
    LocalFieldParameters,
    OutlierParameters,
    SingleNetworkParameters,
    TwoLevelParameters,
)
from gnrecon.fit.shape_priors.prior_parameters import BallFitParameters
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame, Samples
from gnrecon.geometry.signed_distance import Density

CLASSES = [
    found
    for _, found in inspect.getmembers(parameters, dataclasses.is_dataclass)
    if found.__module__ == parameters.__name__
]


@pytest.mark.parametrize("group", CLASSES, ids=lambda group: group.__name__)
def test_groups_are_frozen_and_have_defaults(group: type) -> None:
    assert_frozen(group())


def test_every_constant_is_used() -> None:
    used = read_attributes(gnrecon.fit, "parameters.py")
    groups = [group for group in CLASSES if group is not FitParameters]
    unused = [(group.__name__, field.name) for group in groups for field in dataclasses.fields(group)]
    assert [both for both in unused if both[1] not in used] == []


def test_the_default_fit_takes_every_group_of_the_whole() -> None:
    source = inspect.getsource(two_level)
    assert [f.name for f in dataclasses.fields(FitParameters) if f"parameters.{f.name}" not in source] == []


def test_the_parameters_of_a_fit_take_effect() -> None:
    z = 1 - (2 * np.arange(200) + 1) / 200
    angle, ring = np.pi * (1 + 5**0.5) * np.arange(200), np.sqrt(1 - z**2)
    points = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    samples = Samples(points, points, Frame(np.zeros(3), 1.0))
    options = FitOptions(quality="draft")
    default, solution = fit(samples, options)
    assert torch.equal(default.theta, fit(samples, options, parameters=FitParameters())[0].theta)
    no_ball = FitParameters(ball=BallFitParameters(min_points=1000))
    few = FitParameters(two_level=TwoLevelParameters(global_field_points=100))
    assert "ball" in solution.status
    assert "ball" not in fit(samples, options, parameters=no_ball)[1].status
    assert not torch.equal(fit(samples, options, parameters=few)[0].theta, default.theta)


def test_a_cube_of_sparse_points_is_as_long_as_the_limit_says() -> None:
    hyperparameters, disks = Hyperparameters(0.1, 1e-3, 0.05), np.full(5, 10.0)
    assert cube_length(hyperparameters, disks, 1.0) == pytest.approx(0.1 * LocalFieldParameters.most_length_stretch)
    assert cube_length(hyperparameters, disks, 1.0, most_length_stretch=2.0) == pytest.approx(0.2)


def test_the_default_thresholds_find_the_outliers() -> None:
    rng = np.random.default_rng(0)
    points = rng.standard_normal((500, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    value: Float = np.where(np.arange(500) < 5, 0.5, 0.0)
    found = find_outliers(value, Density(points))
    assert np.flatnonzero(found).tolist() == [0, 1, 2, 3, 4]
    assert (found == find_outliers(value, Density(points), parameters=OutlierParameters())).all()
    assert not find_outliers(value, Density(points), parameters=OutlierParameters(most_share=0.001)).any()


def test_default_steps_and_units_are_those_of_the_parameters() -> None:
    options, chosen = FitOptions(normals="projection"), SingleNetworkParameters()
    assert options.steps_for(5000) == options.steps_for(5000, parameters=chosen) == chosen.wide_steps
    assert options.steps_for(5000, parameters=SingleNetworkParameters(wide_steps=7)) == 7
    assert options.widths_for(10, parameters=SingleNetworkParameters(least_units=50)) == (50,)


def test_normals_of_sparse_data_weigh_more() -> None:
    assert normal_weight(0.1) == pytest.approx(0.04**2)
    assert normal_weight(0.1, least_reach_radii=0.1) == pytest.approx(0.01)

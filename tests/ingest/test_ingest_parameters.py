"""Tuning constants of ingest: frozen, all of them used, and their defaults are what ingest uses."""

from __future__ import annotations

import dataclasses
import inspect

import numpy as np
import pytest
from made_shapes import sphere
from parameter_checks import assert_frozen, read_attributes

import gnrecon.ingest
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import clean, find_outliers, ingest_parameters, prepare
from gnrecon.ingest.double_walls import find_layers
from gnrecon.ingest.ingest_parameters import (
    DensityOutlierParameters,
    DoubleWallParameters,
    IngestParameters,
    NormalParameters,
    SmoothingParameters,
)
from gnrecon.ingest.normals import unoriented_normals
from gnrecon.ingest.smooth import smooth_points
from gnrecon.runtime.errors import InputError

CLASSES = [found for _, found in inspect.getmembers(ingest_parameters, dataclasses.is_dataclass)]


@pytest.mark.parametrize("group", CLASSES, ids=lambda group: group.__name__)
def test_groups_are_frozen_and_have_defaults(group: type) -> None:
    assert_frozen(group())


def test_every_constant_is_used() -> None:
    used = read_attributes(gnrecon.ingest, "ingest_parameters.py")
    fields = [(group.__name__, field.name) for group in CLASSES for field in dataclasses.fields(group)]
    # `layers_of` takes the group of double walls itself, because it is called after `prepare`.
    assert [both for both in fields if both[1] not in used] == [("IngestParameters", "double_walls")]


def test_the_whole_holds_every_group() -> None:
    held = {type(getattr(IngestParameters(), field.name)) for field in dataclasses.fields(IngestParameters)}
    assert held == {int, *(group for group in CLASSES if group is not IngestParameters)}


def test_outlier_thresholds(rng: np.random.Generator) -> None:
    points = np.vstack([sphere(2000, rng)[0], [[0.0, 0.0, 1.8], [0.0, 1.7, 0.0]]])
    found = find_outliers(points)
    assert np.flatnonzero(found).tolist() == [2000, 2001]
    assert (found == find_outliers(points, parameters=DensityOutlierParameters())).all()
    assert not find_outliers(points, parameters=DensityOutlierParameters(passes=0)).any()


def test_sizes_of_neighbourhoods(rng: np.random.Generator) -> None:
    points = sphere(1000, rng)[0] * (1 + 0.02 * rng.normal(size=(1000, 1)))
    default = unoriented_normals(points)
    np.testing.assert_array_equal(default, unoriented_normals(points, parameters=NormalParameters()))
    assert not np.array_equal(default, unoriented_normals(points, parameters=NormalParameters(neighbours=(12,))))


def test_least_neighbours_for_smoothing(rng: np.random.Generator) -> None:
    points, normals = sphere(500, rng)
    moved, _ = smooth_points(points, normals, 0.3)
    again, _ = smooth_points(points, normals, 0.3, parameters=SmoothingParameters())
    np.testing.assert_array_equal(moved, again)
    assert not np.array_equal(moved, points)
    still, _ = smooth_points(points, normals, 0.3, parameters=SmoothingParameters(least_neighbours=400))
    np.testing.assert_array_equal(still, points)


def test_layers_need_enough_places(rng: np.random.Generator) -> None:
    points, normals = sphere(6000, rng)
    double = points + np.where(rng.uniform(size=(6000, 1)) < 0.5, 0.06, 0.0) * normals
    found = find_layers(double, normals)
    assert found is not None
    assert found == find_layers(double, normals, parameters=DoubleWallParameters())
    assert find_layers(double, normals, parameters=DoubleWallParameters(least_offset_spacings=50.0)) is None


def test_parameters_reach_the_steps(rng: np.random.Generator) -> None:
    cloud = PointCloud(np.vstack([sphere(2000, rng)[0], [[0.0, 0.0, 1.8]]]))
    off = IngestParameters(outliers=DensityOutlierParameters(passes=0))
    assert (prepare(cloud)[1].outliers, prepare(cloud, parameters=off)[1].outliers) == (1, 0)
    with pytest.raises(InputError, match="needs at least 3000"):
        clean(cloud, parameters=IngestParameters(least_points=3000))

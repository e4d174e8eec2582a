"""Parameters of the shape priors: frozen, all of them used, and decisive."""

from __future__ import annotations

import ast
from dataclasses import FrozenInstanceError, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_shapes import cube, sphere

from gnrecon.fit.shape_priors import prior_parameters
from gnrecon.fit.shape_priors.ball_fit import BallFit
from gnrecon.fit.shape_priors.bilateral_filter import BilateralFilter
from gnrecon.fit.shape_priors.edge_completion import EdgeCompletion
from gnrecon.fit.shape_priors.primitive_detection import detect_primitives
from gnrecon.fit.shape_priors.prior_parameters import (
    BallFitParameters,
    BilateralParameters,
    DetectionParameters,
    EdgeParameters,
    HoleCompletionParameters,
    ResamplingParameters,
    ShapePriorParameters,
    SharpShapeParameters,
    SnappingParameters,
)
from gnrecon.fit.shape_priors.resampling import resample_primitives
from gnrecon.fit.shape_priors.sharp_shape import SharpShape
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame, Samples

CLASSES = [one for one in vars(prior_parameters).values() if isinstance(one, type) and is_dataclass(one)]
FRAME = Frame(np.zeros(3), 1.0)


def scan() -> tuple[Float, Float]:
    points, normals = cube(300, 0.7)
    return points, normals


def ball(count: int) -> Samples:
    return Samples(*sphere(count, 0, 0.8), FRAME)


def planes(*parameters: DetectionParameters) -> int:
    points, normals = scan()
    everything, rng = np.ones(len(points), dtype=bool), np.random.default_rng(0)
    return len(detect_primitives(points, normals, everything, 0.11, 0.01, rng, *parameters))


def edge_samples(*parameters: EdgeParameters) -> Float:
    return EdgeCompletion(*scan(), *parameters).samples()[0]


@pytest.mark.parametrize("parameters", CLASSES)
def test_they_are_frozen(parameters: type[Any]) -> None:
    with pytest.raises(FrozenInstanceError):
        setattr(parameters(), fields(parameters)[0].name, 1)


@pytest.mark.parametrize("parameters", CLASSES)
def test_each_is_used(parameters: type[Any]) -> None:
    sources = Path(prior_parameters.__file__).parent.glob("*.py")
    nodes = [node for path in sources for node in ast.walk(ast.parse(path.read_text()))]
    used = {node.attr for node in nodes if isinstance(node, ast.Attribute)}
    assert {field.name for field in fields(parameters)} <= used


def test_the_detection_is_by_its_parameters() -> None:
    assert planes() == planes(DetectionParameters()) == 6
    assert planes(DetectionParameters(max_primitives=2, rounds=1)) == 2
    assert planes(DetectionParameters(min_points=100)) == 0


def test_edges_are_completed_by_their_parameters() -> None:
    default = edge_samples()
    np.testing.assert_array_equal(default, edge_samples(EdgeParameters()))
    assert len(default) > len(edge_samples(EdgeParameters(edge_spacing_radii=1.0))) > 0
    assert not len(EdgeCompletion(*scan(), EdgeParameters(edge_degrees=95.0)).samples(gaps=False)[0])


def test_averaging_is_by_its_parameters() -> None:
    default = BilateralFilter(3.0, 0.4)
    assert default.parameters == BilateralParameters()
    points, normals = scan()
    points = points + 0.01 * np.random.default_rng(0).standard_normal(points.shape)
    assert not np.array_equal(default.apply(points, normals)[0], points)
    still = replace(default, parameters=BilateralParameters(passes=0))
    np.testing.assert_array_equal(still.apply(points, normals)[0], points)


def test_a_ball_is_fitted_by_its_parameters() -> None:
    samples = ball(60)
    default, explicit = BallFit.of(samples), BallFit.of(samples, BallFitParameters())
    assert default is not None
    assert explicit is not None
    np.testing.assert_array_equal(default.samples.points, explicit.samples.points)
    dense = BallFit.of(samples, BallFitParameters(min_samples=3000))
    assert dense is not None
    assert len(dense.samples) > len(default.samples)
    assert BallFit.of(samples, BallFitParameters(min_points=61)) is None


def test_primitives_are_resampled_by_their_parameters() -> None:
    default = resample_primitives(*scan())[0]
    np.testing.assert_array_equal(default, resample_primitives(*scan(), ResamplingParameters())[0])
    assert 0 < len(resample_primitives(*scan(), ResamplingParameters(max_samples_per_point=4.0))[0]) < len(default)


def test_a_sharp_shape_passes_its_parameters_on() -> None:
    samples = Samples(*scan(), FRAME)
    default, explicit = SharpShape.of(samples), SharpShape.of(samples, ShapePriorParameters())
    assert default is not None
    assert explicit is not None
    np.testing.assert_array_equal(default.samples.points, explicit.samples.points)
    plain = SharpShape.of(samples, ShapePriorParameters(resampling=ResamplingParameters(max_points=1)))
    assert plain is not None
    assert len(plain.samples) < len(default.samples)
    long = SharpShape.of(samples, ShapePriorParameters(sharp=SharpShapeParameters(exact_length_radii=5.2)))
    assert long is not None
    assert long.hyperparameters.length == pytest.approx(2 * default.hyperparameters.length)


def test_the_search_for_faces_allows_fewer_points_beside_these() -> None:
    """Its rims' share differs from that of hole completion."""
    assert SnappingParameters().detection.plane_rim_share < HoleCompletionParameters().detection.plane_rim_share

"""Attributes of points come to vertices as a plain loop over vertices says, smoothly, and in the same types."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gnrecon.export import Neighbourhood, transfer_attributes
from gnrecon.export.export_parameters import ExportParameters
from gnrecon.geometry.colors import to_linear, to_srgb
from gnrecon.geometry.point_cloud import PointCloud

UTM = np.array([431234.5, 5412345.25, 312.0])


def values(vertices: np.ndarray, points: np.ndarray, **attributes: np.ndarray) -> dict[str, np.ndarray]:
    cloud = PointCloud(points, None, attributes)
    made, sentences = transfer_attributes(vertices, cloud, list(attributes), Neighbourhood(points))
    assert sentences == []
    assert all(one.origin.endswith("nearest points") for one in made)
    return {one.name: one.values for one in made}


def slow_weights(place: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Weights of all points at one place, straight from the definition."""
    distances = np.linalg.norm(points - place, axis=1)
    order = np.argsort(distances, kind="stable")
    count = ExportParameters.attributes.nearest_points
    edge = distances[order[count]]
    width = np.sqrt((distances[order[: count + 1]] ** 2 - distances[order[0]] ** 2).mean() / 4)
    weights = np.zeros(len(points))
    for row in order[:count]:
        bell = np.exp(-(distances[row] ** 2 - distances[order[0]] ** 2) / (2 * width**2))
        weights[row] = (edge**2 - distances[row] ** 2) * bell
    return weights / weights.sum()


@pytest.mark.parametrize("offset", [np.zeros(3), UTM], ids=["near", "UTM"])
def test_all_kinds_agree_with_a_loop_over_vertices(rng: np.random.Generator, offset: np.ndarray) -> None:
    points, vertices = rng.normal(size=(300, 3)) + offset, rng.normal(size=(50, 3)) + offset
    colors = rng.integers(0, 256, (300, 3)).astype(np.uint8)
    heat, label = rng.normal(size=300).astype(np.float32), rng.integers(0, 4, 300)
    flow = rng.normal(size=(300, 2))
    made = values(vertices, points, colors=colors, heat=heat, label=label, flow=flow, intensity=100 * label)
    for row, vertex in enumerate(vertices):
        weights = slow_weights(vertex, points)
        assert made["heat"][row] == pytest.approx(weights @ heat, abs=1e-5)
        assert made["flow"][row] == pytest.approx(weights @ flow, abs=1e-6)
        assert np.abs(made["colors"][row].astype(int) - to_srgb(weights[None] @ to_linear(colors))[0]).max() <= 1
        votes = np.bincount(label, weights)
        assert votes[made["label"][row]] == pytest.approx(votes.max())
        assert abs(made["intensity"][row] - weights @ (100 * label)) < 0.51
    kinds = {name: array.dtype for name, array in made.items()}
    assert kinds == {"colors": np.uint8, "heat": np.float32, "label": np.int64, "flow": float, "intensity": np.int64}


def test_what_is_constant_stays_and_what_is_smooth_stays_close(rng: np.random.Generator) -> None:
    grid = np.stack(np.meshgrid(np.arange(40.0), np.arange(40.0), [0.0]), axis=-1).reshape(-1, 3)
    vertices = rng.uniform([5, 5, 0], [35, 35, 0.5], (200, 3))
    made = values(vertices, grid, one=np.full(1600, 3.7), slope=grid[:, 0] + np.sin(grid[:, 1] / 5))
    assert np.abs(made["one"] - 3.7).max() < 1e-12
    assert np.abs(made["slope"] - vertices[:, 0] - np.sin(vertices[:, 1] / 5)).max() < 0.35


def test_an_average_is_continuous_along_a_line(rng: np.random.Generator) -> None:
    points = rng.normal(size=(400, 3))
    line = np.linspace(-1.5, 1.5, 200_001)[:, None] * np.array([1.0, 0.3, -0.2])
    heat = values(line, points, heat=rng.normal(size=400))["heat"]
    assert np.ptp(heat) > 1
    assert np.abs(np.diff(heat)).max() < 2e-3


def test_colours_of_black_and_white_meet_at_the_mixture_of_the_lights() -> None:
    points = np.array([[0.0, 0, 0], [2, 0, 0]])
    colors = np.array([[0, 0, 0, 0], [255, 255, 255, 100]], dtype=np.uint8)
    assert values(np.array([[1.0, 0, 0]]), points, colors=colors)["colors"].tolist() == [[188, 188, 188, 50]]


def test_labels_in_text_are_not_averaged(rng: np.random.Generator) -> None:
    points = rng.normal(size=(100, 3))
    label = np.where(points[:, 0] > 0, 7.0, 2.0)
    label[3] = np.nan
    assert set(values(rng.normal(size=(80, 3)), points, label=label)["label"]) == {2.0, 7.0}


def test_values_that_are_not_finite_do_not_count(rng: np.random.Generator) -> None:
    points = rng.normal(size=(20, 3))
    heat = np.full(20, 5.5)
    heat[::2] = np.nan
    points[3] = np.inf
    heat[3] = 1e9
    made = values(points[:3], points, heat=heat, none=np.full(20, np.nan))
    assert made["heat"] == pytest.approx([5.5] * 3)
    assert np.isnan(made["none"]).all()


@given(count=st.integers(1, 12), copies=st.integers(1, 3), seed=st.integers(0, 99))
def test_few_and_coinciding_points_suffice(count: int, copies: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.repeat(rng.normal(size=(count, 3)), copies, axis=0)
    heat = np.repeat(rng.normal(size=count), copies)
    made = values(np.concatenate([points, rng.normal(size=(5, 3))]), points, heat=heat, label=np.arange(len(points)))
    assert (made["heat"] >= heat.min() - 1e-9).all()
    assert (made["heat"] <= heat.max() + 1e-9).all()


def test_text_is_left_behind_and_said_to_be() -> None:
    cloud = PointCloud(np.eye(3), None, {"name": np.array(["a", "b", "c"])})
    made, sentences = transfer_attributes(np.eye(3), cloud, ["name"], Neighbourhood(cloud.points))
    assert made == []
    assert sentences == ["The points' attribute 'name' holds no numbers and was left out."]


def test_distances_leave_out_points_that_are_not_finite(rng: np.random.Generator) -> None:
    points, places = rng.normal(size=(50, 3)) + UTM, rng.normal(size=(30, 3)) + UTM
    broken = np.concatenate([points, np.full((2, 3), np.nan)])
    expected = np.linalg.norm(places[:, None] - points, axis=2).min(axis=1)
    np.testing.assert_allclose(Neighbourhood(broken).distances(places), expected, atol=1e-9)

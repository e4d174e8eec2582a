"""Double layers are found, with their distance; noise, edges, thin walls and steps are not taken for them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from analytic_clouds import thin_shell, torus
from made_shapes import sphere

from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.ingest import Layers, layers_of, prepare
from gnrecon.ingest.double_walls import find_layers

Shape = Callable[[int, np.random.Generator], tuple[np.ndarray, np.ndarray]]


def twice(points: np.ndarray, normals: np.ndarray, offset: float, rng: np.random.Generator) -> np.ndarray:
    """Half of the points, by chance, farther out."""
    return points + np.where(rng.uniform(size=(len(points), 1)) < 0.5, offset, 0.0) * normals


@pytest.mark.parametrize("shape", [sphere, torus])
@pytest.mark.parametrize(("offset", "noise"), [(0.01, 0.0), (0.03, 0.003), (0.06, 0.006), (0.2, 0.01)])
def test_layers_and_their_distance(shape: Shape, offset: float, noise: float, rng: np.random.Generator) -> None:
    points, normals = shape(6000, rng)
    double = twice(points, normals, offset, rng) + noise * rng.normal(size=(6000, 1)) * normals
    found = find_layers(double, normals)
    assert found is not None
    assert found.offset == pytest.approx(offset, rel=0.15)
    assert found.share > 0.5


def test_layers_of_a_part_of_the_surface(rng: np.random.Generator) -> None:
    points, normals = sphere(12_000, rng)
    double = np.where(points[:, 2:] > 0.4, twice(points, normals, 0.04, rng), points)
    found = find_layers(double, normals)
    assert found is not None
    assert found.share == pytest.approx(0.3, abs=0.12)
    assert found.offset == pytest.approx(0.04, rel=0.15)
    assert f"At {found.share:.0%} of the points there are two layers, about 0.04" in found.describe()


@pytest.mark.parametrize("shape", [sphere, torus])
@pytest.mark.parametrize("noise", [0.0, 0.005, 0.02, 0.05])
def test_noise_is_no_layer(shape: Shape, noise: float, rng: np.random.Generator) -> None:
    points, normals = shape(6000, rng)
    assert find_layers(points + noise * rng.normal(size=(6000, 1)) * normals, normals) is None


def test_what_a_quadric_leaves_over_of_an_exact_scan_is_no_layer() -> None:
    """Here 5 % of the places look like two layers 0.001 spacings apart."""
    points = np.random.default_rng(0).normal(size=(2000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    assert find_layers(points, points) is None


def test_thin_walls_are_no_layers(rng: np.random.Generator) -> None:
    assert find_layers(*thin_shell(8000, rng, wall=0.06)) is None


def test_steps_and_edges_are_no_layers(rng: np.random.Generator) -> None:
    x, y = rng.uniform(-1, 1, (2, 9000))
    step = np.column_stack([x, y, np.where(x > 0, 0.05, 0.0)])
    assert find_layers(step, np.tile([0.0, 0, 1], (9000, 1))) is None
    fold = np.column_stack([x, y, 0.8 * np.abs(x)])
    normals = np.column_stack([-0.8 * np.sign(x), 0 * x, np.ones(9000)]) / np.hypot(1, 0.8)
    assert find_layers(fold, normals) is None
    assert find_layers(step[:50], np.tile([0.0, 0, 1], (50, 1))) is None


@pytest.mark.parametrize("given", [True, False])
def test_samples_tell_layers_in_file_units(given: bool, rng: np.random.Generator) -> None:
    points, normals = sphere(8000, rng)
    double = 50 * twice(points, normals, 0.06, rng) + 1000
    samples, counts = prepare(PointCloud(double, normals if given else None))
    found = layers_of(samples, counts.normals)
    assert found is not None
    assert found.offset == pytest.approx(3, rel=0.2)
    assert Layers(0.5, 3.0).as_dict() == {"share": 0.5, "offset": 3.0}

"""Distances between surfaces against analytic values, and against brute force."""

from __future__ import annotations

import json

import numpy as np
import pytest
from analytic_fields import UNIT, UTM, Field, ball_mesh, torus

from gnrecon.export import extract, measure
from gnrecon.export.metrics import nearest_on_surface, sample_surface
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.errors import InputError, UsageError


def ball(radius: float, frame: object = None, resolution: int = 96) -> Mesh:
    return ball_mesh(radius, UNIT if frame is None else UTM, resolution, reach=1.2)


def brute_force(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Distance to the nearest triangle by minimising over its interior, its edges and its corners."""
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    best = np.full(len(points), np.inf)
    for row, p in enumerate(points):
        normal = np.cross(b - a, c - a)
        squared = np.einsum("ij,ij->i", normal, normal)
        height = np.einsum("ij,ij->i", p - a, normal) / np.sqrt(squared)
        foot = p - (height / np.sqrt(squared))[:, None] * normal
        sides = [np.einsum("ij,ij->i", np.cross(y - x, foot - x), normal) for x, y in ((a, b), (b, c), (c, a))]
        inside = np.min(sides, axis=0) >= 0
        candidates = [np.where(inside, np.abs(height), np.inf).min()]
        for x, y in ((a, b), (b, c), (c, a)):
            along = np.clip(np.einsum("ij,ij->i", p - x, y - x) / np.einsum("ij,ij->i", y - x, y - x), 0, 1)
            candidates.append(np.linalg.norm(p - x - along[:, None] * (y - x), axis=1).min())
        best[row] = min(candidates)
    return best


@pytest.mark.parametrize("utm", [False, True], ids=["unit", "UTM"])
def test_distances_agree_with_brute_force(utm: bool) -> None:
    field = Field(torus(), frame=UTM) if utm else Field(torus())
    mesh = extract(field, resolution=24)
    rng = np.random.default_rng(3)
    points = field.frame.to_world(rng.uniform(-1.2, 1.2, size=(200, 3)))
    near = sample_surface(mesh, 100, rng).points
    for queries, tolerance in ((points, 1e-6), (near, 1e-7)):
        distances, faces = nearest_on_surface(mesh, queries, batch=64)
        assert np.allclose(distances, brute_force(mesh, queries), rtol=0, atol=tolerance * field.frame.scale)
        own = [
            brute_force(Mesh(mesh.vertices, mesh.faces[f : f + 1]), q[None])[0]
            for f, q in zip(faces, queries, strict=True)
        ]
        assert np.allclose(distances, own, rtol=0, atol=tolerance * field.frame.scale)


@pytest.mark.parametrize("utm", [None, UTM], ids=["unit", "UTM"])
def test_concentric_spheres(utm: object) -> None:
    inner, outer = ball(1.0, utm), ball(1.01, utm)
    metrics = measure(inner, outer, samples=20_000)
    scale = 1.0 if utm is None else UTM.scale
    for name in ("reference_to_mesh_mean", "mesh_to_reference_mean", "chamfer_mean", "chamfer_rms_paper"):
        assert getattr(metrics, name) == pytest.approx(0.01 * scale, rel=5e-3), name
    # The sagitta of a cell, h^2 / 8, is what the triangles lack at their middles.
    assert metrics.hausdorff == pytest.approx(0.01 * scale, rel=0.02)
    assert metrics.radius == pytest.approx(1.01 * scale, rel=1e-3)
    assert metrics.normal_consistency == pytest.approx(1, abs=1e-3)
    assert (metrics.precision, metrics.recall, metrics.f_score) == (0, 0, 0)
    assert measure(inner, outer, samples=5000, scale=4.0 * scale).f_score == 1


def test_the_two_ways_differ_where_they_should() -> None:
    """A half of the sphere lies on the sphere, but most of the other half is far from it."""
    whole = ball(1.0, resolution=64)
    half = Mesh(whole.vertices, whole.faces[whole.corners[:, :, 2].mean(axis=1) > 0])
    metrics = measure(half, whole, samples=20_000)
    assert metrics.mesh_to_reference_mean < 1e-7
    assert metrics.precision == 1
    assert metrics.recall == pytest.approx(0.5, abs=0.02)
    # A point at angle t below the rim lies 2 sin(t / 2) from it, and the area there goes with cos t.
    angle = np.linspace(0, np.pi / 2, 20_001)
    distance, weight = 2 * np.sin(angle / 2), np.cos(angle)
    mean = np.average(distance, weights=weight) / 2
    rms = np.sqrt(np.average(distance**2, weights=weight) / 2)
    assert metrics.reference_to_mesh_mean == pytest.approx(mean, rel=0.03)
    assert metrics.chamfer_rms_paper == metrics.reference_to_mesh_rms == pytest.approx(rms, rel=0.03)
    assert metrics.chamfer_mean == pytest.approx(metrics.reference_to_mesh_mean / 2, rel=1e-4)
    assert metrics.hausdorff == pytest.approx(np.sqrt(2), rel=0.03)


def test_samples_are_uniform_by_area() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [10, 0, 0], [13, 0, 0], [10, 1, 0]], dtype=float)
    mesh = Mesh(corners, np.arange(6).reshape(2, 3))
    samples = sample_surface(mesh, 40_000, np.random.default_rng(0))
    assert np.mean(samples.points[:, 0] >= 10) == pytest.approx(0.75, abs=0.01)
    first = samples.points[samples.points[:, 0] < 10]
    assert np.allclose(first.mean(axis=0), [1 / 3, 1 / 3, 0], atol=0.01)
    assert np.mean(first[:, :2].sum(axis=1) < 0.5) == pytest.approx(0.25, abs=0.02)
    assert np.allclose(samples.normals, [0, 0, 1])


def test_equal_seeds_give_equal_numbers() -> None:
    inner, outer = ball(1.0, resolution=24), ball(1.05, resolution=24)
    assert measure(inner, outer, samples=2000, seed=4) == measure(inner, outer, samples=2000, seed=4)
    assert measure(inner, outer, samples=2000, seed=4) != measure(inner, outer, samples=2000, seed=5)


def test_a_cloud_as_reference() -> None:
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mesh = ball(1.0)
    metrics = measure(mesh, PointCloud(1.02 * normals, 5 * normals), samples=3000)
    assert metrics.reference_is_cloud
    assert metrics.reference_to_mesh_mean == pytest.approx(0.02, rel=0.01)
    assert metrics.mesh_to_reference_mean > 0.02
    assert metrics.normal_consistency == pytest.approx(1, abs=2e-3)
    assert any("nearest point" in line for line in metrics.describe())
    assert measure(mesh, PointCloud(normals), samples=100).normal_consistency is None


def square(height: float) -> Mesh:
    """A square of side 2 about the z axis, at a height."""
    corners = np.array([[-1.0, -1, height], [1, -1, height], [1, 1, height], [-1, 1, height]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def test_a_lid_is_where_a_mesh_may_be_and_need_not_be() -> None:
    reference, lid = square(0), square(1)
    both = Mesh(np.concatenate([reference.vertices, lid.vertices]), np.concatenate([reference.faces, lid.faces + 4]))
    without, on_lid = measure(both, reference), measure(both, reference, lid=lid)
    off = measure(lid, reference, lid=reference)
    assert (without.mesh_to_reference_mean, without.hausdorff) == pytest.approx((0.5, 1.0), abs=0.01)
    assert (on_lid.chamfer_mean, on_lid.hausdorff, on_lid.f_score) == pytest.approx((0, 0, 1), abs=1e-6)
    # A lid does not move what the reference's own samples are measured to.
    assert (off.reference_to_mesh_mean, off.mesh_to_reference_mean) == pytest.approx((1, 1), abs=1e-6)
    open_mesh = measure(reference, reference, lid=lid)
    assert (open_mesh.chamfer_mean, open_mesh.hausdorff) == pytest.approx((0, 0), abs=1e-6)
    with pytest.raises(UsageError, match="without faces"):
        measure(lid, PointCloud(lid.vertices), lid=lid)
    with pytest.raises(InputError, match="The lid has 4 points that are not finite"):
        measure(lid, reference, lid=lid.with_vertices(np.full((4, 3), np.nan)))


def test_numbers_are_named_with_their_definitions() -> None:
    metrics = measure(ball(1.0, resolution=24), ball(1.02, resolution=24), samples=1000)
    numbers = json.loads(json.dumps(metrics.as_dict()))
    assert numbers["relative"]["hausdorff"] == pytest.approx(numbers["hausdorff"] / numbers["radius"])
    lines = metrics.describe()
    for name in ("chamfer_mean", "chamfer_rms_paper", "hausdorff", "normal_consistency", "f_score", "radius"):
        assert any(line.startswith(name) for line in lines)
    assert any("CD_1" in line for line in lines)


def test_senseless_input_is_refused() -> None:
    mesh = ball(1.0, resolution=16)
    nothing = Mesh(np.empty((0, 3)), np.empty((0, 3), dtype=np.int64))
    with pytest.raises(UsageError, match="samples is 0"):
        measure(mesh, mesh, samples=0)
    with pytest.raises(UsageError, match="scale of -1"):
        measure(mesh, mesh, scale=-1.0)
    with pytest.raises(InputError, match="mesh has no faces"):
        measure(nothing, mesh)
    with pytest.raises(InputError, match="nothing to measure against"):
        measure(mesh, nothing)
    with pytest.raises(InputError, match="all of its points coincide"):
        measure(mesh, PointCloud(np.ones((3, 3))))

"""Trimming: what is left lies near data, has clean borders, and is an oriented manifold with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from analytic_fields import Field, sphere, torus, union

from gnrecon.export import (
    Neighbourhood,
    extract,
    require_bordered,
    require_sound,
    same_side_distances,
    trim,
    unsupported_area,
    verify_file,
)
from gnrecon.export.export_parameters import ExportParameters
from gnrecon.export.mesh_statistics import Edges, split_vertices
from gnrecon.geometry.mesh import Mesh
from gnrecon.io import write_mesh
from gnrecon.runtime.errors import MeshError, UsageError

RADIUS = 0.8


def points_on_sphere(count: int, rng: np.random.Generator) -> np.ndarray:
    points = rng.normal(size=(count, 3))
    return RADIUS * points / np.linalg.norm(points, axis=1, keepdims=True)


def ball(resolution: int = 40) -> Mesh:
    return extract(Field(sphere(RADIUS)), resolution=resolution)


def border_points(mesh: Mesh) -> np.ndarray:
    edges = Edges.of(mesh)
    return mesh.vertices[np.unique(edges.ends[edges.first[edges.count == 1]])]


def assert_open_manifold(mesh: Mesh) -> None:
    facts = require_bordered(mesh)
    assert not facts.closed
    assert facts.manifold
    assert facts.oriented
    edges = Edges.of(mesh)
    assert len(split_vertices(mesh, edges)) == 0
    # Every vertex of the border has one edge of it on either side.
    ends = edges.ends[edges.first[edges.count == 1]]
    assert (np.bincount(ends.reshape(-1))[np.unique(ends)] == 2).all()


@pytest.mark.parametrize(("reach", "overhang"), [(0.1, None), (0.2, 0.1)])
def test_half_a_sphere(rng: np.random.Generator, reach: float, overhang: float | None) -> None:
    points = points_on_sphere(20_000, rng)
    # A gap beyond 0.1, which a longer reach spans.
    gap = np.linalg.norm(points - [0, 0, RADIUS], axis=1) < 0.15
    points = points[(points[:, 2] > 0) & (~gap if overhang else True)]
    mesh = ball()
    result, done = trim(mesh, Neighbourhood(points).distances(mesh.vertices), reach, overhang=overhang)
    reach = overhang or reach
    assert (done.overhang, done.describe()[0].count("hangs over")) == (reach, int(overhang is not None))
    assert_open_manifold(result)
    assert (done.crumbs, done.filled) == (0, 0)
    # The chord of length D below the equator.
    border = border_points(result)
    depth = RADIUS * np.sin(2 * np.arcsin(reach / 2 / RADIUS))
    assert np.abs(border[:, 2] + depth).max() < 0.02
    assert result.area == pytest.approx(2 * np.pi * RADIUS * (RADIUS + depth), rel=0.02)
    assert done.area_share == pytest.approx(1 - result.area / mesh.area)
    assert result.euler_characteristic == 1
    assert np.linalg.norm(np.cross(*np.moveaxis(np.diff(result.corners, axis=1), 1, 0)), axis=1).min() > 0


def test_invented_area_of_half_a_sphere(rng: np.random.Generator) -> None:
    points = points_on_sphere(20_000, rng)
    upper = points[points[:, 2] > 0]
    mesh, around = ball(), Neighbourhood(upper)
    found = unsupported_area(mesh, around.distances(mesh.vertices), around.spacing())
    # Each of 20,000 points has its share of the sphere to itself.
    spacing = np.sqrt(4 * np.pi * RADIUS**2 / 20_000)
    assert around.spacing() == pytest.approx(spacing, rel=0.03)
    assert found.invented_beyond == pytest.approx(3 * spacing, rel=0.03)
    assert found.invented_area_share == pytest.approx((RADIUS - 3 * spacing) / (2 * RADIUS), abs=0.02)
    assert "--trim 3s" in found.describe()[0]
    whole = unsupported_area(mesh, Neighbourhood(points).distances(mesh.vertices), spacing)
    assert whole.invented_area_share < 1e-3
    assert whole.describe() == []


def test_a_hole_has_a_smooth_border_of_the_right_length(rng: np.random.Generator) -> None:
    points = points_on_sphere(20_000, rng)
    hole = np.arccos(points[:, 2] / RADIUS) < 0.6
    mesh = ball(64)
    reach = 0.08
    result, _ = trim(mesh, Neighbourhood(points[~hole]).distances(mesh.vertices), reach)
    assert_open_manifold(result)
    angle = 0.6 - 2 * np.arcsin(reach / 2 / RADIUS)
    edges = Edges.of(result)
    ends = result.vertices[edges.ends[edges.first[edges.count == 1]]]
    length = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum()
    assert length == pytest.approx(2 * np.pi * RADIUS * np.sin(angle), rel=0.08)


def test_small_holes_stay_closed_and_crumbs_go(rng: np.random.Generator) -> None:
    points = points_on_sphere(20_000, rng)
    angle = np.arccos(points[:, 2] / RADIUS)
    # Data above the equator with a narrow gap at the pole, and one point far below.
    kept = np.concatenate([points[(angle < np.pi / 2) & (angle > 0.18)], [[0, 0, -RADIUS]]])
    mesh = ball(64)
    result, done = trim(mesh, Neighbourhood(kept).distances(mesh.vertices), 0.1)
    assert (done.crumbs, done.filled) == (1, 1)
    assert_open_manifold(result)
    assert result.euler_characteristic == 1
    assert result.vertices[:, 2].min() > -0.3
    assert "with 1 small leftover pieces" in done.describe()[0]
    assert "1 small gaps were left closed" in done.describe()[0]


def test_a_supported_component_stays_however_small_it_is() -> None:
    field = Field(union(torus(), sphere(0.06)))
    mesh = extract(field, resolution=64)
    near = mesh.vertices[(mesh.vertices[:, 0] > 0.1) | (np.linalg.norm(mesh.vertices, axis=1) < 0.1)]
    result, done = trim(mesh, Neighbourhood(near).distances(mesh.vertices), 0.1)
    assert done.crumbs == 0
    assert (np.linalg.norm(result.vertices, axis=1) < 0.1).any()
    assert_open_manifold(result)


@pytest.mark.parametrize("seed", range(20))
def test_any_cut_of_any_shape_is_an_oriented_manifold(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mesh = extract(Field(torus()), resolution=24)
    centres = rng.uniform(-1, 1, (rng.integers(1, 30), 3))
    distances = np.linalg.norm(mesh.vertices[:, None] - centres, axis=2).min(axis=1)
    reach = float(np.quantile(distances, rng.uniform(0.2, 0.8)))
    result, done = trim(mesh, distances, reach)
    if done.area_share:
        assert_open_manifold(result)
    assert 0 <= done.area_share < 1
    assert result.area == pytest.approx((1 - done.area_share) * mesh.area)


def test_values_are_interpolated_at_the_cut() -> None:
    mesh = ball()
    heat, label = mesh.vertices @ [1.0, 2.0, 3.0], np.arange(len(mesh.vertices))
    mesh = Mesh(mesh.vertices, mesh.faces, mesh.vertex_normals(), {"heat": heat, "label": label})
    result, _ = trim(mesh, mesh.vertices[:, 2] + 1, 1.0)
    assert result.attributes["heat"] == pytest.approx(result.vertices @ [1.0, 2.0, 3.0])
    assert np.linalg.norm(result.normals, axis=1) == pytest.approx(1)
    assert (np.einsum("ij,ij->i", result.normals, result.vertices) > 0.99 * RADIUS).all()
    place = mesh.vertices[result.attributes["label"]]
    assert np.linalg.norm(place - result.vertices, axis=1).max() < 0.06
    assert np.abs(border_points(result)[:, 2]).max() < 2 * ExportParameters.trim.edge_clearance * 0.05


def test_nothing_far_and_nothing_near() -> None:
    mesh = ball(24)
    result, done = trim(mesh, np.zeros(len(mesh.vertices)), 0.1)
    assert result is mesh
    assert done.describe() == ["Nothing was cut off: all of the surface lies within 0.1 of a point."]
    with pytest.raises(UsageError, match=r"Trimming at 0\.1 leaves nothing: every point is at least 7 away"):
        trim(mesh, np.full(len(mesh.vertices), 7.0), 0.1)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".glb", ".3mf", ".stl"])
def test_open_meshes_are_verified_as_such_in_every_format(suffix: str, tmp_path: Path) -> None:
    mesh = ball(24)
    result, _ = trim(mesh, mesh.vertices[:, 2] + 1, 1.0)
    write_mesh(result, tmp_path / f"m{suffix}", verify=lambda path: verify_file(path, bordered=True))
    with pytest.raises(MeshError, match="read back: The mesh is open"):
        verify_file(tmp_path / f"m{suffix}")
    with pytest.raises(MeshError, match="is open"):
        require_sound(result)


def test_what_is_no_edge_manifold_is_refused() -> None:
    fin = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]]), [[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    with pytest.raises(MeshError, match="shared by more than two faces"):
        require_bordered(fin)
    with pytest.raises(MeshError, match="not consistently oriented"):
        require_bordered(Mesh(fin.vertices, [[0, 1, 2], [0, 1, 3]]))
    with pytest.raises(MeshError, match="not finite"):
        require_bordered(Mesh(np.full((3, 3), np.nan), [[0, 1, 2]]))
    with pytest.raises(MeshError, match="is empty"):
        require_bordered(Mesh(np.eye(3), np.empty((0, 3))))
    assert require_bordered(Mesh(np.eye(3), [[0, 1, 2]])).boundary_edges == 3


def test_the_underside_of_a_slab_is_not_supported_by_the_points_of_its_top() -> None:
    slab = extract(Field(lambda p: np.abs(p / [1, 1, 0.1]).max(axis=1) * 0.1 - 0.09), resolution=60)
    points = slab.vertices[slab.vertices[:, 2] > 0.085]
    normals = np.tile([0.0, 0, 1], (len(points), 1))
    distances = Neighbourhood(points).distances(slab.vertices)
    assert trim(slab, distances, 0.25)[1].area_share == 0
    sheet, trimming = trim(slab, same_side_distances(slab, distances, points, normals, 0.25), 0.25)
    require_bordered(sheet)
    assert sheet.vertices[:, 2].min() > 0
    assert sheet.area == pytest.approx(1.8**2, rel=0.05)
    assert trimming.area_share == pytest.approx(1 - sheet.area / slab.area)
    both = np.concatenate([points, points * [1, 1, -1]]), np.concatenate([normals, -normals])
    kept = same_side_distances(slab, distances, *both, 0.25)
    assert (kept[slab.vertices[:, 2] < -0.085] <= 0.25).mean() > 0.95

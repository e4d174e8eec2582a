"""Fewer faces: the wanted number or tolerance is kept, vertices lie on the field, and edges stay."""

from __future__ import annotations

import numpy as np
import pytest
from analytic_fields import UTM, Field, Function, sphere, torus
from scipy.spatial import KDTree
from sharp_fields import HALF, between, box, cylinder, extracted, notched_box

from gnrecon.export import decimate, project, require_sound, sharpen, simplify
from gnrecon.export.metrics import nearest_on_surface
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import MeshError, UsageError


def sharp(field: Field, resolution: int = 32) -> Mesh:
    return project(sharpen(extracted(field, resolution), field), field)


@pytest.mark.parametrize(("function", "genus"), [(sphere(), 0), (torus(), 1), (cylinder(), 0)])
@pytest.mark.parametrize("faces", [1000, 200])
def test_the_number_of_faces_is_reached_on_the_field(function: Function, genus: int, faces: int) -> None:
    field = Field(function, frame=UTM)
    mesh = decimate(sharp(field), field, faces)
    assert faces - 2 <= len(mesh.faces) <= faces
    assert require_sound(mesh).genus == genus
    assert np.abs(field.sdf(mesh.vertices)).max() < 1e-6 * UTM.scale
    assert mesh.normals is not None
    unit = field.gradient(mesh.vertices)
    across = np.abs(np.einsum("ij,ij->i", mesh.normals, unit / np.linalg.norm(unit, axis=1, keepdims=True)) - 1)
    assert np.quantile(across, 0.5) < 1e-6


def test_few_faces_are_enough_for_flat_sides() -> None:
    field = Field(box())
    mesh = decimate(sharp(field), field, 40)
    assert len(mesh.faces) <= 40
    assert mesh.volume == pytest.approx(8 * HALF.prod(), rel=1e-3)
    assert np.abs(field.sdf(between(mesh))).max() < 1e-3


def test_a_mesh_with_fewer_faces_is_left_alone() -> None:
    field = Field(sphere())
    mesh = extracted(field, 16)
    assert decimate(mesh, field, len(mesh.faces)) is mesh


@pytest.mark.parametrize("function", [sphere(), torus(), notched_box()])
@pytest.mark.parametrize("tolerance", [0.004, 0.01])
def test_simplifying_moves_the_surface_by_less_than_the_tolerance(function: Function, tolerance: float) -> None:
    field = Field(function, frame=UTM)
    before = sharp(field, 40)
    mesh = simplify(before, field, tolerance * UTM.scale)
    facts = require_sound(mesh)
    assert facts.genus == require_sound(before).genus
    assert len(mesh.faces) < 0.9 * len(before.faces)
    assert KDTree(before.vertices).query(mesh.vertices)[0].max() < 1e-7
    rng = np.random.default_rng(1)
    for one, other in ((before, mesh), (mesh, before)):
        assert nearest_on_surface(one, scattered(other, rng))[0].max() <= 1.02 * tolerance * UTM.scale


def scattered(mesh: Mesh, rng: np.random.Generator) -> np.ndarray:
    """Twenty random points on each face, and the vertices."""
    weights = rng.dirichlet(np.ones(3), (len(mesh.faces), 20))
    return np.concatenate([mesh.vertices, np.einsum("fnk,fki->fni", weights, mesh.corners).reshape(-1, 3)])


def test_a_larger_tolerance_leaves_fewer_faces_and_flat_sides_need_hardly_any() -> None:
    field = Field(box())
    assert len(simplify(sharp(field), field, 1e-3).faces) < 0.05 * len(sharp(field).faces)
    field = Field(cylinder())
    counts = [len(simplify(sharp(field), field, tolerance).faces) for tolerance in (1e-3, 3e-3, 1e-2)]
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] < 0.5 * counts[0]


@pytest.mark.parametrize("reduce", [lambda m, f: decimate(m, f, 300), lambda m, f: simplify(m, f, 0.01)])
def test_the_same_mesh_gives_the_same_bytes(reduce) -> None:  # type: ignore[no-untyped-def]
    field = Field(cylinder())
    plain = sharp(field)
    one, other = (reduce(plain, field) for _ in range(2))
    assert one.vertices.tobytes() == other.vertices.tobytes()
    assert one.faces.tobytes() == other.faces.tobytes()


def test_senseless_numbers_are_refused() -> None:
    field = Field(sphere())
    mesh = extracted(field, 16)
    with pytest.raises(UsageError, match="at least 4"):
        decimate(mesh, field, 3)
    for tolerance in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(UsageError, match="must be positive"):
            simplify(mesh, field, tolerance)
    with pytest.raises(MeshError, match="left nothing"):
        simplify(mesh, field, 100.0)

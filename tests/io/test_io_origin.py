"""STL at far coordinates: what float32 would collapse is written relative to an origin, and comes back in its place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gnrecon.export import require_sound, verify_file
from gnrecon.geometry.mesh import Mesh
from gnrecon.io import read_mesh, write_mesh, written_origin
from gnrecon.io.formats.stl import format_origin, parse_origin, stl_header

UTM = np.array([512_345.678, 4_123_456.789, 123.4])


def ball(radius: float, place: np.ndarray) -> Mesh:
    """An octahedron, its faces cut into four a few times, on a sphere."""
    corners = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    triangles = np.array(corners, dtype=np.float64)[faces]
    for _ in range(4):
        a, b, c = np.moveaxis(triangles, 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        triangles = np.concatenate(
            [np.stack(part, axis=1) for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    vertices, rows = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return Mesh(place + radius * vertices, rows.reshape(-1, 3))


def verified(path: Path) -> None:
    verify_file(path)


@pytest.mark.parametrize("radius", [0.02, 3.0, 400.0])
def test_a_far_solid_is_one_in_its_file_too(tmp_path: Path, radius: float) -> None:
    mesh = ball(radius, UTM)
    require_sound(mesh)
    (sentence,) = write_mesh(mesh, tmp_path / "far.stl", verify=verified)
    back = read_mesh(tmp_path / "far.stl")
    assert np.abs(back.corners - mesh.corners).max() < 1e-6 * radius + 1e-9
    origin = written_origin(mesh, tmp_path / "far.stl")
    assert origin is not None
    assert f"relative to the origin {format_origin(origin)}." in sentence
    assert np.abs(origin - UTM).max() <= 2 * np.sqrt(3) * radius


def test_other_programs_find_the_mesh_near_zero_and_the_origin_in_the_header(tmp_path: Path) -> None:
    import trimesh

    mesh = ball(3.0, UTM)
    write_mesh(mesh, tmp_path / "far.stl")
    data = (tmp_path / "far.stl").read_bytes()
    assert data[:80].rstrip() == b"STL, origin 512350 4123460 120"
    loaded = trimesh.load_mesh(tmp_path / "far.stl")
    assert loaded.is_watertight
    assert np.abs(loaded.vertices + np.array([512350, 4123460, 120]) - UTM).max() < 3.01


@pytest.mark.parametrize("place", [0.0, 10.0, 2000.0])
def test_where_float32_suffices_the_coordinates_are_the_scans_own(tmp_path: Path, place: float) -> None:
    mesh = ball(3.0, np.full(3, place))
    write_mesh(mesh, tmp_path / "near.stl")
    assert written_origin(mesh, tmp_path / "near.stl") is None
    assert written_origin(ball(3.0, UTM), tmp_path / "far.ply") is None
    assert (tmp_path / "near.stl").read_bytes()[:80] == b"binary STL".ljust(80)
    np.testing.assert_array_equal(read_mesh(tmp_path / "near.stl").corners, mesh.corners.astype(np.float32))


@pytest.mark.parametrize(
    "origin", [[0.0, -0.0, 5.0], [-1.23456789012345e300, 1.2345678901234e-300, -9.87654321098765e-300], [0.1, 1e15, -3]]
)
def test_headers_hold_any_origin(origin: list[float]) -> None:
    text = stl_header(np.array(origin))
    assert len(text) == 80
    np.testing.assert_array_equal(parse_origin(text), np.array(origin))


@pytest.mark.parametrize(
    "text", [b"", b"binary STL", b"STL, origin", b"STL, origin 1 2", b"STL, origin 1 two 3", b"STL, origin nan 0 1"]
)
def test_other_headers_name_none(text: bytes) -> None:
    np.testing.assert_array_equal(parse_origin(text.ljust(80)), np.zeros(3))

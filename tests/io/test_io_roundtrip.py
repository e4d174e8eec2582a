"""What is written reads back: exactly where the format holds doubles, to float32 where it does not."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gnrecon.geometry.mesh import Mesh
from gnrecon.io import WRITERS, read_cloud, read_mesh, write_mesh, written_origin
from gnrecon.runtime.errors import MeshError, OutputError, UsageError

UTM = np.array([431234.123456789, 5412345.987654321, 312.1])


@st.composite
def meshes(draw: st.DrawFn) -> Mesh:
    """Random triangles over distinct vertices, near the origin or at projected coordinates, of all sizes."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    size = draw(st.integers(3, 40))
    vertices = rng.normal(size=(size, 3)) * 10.0 ** draw(st.integers(-3, 3)) + draw(st.sampled_from([0.0, UTM, -UTM]))
    faces = np.array([rng.permutation(size)[:3] for _ in range(draw(st.integers(1, 60)))])
    normals = rng.normal(size=(size, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(vertices, faces, normals if draw(st.booleans()) else None)


def round_trip(mesh: Mesh, suffix: str) -> Mesh:
    with tempfile.TemporaryDirectory() as folder:
        write_mesh(mesh, Path(folder) / f"mesh{suffix}")
        return read_mesh(Path(folder) / f"mesh{suffix}")


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".off"])
@settings(max_examples=40, deadline=None)
@given(mesh=meshes())
def test_formats_with_doubles_are_exact(suffix: str, mesh: Mesh) -> None:
    result = round_trip(mesh, suffix)
    np.testing.assert_array_equal(result.vertices, mesh.vertices)
    np.testing.assert_array_equal(result.faces, mesh.faces)
    used = np.unique(mesh.faces)  # OBJ ties normals to the corners of faces
    if mesh.normals is not None and suffix != ".off":
        assert result.normals is not None
        np.testing.assert_allclose(result.normals[used], mesh.normals[used], atol=1e-6)


@settings(max_examples=40, deadline=None)
@given(mesh=meshes())
def test_stl_keeps_corners_to_float32(mesh: Mesh) -> None:
    result = round_trip(mesh, ".stl")
    origin = written_origin(mesh, "mesh.stl")
    shift = np.zeros(3) if origin is None else origin
    np.testing.assert_array_equal(result.corners, (mesh.corners - shift).astype(np.float32) + shift)
    assert len(np.unique(result.vertices, axis=0)) == len(result.vertices)


@settings(max_examples=40, deadline=None)
@given(mesh=meshes())
def test_glb_is_as_precise_as_the_size_allows_wherever_the_mesh_lies(mesh: Mesh) -> None:
    result = round_trip(mesh, ".glb")
    extent = np.ptp(mesh.vertices, axis=0).max()
    np.testing.assert_array_equal(result.faces, mesh.faces)
    tolerance = 1e-7 * extent + 4 * np.spacing(np.abs(mesh.vertices).max())
    np.testing.assert_allclose(result.vertices, mesh.vertices, rtol=0, atol=tolerance)
    if mesh.normals is not None:
        assert result.normals is not None
        np.testing.assert_allclose(result.normals, mesh.normals, atol=1e-6)


@pytest.mark.parametrize("suffix", sorted(WRITERS))
def test_same_mesh_gives_same_bytes(suffix: str, tmp_path: Path) -> None:
    mesh = Mesh(np.eye(3) + UTM, [[0, 1, 2]])
    write_mesh(mesh, tmp_path / f"a{suffix}")
    write_mesh(mesh, tmp_path / f"b{suffix}")
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


@pytest.mark.parametrize("suffix", sorted(WRITERS))
def test_a_written_mesh_is_a_cloud_with_outward_normals(suffix: str, tmp_path: Path) -> None:
    corners = np.array([[x, y, z] for x in (-1.0, 1) for y in (-1, 1) for z in (-1, 1)])
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    write_mesh(Mesh(corners, faces), tmp_path / f"cube{suffix}")
    cloud = read_cloud(tmp_path / f"cube{suffix}")
    assert cloud.normals is not None
    assert len(cloud) == 8
    assert (np.einsum("ij,ij->i", cloud.points, cloud.normals) > 1.4).all()


def test_stl_says_how_far_it_rounds(tmp_path: Path) -> None:
    near = Mesh(np.eye(3), [[0, 1, 2]])
    far = Mesh(np.eye(3) + 3000.1, [[0, 1, 2]])
    assert write_mesh(near, tmp_path / "near.stl") == []
    (sentence,) = write_mesh(far, tmp_path / "far.stl")
    stated = float(sentence.partition("up to ")[2].split()[0])
    stored = read_mesh(tmp_path / "far.stl").corners[0]
    assert stated == pytest.approx(np.abs(stored - far.corners[0]).max(), rel=0.05)
    assert write_mesh(far, tmp_path / "far.glb") == []


def test_large_text_files_are_written_in_blocks(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    mesh = Mesh(rng.normal(size=(100_003, 3)), rng.integers(0, 100_003, (5, 3)))
    write_mesh(mesh, tmp_path / "large.off")
    np.testing.assert_array_equal(read_mesh(tmp_path / "large.off").vertices, mesh.vertices)


def test_what_cannot_be_written_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    triangle = Mesh(np.eye(3), [[0, 1, 2]])
    with pytest.raises(UsageError, match=r"\.fbx.*use obj, ply, stl, off, glb"):
        write_mesh(triangle, tmp_path / "a.fbx")
    with pytest.raises(MeshError, match="no faces"):
        write_mesh(Mesh(np.eye(3), np.empty((0, 3))), tmp_path / "a.ply")
    with pytest.raises(MeshError, match="not finite"):
        write_mesh(Mesh(np.diag([1, np.nan, 1]), [[0, 1, 2]]), tmp_path / "a.ply")
    with pytest.raises(OutputError, match="does not exist"):
        write_mesh(triangle, tmp_path / "missing" / "a.ply")
    assert list(tmp_path.iterdir()) == []

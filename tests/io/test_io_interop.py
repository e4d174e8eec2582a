"""Objects of other libraries come in and go out unchanged."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import as_cloud, as_mesh, as_shape, to_open3d, to_pymeshlab, to_trimesh, write_cloud, write_mesh
from gnrecon.runtime.errors import InputError

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(20, 3)) + np.array([431234.123456789, 5412345.987654321, 312.1])
NORMALS = RNG.normal(size=(20, 3))
TRIANGLE = Mesh(np.eye(3), [[0, 1, 2]])


def check(cloud: PointCloud, normals: bool) -> None:
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert (cloud.normals is not None) == normals
    if normals:
        np.testing.assert_array_equal(cloud.normals, NORMALS)


def test_arrays_and_lists() -> None:
    check(as_cloud(POINTS), normals=False)
    check(as_cloud(POINTS.tolist()), normals=False)
    check(as_cloud(np.hstack([POINTS, NORMALS])), normals=True)
    check(as_cloud(POINTS, NORMALS), normals=True)


def test_torch_tensors() -> None:
    import torch

    check(as_cloud(torch.tensor(POINTS, requires_grad=True), torch.tensor(NORMALS)), normals=True)


def test_open3d_clouds() -> None:
    import open3d

    legacy = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS))
    check(as_cloud(legacy), normals=False)
    legacy.normals = open3d.utility.Vector3dVector(NORMALS)
    legacy.paint_uniform_color([1, 0, 0])
    check(as_cloud(legacy), normals=True)
    np.testing.assert_array_equal(as_cloud(legacy).attributes["colors"], [[1, 0, 0]] * 20)
    tensor = open3d.t.geometry.PointCloud(open3d.core.Tensor(POINTS))
    tensor.point.normals = open3d.core.Tensor(NORMALS)
    check(as_cloud(tensor), normals=True)
    with pytest.raises(InputError, match="no positions"):
        as_cloud(open3d.t.geometry.PointCloud())


def test_trimesh_objects() -> None:
    import trimesh

    check(as_cloud(trimesh.PointCloud(POINTS)), normals=False)
    sphere = trimesh.creation.icosphere(subdivisions=1)
    cloud = as_cloud(sphere)
    np.testing.assert_array_equal(cloud.points, sphere.vertices)
    np.testing.assert_array_equal(cloud.normals, sphere.vertex_normals)


def test_own_objects() -> None:
    cloud = PointCloud(POINTS, NORMALS)
    assert as_cloud(cloud) is cloud
    np.testing.assert_allclose(as_cloud(TRIANGLE).normals, np.full((3, 3), 3**-0.5))


@pytest.mark.parametrize("obj", [np.zeros((4, 2)), np.zeros(3), b"points", object(), None])
def test_anything_else_is_refused(obj: object) -> None:
    with pytest.raises(InputError, match="Expected points"):
        as_cloud(obj)


def test_meshes_go_out_unprocessed() -> None:
    doubled = Mesh(np.vstack([np.eye(3), np.eye(3)]), [[0, 1, 2], [3, 5, 4]])
    for vertices, faces in [
        (to_trimesh(doubled).vertices, to_trimesh(doubled).faces),
        (to_open3d(doubled).vertices, to_open3d(doubled).triangles),
    ]:
        np.testing.assert_array_equal(np.asarray(vertices), doubled.vertices)
        np.testing.assert_array_equal(np.asarray(faces), doubled.faces)
    np.testing.assert_allclose(np.asarray(to_open3d(doubled).vertex_normals), doubled.vertex_normals())
    np.testing.assert_allclose(to_trimesh(doubled).vertex_normals, doubled.vertex_normals())


MESHES = {
    "plain": Mesh(POINTS[:4], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    "rich": Mesh(
        POINTS[:4],
        [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]],
        NORMALS[:4],
        {"colors": RNG.integers(0, 255, (4, 4), dtype=np.uint8), "heat": RNG.normal(size=4)},
    ),
}


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize(
    ("out", "keeps"),
    [(to_trimesh, 4), (to_open3d, 3), (lambda mesh: to_open3d(mesh, tensor=True), 4), (to_pymeshlab, 4)],
    ids=["trimesh", "open3d", "open3d tensor", "pymeshlab"],
)
def test_meshes_go_through_other_libraries_and_back(name: str, out: Callable[[Mesh], Any], keeps: int) -> None:
    mesh = MESHES[name]
    back = as_mesh(out(mesh))
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    # MeshLab makes its own.
    normals = Mesh(mesh.vertices, mesh.faces) if out is to_pymeshlab else mesh
    np.testing.assert_allclose(back.vertex_normals(), normals.vertex_normals(), atol=1e-12)
    assert ("colors" in back.attributes) == ("colors" in mesh.attributes)
    if "colors" in mesh.attributes:
        np.testing.assert_array_equal(back.attributes["colors"][:, :keeps], mesh.attributes["colors"][:, :keeps])
    np.testing.assert_array_equal(as_cloud(out(mesh)).points, mesh.vertices)


def test_attributes_go_out_where_there_is_a_place_for_them() -> None:
    mesh = MESHES["rich"].with_attributes({"quality": np.arange(4), "vector": np.eye(4, 3), "pair": np.eye(4, 2)})
    meshes = to_pymeshlab(mesh)
    theirs = meshes.current_mesh()
    np.testing.assert_array_equal(theirs.vertex_scalar_array(), np.arange(4))
    np.testing.assert_array_equal(theirs.vertex_custom_scalar_attribute_array("heat"), mesh.attributes["heat"])
    np.testing.assert_array_equal(theirs.vertex_custom_point_attribute_matrix("vector"), np.eye(4, 3))
    np.testing.assert_array_equal(as_mesh(theirs).attributes["quality"], np.arange(4))
    tensors = to_open3d(mesh, tensor=True)
    np.testing.assert_array_equal(tensors.vertex["pair"].numpy(), np.eye(4, 2))
    np.testing.assert_array_equal(as_mesh(tensors).attributes["heat"][:, 0], mesh.attributes["heat"])
    np.testing.assert_array_equal(as_mesh(to_trimesh(mesh)).attributes["heat"], mesh.attributes["heat"])


@pytest.mark.parametrize("normals", [NORMALS, None])
@pytest.mark.parametrize("out", [to_open3d, lambda cloud: to_open3d(cloud, tensor=True), to_pymeshlab, to_trimesh])
def test_clouds_go_through_other_libraries_and_back(out: Callable[[PointCloud], Any], normals: Any) -> None:
    colors = RNG.integers(0, 255, (20, 3), dtype=np.uint8)
    back = as_cloud(out(PointCloud(POINTS, normals, {"colors": colors})))
    check(back, normals=normals is not None)
    np.testing.assert_array_equal(as_bytes(back.attributes["colors"])[:, :3], colors)


def test_named_columns() -> None:
    columns = dict(zip(("x", "y", "z", "nx", "ny", "nz"), np.hstack([POINTS, NORMALS]).T, strict=True))
    columns |= {"red": np.arange(20), "green": np.arange(20), "blue": np.arange(20), "time": np.arange(20.0)}
    rows = np.rec.fromarrays(list(columns.values()), names=list(columns))
    for obj in (columns, rows):
        check(as_cloud(obj), normals=True)
        np.testing.assert_array_equal(as_cloud(obj).attributes["colors"], np.tile(np.arange(20)[:, None], 3))
        np.testing.assert_array_equal(as_cloud(obj).attributes["time"], np.arange(20))
    with pytest.raises(InputError, match="expected columns named x, y and z, but found x, y"):
        as_cloud({"x": POINTS[:, 0], "y": POINTS[:, 1]})
    with pytest.raises(InputError, match=r"columns of numbers, each of shape \(N,\)"):
        as_cloud({"x": POINTS, "y": POINTS, "z": POINTS})


def test_a_moved_layer_of_meshlab_is_where_it_was_moved_to() -> None:
    meshes = to_pymeshlab(PointCloud(POINTS, NORMALS))
    meshes.compute_matrix_from_translation(axisx=1.0, freeze=False)
    np.testing.assert_allclose(as_cloud(meshes).points, POINTS + np.eye(3)[0], atol=1e-8)
    meshes.compute_matrix_from_rotation(rotaxis="Z axis", angle=90.0, freeze=False)
    x, y, z = NORMALS.T
    np.testing.assert_allclose(as_cloud(meshes).normals, np.stack([-y, x, z], axis=1), atol=1e-8)


def test_pairs_of_vertices_and_faces_are_meshes() -> None:
    import torch

    mesh = MESHES["plain"]
    for pair in ((mesh.vertices, mesh.faces), [mesh.vertices.tolist(), torch.as_tensor(mesh.faces)]):
        np.testing.assert_array_equal(as_mesh(pair).vertices, mesh.vertices)
        np.testing.assert_array_equal(as_mesh(pair).faces, mesh.faces)
    assert as_mesh(mesh) is mesh


@pytest.mark.parametrize(
    "obj", [POINTS, PointCloud(POINTS), (POINTS, POINTS[:, :2]), (POINTS, "faces"), b"mesh.ply", None]
)
def test_what_has_no_faces_is_no_mesh(obj: object) -> None:
    with pytest.raises(InputError, match="Expected a mesh of open3d"):
        as_mesh(obj)


def test_an_empty_set_of_meshes_is_refused() -> None:
    import pymeshlab

    with pytest.raises(InputError, match="holds no mesh"):
        as_cloud(pymeshlab.MeshSet())


def test_no_library_is_loaded_that_the_caller_does_not_use() -> None:
    script = (
        "import sys, numpy\nfrom gnrecon.io import as_cloud\nimport gnrecon.ingest\nas_cloud(numpy.zeros((2, 3)))\n"
        "print([name for name in ('open3d', 'trimesh', 'torch', 'pymeshlab') if name in sys.modules])"
    )
    repository = Path(__file__).resolve().parents[2]
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=repository, check=True)
    assert result.stdout == "[]\n"


def test_trimesh_clouds_keep_their_normals(tmp_path: Path) -> None:
    import trimesh

    cloud = PointCloud(POINTS, NORMALS)
    check(as_cloud(to_trimesh(cloud)), normals=True)
    named = trimesh.PointCloud(POINTS)
    named.vertex_normals = NORMALS
    check(as_cloud(named), normals=True)
    write_cloud(PointCloud(POINTS - POINTS.mean(axis=0), NORMALS), tmp_path / "cloud.ply")
    read = trimesh.load(tmp_path / "cloud.ply")
    np.testing.assert_allclose(as_cloud(read).normals, NORMALS, rtol=1e-6)
    read.vertices = read.vertices[:10]  # now its file's normals no longer fit
    assert as_cloud(read).normals is None


@pytest.mark.parametrize("kind", [str, Path])
def test_paths_are_read(tmp_path: Path, kind: type) -> None:
    write_mesh(TRIANGLE, tmp_path / "mesh.ply")
    path = kind(tmp_path / "mesh.ply")
    np.testing.assert_array_equal(as_cloud(path).points, TRIANGLE.vertices)
    np.testing.assert_array_equal(as_mesh(path).faces, TRIANGLE.faces)
    with pytest.raises(InputError, match="Expected points"):
        as_shape(path)  # what a plugin returned is no path to read
    with pytest.raises(InputError, match="there is no such file"):
        as_cloud(kind(tmp_path / "none.ply"))


class _Unwilling:
    """An object that numpy cannot turn into an array."""

    def __array__(self, *_: object, **__: object) -> None:
        raise RuntimeError("no")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "obj", [[[10**400] * 3] * 20, np.ones((20, 3)) + 1j, _Unwilling(), torch.empty((20, 3), device="meta")]
)
def test_what_is_no_array_of_real_numbers_is_refused(obj: Any) -> None:
    with pytest.raises(InputError, match=r"Expected .*, but got (list|complex numbers|_Unwilling|Tensor)\."):
        as_cloud(obj)
    with pytest.raises(InputError, match="Expected"):
        as_cloud(np.ones((20, 3)), obj)


def test_masked_coordinates_are_missing() -> None:
    points = np.ma.masked_equal(np.arange(30.0).reshape(10, 3), 4.0)
    assert np.isnan(as_cloud(points).points).sum() == 1

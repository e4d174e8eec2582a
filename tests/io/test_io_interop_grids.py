"""Data sets of pyvista and meshes of meshio come in and go out; both libraries are optional."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import as_cloud, as_mesh, as_shape, to_meshio, to_pyvista
from gnrecon.runtime.errors import InputError

POINTS = np.random.default_rng(0).normal(size=(20, 3)) + np.array([431234.123456789, 5412345.987654321, 312.1])
NORMALS = np.random.default_rng(1).normal(size=(20, 3))
COLORS = np.random.default_rng(2).integers(0, 255, (20, 3)).astype(np.uint8)
CLOUD = PointCloud(POINTS, NORMALS, {"colors": COLORS, "heat": POINTS[:, 2]})
TETRAHEDRON = Mesh(
    np.vstack([np.zeros(3), np.eye(3)]), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], None, {"heat": np.arange(4.0)}
)


@pytest.fixture
def pyvista() -> Any:
    return pytest.importorskip("pyvista", reason="pyvista is not installed")


@pytest.fixture
def meshio() -> Any:
    return pytest.importorskip("meshio", reason="meshio is not installed")


def assert_same(found: Mesh | PointCloud, expected: Mesh | PointCloud) -> None:
    assert type(found) is type(expected)
    assert found.attributes.keys() == expected.attributes.keys()
    for name, values in expected.attributes.items():
        np.testing.assert_array_equal(found.attributes[name], values)
    if isinstance(found, Mesh) and isinstance(expected, Mesh):
        np.testing.assert_array_equal(found.vertices, expected.vertices)
        np.testing.assert_array_equal(found.faces, expected.faces)
    elif isinstance(found, PointCloud) and isinstance(expected, PointCloud):
        np.testing.assert_array_equal(found.points, expected.points)
        np.testing.assert_array_equal(found.normals, expected.normals)


@pytest.mark.usefixtures("pyvista")
def test_clouds_and_meshes_go_through_pyvista() -> None:
    assert_same(as_cloud(to_pyvista(CLOUD)), CLOUD)
    assert_same(as_mesh(to_pyvista(TETRAHEDRON)), TETRAHEDRON)
    assert_same(as_shape(to_pyvista(PointCloud(POINTS))), PointCloud(POINTS))
    assert to_pyvista(TETRAHEDRON).is_manifold
    assert to_pyvista(CLOUD).point_data.active_normals_name == "Normals"


def test_other_data_sets_of_pyvista(pyvista: Any) -> None:
    assert_same(as_cloud(pyvista.PointSet(POINTS)), PointCloud(POINTS))
    cube = as_mesh(pyvista.Cube())  # of quadrangles
    assert cube.volume == pytest.approx(1)
    solid = pyvista.Sphere().cast_to_unstructured_grid()
    assert as_mesh(solid).volume == pytest.approx(pyvista.Sphere().volume)
    cells = pyvista.PolyData(POINTS).cast_to_unstructured_grid()  # of vertices alone
    assert_same(as_shape(cells), PointCloud(POINTS))
    sheet = pyvista.StructuredGrid(*np.meshgrid(np.arange(3.0), np.arange(4.0), [0.0]))
    assert as_mesh(sheet).area == pytest.approx(6)


def test_data_sets_without_a_surface_are_refused(pyvista: Any) -> None:
    with pytest.raises(InputError, match=r"ImageData holds values in a volume, .* pass its contour\(\)"):
        as_cloud(pyvista.ImageData(dimensions=(3, 3, 3)))
    with pytest.raises(InputError, match="RectilinearGrid holds values in a volume"):
        as_cloud(pyvista.RectilinearGrid(np.arange(3.0), np.arange(3.0), np.arange(3.0)))
    with pytest.raises(InputError, match="MultiBlock holds several data sets"):
        as_cloud(pyvista.MultiBlock([pyvista.Cube()]))
    with pytest.raises(InputError, match="without faces"):
        as_mesh(pyvista.PolyData(POINTS))


@pytest.mark.usefixtures("meshio")
def test_clouds_and_meshes_go_through_meshio() -> None:
    assert_same(as_cloud(to_meshio(CLOUD)), CLOUD)
    assert_same(as_mesh(to_meshio(TETRAHEDRON)), TETRAHEDRON)
    assert [block.type for block in to_meshio(TETRAHEDRON).cells] == ["triangle"]


def test_polygons_of_meshio_are_cut_into_fans(meshio: Any) -> None:
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [-1, 0.5, 0]]
    blocks = [("quad", [[0, 1, 2, 3]]), ("triangle", [[0, 3, 4]]), ("line", [[0, 1]])]
    assert as_mesh(meshio.Mesh(corners, blocks)).area == pytest.approx(1.5)
    assert as_mesh(meshio.Mesh(corners, [("polygon", [[0, 1, 2, 3, 4]])])).area == pytest.approx(1.5)
    with pytest.raises(InputError, match=r"points of shape \(1, 2\)"):
        as_cloud(meshio.Mesh([[0.0, 0.0]], []))

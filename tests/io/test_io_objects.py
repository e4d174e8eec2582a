"""Objects of other libraries come in and go out unchanged."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gnrecon.cloud import PointCloud
from gnrecon.errors import InputError
from gnrecon.io import as_cloud, to_open3d, to_trimesh
from gnrecon.mesh import Mesh

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


@pytest.mark.parametrize("obj", [np.zeros((4, 2)), np.zeros(3), "points", object(), None])
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


def test_no_library_is_loaded_that_the_caller_does_not_use() -> None:
    script = (
        "import sys, numpy\nfrom gnrecon.io import as_cloud\nimport gnrecon.ingest\nas_cloud(numpy.zeros((2, 3)))\n"
        "print([name for name in ('open3d', 'trimesh', 'torch', 'pymeshlab') if name in sys.modules])"
    )
    repository = Path(__file__).resolve().parents[2]
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=repository, check=True)
    assert result.stdout == "[]\n"

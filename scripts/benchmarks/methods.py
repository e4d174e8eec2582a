"""The methods that are compared, each from points and outward normals to a mesh.

An entry of the table loads the libraries of its method and returns the function that does the work, so that only the
work is timed. A function's keyword arguments are its settings.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gnrecon.cloud import PointCloud
from gnrecon.mesh import Mesh

Method = Callable[..., Mesh]


def load_gnrecon() -> Method:
    """The main job of gnrecon; `options` are those of `gnrecon.reconstruct`."""
    # gnrecon itself imports these on first use.
    import manifold3d  # noqa: F401
    import open3d  # noqa: F401
    import skimage.measure  # noqa: F401

    from gnrecon.pipeline import reconstruct

    def run(scan: PointCloud, **options: Any) -> Mesh:
        return reconstruct(scan.points, normals=scan.normals, **options).mesh

    return run


def load_poisson() -> Method:
    """Screened Poisson (Kazhdan and Hoppe 2013) as open3d has it, its mesh left untrimmed."""
    import open3d

    def run(scan: PointCloud, depth: int, n_threads: int) -> Mesh:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(scan.points))
        cloud.normals = open3d.utility.Vector3dVector(scan.normals)
        mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=n_threads)
        return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles))

    return run


METHODS: dict[str, Callable[[], Method]] = {"gnrecon": load_gnrecon, "Poisson": load_poisson}

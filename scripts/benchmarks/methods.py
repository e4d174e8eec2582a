"""The methods that are compared, each from points and outward normals to a mesh.

An entry of the table loads the libraries of its method and returns the function that does the work, so that only the
work is timed. The function takes points and normals, both of shape (N, 3), and its settings by keyword; it returns the
mesh, and details that are worth keeping beside the figures.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gnrecon.cloud import Float
from gnrecon.mesh import Mesh

Method = Callable[..., tuple[Mesh, dict[str, Any]]]


def load_gnrecon() -> Method:
    """Load the main job of gnrecon, whose settings are the options of `gnrecon.reconstruct`."""
    # gnrecon itself imports these on first use.
    import manifold3d  # noqa: F401
    import open3d  # noqa: F401
    import skimage.measure  # noqa: F401

    from gnrecon.pipeline import reconstruct

    def run(points: Float, normals: Float, **options: Any) -> tuple[Mesh, dict[str, Any]]:
        result = reconstruct(points, normals=normals, **options)
        return result.mesh, {"stages": result.report["stages"], "status": result.report["fit"]["status"]}

    return run


def load_poisson() -> Method:
    """Load screened Poisson (Kazhdan and Hoppe 2013) as open3d has it, its mesh left untrimmed."""
    import open3d

    def run(points: Float, normals: Float, depth: int, n_threads: int) -> tuple[Mesh, dict[str, Any]]:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        cloud.normals = open3d.utility.Vector3dVector(normals)
        mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=n_threads)
        return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles)), {}

    return run


METHODS: dict[str, Callable[[], Method]] = {"gnrecon": load_gnrecon, "Poisson": load_poisson}

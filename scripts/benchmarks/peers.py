"""What others offer for the same work: open3d's and MeshLab's ways from oriented points to a mesh.

Each loader imports its library and returns the function that does the work, as `methods` tells. All of them need
normals. Where the scan has none, these are estimated from 16 neighbours and oriented along a spanning tree of tangent
planes (Hoppe et al. 1992), both by open3d, within the time of the method. `outliers` has them remove scattered points
first, by open3d's statistical rule with the parameters of its tutorial: 20 neighbours, two standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh

Answer = tuple[Mesh, dict[str, Any]]

NEIGHBOURS = 16
"""Of a point, for its normal and for the spanning tree."""

OUTLIER_NEIGHBOURS, OUTLIER_DEVIATIONS = 20, 2.0
BALL_RADII = (1.5, 3.0, 6.0)
"""Of ball pivoting, in mean distances from a point to its nearest neighbour."""


def load_poisson() -> Callable[..., Answer]:
    """Load screened Poisson (Kazhdan and Hoppe 2013) as open3d has it, its mesh left untrimmed."""
    import open3d

    def run(points: Float, normals: Float | None, depth: int, n_threads: int, outliers: bool = False) -> Answer:
        cloud = oriented(points, normals, outliers)
        mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=n_threads)
        return _of_open3d(mesh)

    return run


def load_ball_pivoting() -> Callable[..., Answer]:
    """Load ball pivoting (Bernardini et al. 1999) as open3d has it, with growing balls."""
    import open3d

    def run(points: Float, normals: Float | None, outliers: bool = False) -> Answer:
        cloud = oriented(points, normals, outliers)
        spacing = np.asarray(cloud.compute_nearest_neighbor_distance()).mean()
        radii = open3d.utility.DoubleVector(spacing * np.array(BALL_RADII))
        return _of_open3d(open3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii))

    return run


def load_meshlab_poisson() -> Callable[..., Answer]:
    """Load screened Poisson as MeshLab has it."""
    return _load_meshlab("generate_surface_reconstruction_screened_poisson")


def load_rimls() -> Callable[..., Answer]:
    """Load robust implicit moving least squares (Oeztireli et al. 2009) with MeshLab's marching cubes."""
    return _load_meshlab("generate_marching_cubes_rimls")


def load_apss() -> Callable[..., Answer]:
    """Load algebraic point set surfaces (Guennebaud and Gross 2007) with MeshLab's marching cubes."""
    return _load_meshlab("generate_marching_cubes_apss")


def oriented(points: Float, normals: Float | None, outliers: bool) -> Any:
    """Return an open3d cloud with normals, without outliers where these are to be removed."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    if normals is not None:
        cloud.normals = open3d.utility.Vector3dVector(normals)
    if outliers:
        cloud, _ = cloud.remove_statistical_outlier(OUTLIER_NEIGHBOURS, OUTLIER_DEVIATIONS)
    if normals is None:
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS))
        cloud.orient_normals_consistent_tangent_plane(NEIGHBOURS)
    return cloud


def _load_meshlab(name: str) -> Callable[..., Answer]:
    """Load one of MeshLab's filters that makes a mesh of the points; its parameters are those of the function."""
    # The others' normals are those of open3d, and so are these.
    import open3d  # noqa: F401
    import pymeshlab

    def run(points: Float, normals: Float | None, outliers: bool = False, **parameters: Any) -> Answer:
        cloud = oriented(points, normals, outliers)
        scan = pymeshlab.Mesh(vertex_matrix=np.asarray(cloud.points), v_normals_matrix=np.asarray(cloud.normals))
        meshes = pymeshlab.MeshSet(verbose=False)
        meshes.add_mesh(scan)
        meshes.apply_filter(name, **parameters)
        made = meshes.current_mesh()
        return Mesh(made.vertex_matrix(), made.face_matrix()), {}

    return run


def _of_open3d(mesh: Any) -> Answer:
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles)), {}

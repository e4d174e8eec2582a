"""The compared methods, each from points, with or without outward normals, to a mesh.

An entry of `METHODS` imports the libraries of its method and returns the function that does the work, so that only the
work is timed. The function takes points and normals (or None), both of shape (N, 3), and its settings by keyword; it
returns the mesh and details to record with the figures.

The peers are open3d's and MeshLab's methods. All of them need normals. If the scan has none, open3d estimates them from
16 neighbours and orients them along a spanning tree of tangent planes (Hoppe et al. 1992), within the time of the
method. With `outliers`, scattered points are first removed by open3d's statistical rule.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.accuracy.parts import PARTS
from gnrecon.fit.parameters import FitParameters
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh

Answer = tuple[Mesh, dict[str, Any]]
Method = Callable[..., Answer]


def load_gnrecon() -> Method:
    """Load gnrecon; its settings are the options of `gnrecon.reconstruct`, and a part to leave out of the fit."""
    # gnrecon itself imports these on first use.
    import manifold3d  # noqa: F401
    import open3d  # noqa: F401
    import skimage.measure  # noqa: F401

    from gnrecon.fit import fit
    from gnrecon.pipeline import reconstruct

    def run(points: Float, normals: Float | None, without: str | None = None, **options: Any) -> Answer:
        parameters = FitParameters() if without is None else PARTS[without]
        with patch("gnrecon.pipeline.fit", partial(fit, parameters=parameters)):
            result = reconstruct(points, normals=normals, **options)
        return result.mesh, {"stages": result.report["stages"], "status": result.report["fit"]["status"]}

    return run


def load_poisson() -> Method:
    """Load screened Poisson (Kazhdan and Hoppe 2013) as open3d has it, its mesh left untrimmed."""
    import open3d

    def run(points: Float, normals: Float | None, depth: int, n_threads: int, outliers: bool = False) -> Answer:
        cloud = oriented(points, normals, outliers)
        mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=n_threads)
        return _of_open3d(mesh)

    return run


def load_ball_pivoting() -> Method:
    """Load ball pivoting (Bernardini et al. 1999) as open3d has it, with balls of growing radii.

    `radii_spacings` are in mean distances from a point to its nearest neighbour.
    """
    import open3d

    def run(
        points: Float,
        normals: Float | None,
        outliers: bool = False,
        *,
        radii_spacings: tuple[float, ...] = (1.5, 3.0, 6.0),
    ) -> Answer:
        cloud = oriented(points, normals, outliers)
        spacing = np.asarray(cloud.compute_nearest_neighbor_distance()).mean()
        radii = open3d.utility.DoubleVector(spacing * np.array(radii_spacings))
        return _of_open3d(open3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(cloud, radii))

    return run


def load_meshlab_poisson() -> Method:
    """Load screened Poisson as MeshLab has it."""
    return _load_meshlab("generate_surface_reconstruction_screened_poisson")


def load_rimls() -> Method:
    """Load robust implicit moving least squares (Oeztireli et al. 2009) with MeshLab's marching cubes."""
    return _load_meshlab("generate_marching_cubes_rimls")


def load_apss() -> Method:
    """Load algebraic point set surfaces (Guennebaud and Gross 2007) with MeshLab's marching cubes."""
    return _load_meshlab("generate_marching_cubes_apss")


def oriented(
    points: Float,
    normals: Float | None,
    outliers: bool,
    *,
    neighbours: int = 16,
    outlier_neighbours: int = 20,
    outlier_deviations: float = 2.0,
) -> Any:
    """Return an open3d cloud with normals.

    Parameters
    ----------
    points, normals : of shape (N, 3); normals that are None are estimated and oriented
    outliers : whether to remove points by the statistical rule
    neighbours : of a point, for its normal and for the spanning tree
    outlier_neighbours, outlier_deviations : of the statistical rule, as in open3d's tutorial
    """
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    if normals is not None:
        cloud.normals = open3d.utility.Vector3dVector(normals)
    if outliers:
        cloud, _ = cloud.remove_statistical_outlier(outlier_neighbours, outlier_deviations)
    if normals is None:
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(neighbours))
        cloud.orient_normals_consistent_tangent_plane(neighbours)
    return cloud


def _load_meshlab(name: str) -> Method:
    """Load one of MeshLab's filters that makes a mesh of the points; its parameters are those of the function."""
    # Its normals are estimated by open3d, as the other peers' are.
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


METHODS: dict[str, Callable[[], Method]] = {
    "gnrecon": load_gnrecon,
    "Adam": load_gnrecon,
    "L-BFGS": load_gnrecon,
    "Poisson": load_poisson,
    "MeshLab Poisson": load_meshlab_poisson,
    "ball pivoting": load_ball_pivoting,
    "RIMLS": load_rimls,
    "APSS": load_apss,
}
OURS = ("gnrecon", "Adam", "L-BFGS")
"""gnrecon, and the same fit by the optimisers that the paper compares with."""

PEERS = tuple(name for name in METHODS if name not in OURS)

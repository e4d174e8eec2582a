"""The methods that are compared, each from points, with or without outward normals, to a mesh.

An entry of the table loads the libraries of its method and returns the function that does the work, so that only the
work is timed. The function takes points and normals (or None), both of shape (N, 3), and its settings by keyword; it
returns the mesh, and details that are worth keeping beside the figures.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from benchmarks.peers import load_apss, load_ball_pivoting, load_meshlab_poisson, load_poisson, load_rimls
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh

Method = Callable[..., tuple[Mesh, dict[str, Any]]]


def load_gnrecon() -> Method:
    """Load the main job of gnrecon, whose settings are the options of `gnrecon.reconstruct`."""
    # gnrecon itself imports these on first use.
    import manifold3d  # noqa: F401
    import open3d  # noqa: F401
    import skimage.measure  # noqa: F401

    from gnrecon.pipeline import reconstruct

    def run(points: Float, normals: Float | None, **options: Any) -> tuple[Mesh, dict[str, Any]]:
        result = reconstruct(points, normals=normals, **options)
        return result.mesh, {"stages": result.report["stages"], "status": result.report["fit"]["status"]}

    return run


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
"""gnrecon itself, and the same fit by the methods that the paper compares with."""

PEERS = tuple(name for name in METHODS if name not in OURS)

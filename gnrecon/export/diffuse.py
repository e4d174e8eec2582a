"""Smooth values over a surface by diffusion.

One implicit step of the heat equation, (M + t L) u = M u_0, with the cotangent Laplacian L and the vertices' areas M.
Unlike means over neighbours it does not depend on how the surface is cut into triangles: on a plane it leaves linear
values as they are. A step of t averages over about a Gaussian with the variance 2 t along each direction.

Source: Desbrun, Meyer, Schroeder and Barr, Implicit fairing of irregular meshes (SIGGRAPH 1999).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import LinearOperator, cg

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh

TOLERANCE, MOST_STEPS = 1e-6, 500
"""Of conjugate gradients: relative residual, and most steps."""


def diffused(mesh: Mesh, values: Float, width: float) -> Float:
    """Return values, of shape (V,), averaged over a width, in units of the vertices, along the surface."""
    areas = vertex_areas(mesh)
    # A vertex without area would be tied to nothing.
    mass = np.maximum(areas, 1e-9 * areas.mean())
    matrix = diags_array(mass) + 0.5 * width**2 * _cotangent_laplacian(mesh)
    scale = 1 / matrix.diagonal()
    scaling: Any = LinearOperator(matrix.shape, matvec=lambda residual: scale * residual.reshape(-1))
    smooth = cg(matrix, mass * values, x0=values, rtol=TOLERANCE, maxiter=MOST_STEPS, M=scaling)[0]
    return np.asarray(smooth, dtype=np.float64)


def vertex_areas(mesh: Mesh) -> Float:
    """A third of the area of the faces around each vertex, of shape (V,)."""
    shares = np.repeat(np.linalg.norm(mesh.face_vectors, axis=1) / 3, 3)
    return np.asarray(np.bincount(mesh.faces.reshape(-1), shares, minlength=len(mesh.vertices)))


def _cotangent_laplacian(mesh: Mesh) -> Any:
    """The positive semidefinite matrix, of shape (V, V), whose quadratic form is the Dirichlet energy."""
    rows, columns, weights = [], [], []
    corners = mesh.corners
    double_areas = 2 * np.linalg.norm(mesh.face_vectors, axis=1)
    for corner in range(3):
        one, other = (corner + 1) % 3, (corner + 2) % 3
        product = np.einsum("ij,ij->i", corners[:, one] - corners[:, corner], corners[:, other] - corners[:, corner])
        # Half the cotangent of the angle at this corner belongs to the edge that faces it; collapsed faces to none.
        half = np.divide(product, 2 * double_areas, out=np.zeros_like(product), where=double_areas > 0)
        i, j = mesh.faces[:, one], mesh.faces[:, other]
        rows += [i, j, i, j]
        columns += [j, i, i, j]
        weights += [-half, -half, half, half]
    entries = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns)))
    size = len(mesh.vertices)
    return coo_array(entries, shape=(size, size)).tocsr()

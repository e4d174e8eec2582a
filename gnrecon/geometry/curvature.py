"""Mean and Gauss curvature of level sets, from a field's gradient and second derivatives.

With g = grad f and the Hessian H, the level set of f through a point has there

    mean  = (|g|^2 tr H - g . H g) / (2 |g|^3),        Gauss = g . adj(H) g / |g|^4,

where adj is the adjugate, the transposed matrix of cofactors. Where f is negative inside, the mean curvature of a
sphere of radius r is 1/r: it is the mean of the two principal curvatures, each positive where the surface bends away
from the outward normal. They follow as mean +- sqrt(mean^2 - Gauss).

Source: Goldman, Curvature formulas for implicit curves and surfaces, Computer Aided Geometric Design 22 (2005).

`curvatures` computes them. `diffuse` smooths values over a surface, and `interpolate_from_samples` spreads a costly
quantity over one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import LinearOperator, cg
from scipy.spatial import cKDTree

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh


def curvatures(gradient: Float, hessian: Float) -> tuple[Float, Float]:
    """Return mean and Gauss curvature, each of shape (N,); not a number where the gradient vanishes.

    Parameters
    ----------
    gradient : array of shape (N, 3)
    hessian : array of shape (N, 3, 3)
        Symmetric; per the unit in which the curvatures come.
    """
    length = np.linalg.norm(gradient, axis=1)
    bend = np.einsum("ni,nij,nj->n", gradient, hessian, gradient)
    trace = np.einsum("nii->n", hessian)
    rows = np.roll(hessian, -1, axis=1), np.roll(hessian, -2, axis=1)
    # The cofactors of a row are the cross product of the two that follow it; the matrix is symmetric, so they are adj.
    adjugate = np.cross(*rows)
    twist = np.einsum("ni,nij,nj->n", gradient, adjugate, gradient)
    defined = length > 0
    mean, gauss = np.full((2, len(length)), np.nan)
    np.divide(length**2 * trace - bend, 2 * length**3, out=mean, where=defined)
    np.divide(twist, length**4, out=gauss, where=defined)
    return mean, gauss


# Smoothing by diffusion: one implicit step of the heat equation, (M + t L) u = M u_0, with the cotangent Laplacian L
# and the vertices' areas M. Unlike means over neighbours it does not depend on the triangulation: on a plane it leaves
# linear values unchanged. A step of t averages over about a Gaussian with the variance 2 t along each direction.
#
# Source: Desbrun, Meyer, Schroeder and Barr, Implicit fairing of irregular meshes (SIGGRAPH 1999).


def diffuse(mesh: Mesh, values: Float, width: float, *, tolerance: float = 1e-6, most_steps: int = 500) -> Float:
    """Return values, of shape (V,), averaged over a width, in units of the vertices, along the surface.

    `tolerance` is the relative residual of conjugate gradients, and `most_steps` their number; few of these are needed.
    """
    areas = vertex_areas(mesh)
    # A vertex without area would make the matrix singular.
    mass = np.maximum(areas, 1e-9 * areas.mean())
    matrix = diags_array(mass) + 0.5 * width**2 * _cotangent_laplacian(mesh)
    scale = 1 / matrix.diagonal()
    scaling: Any = LinearOperator(matrix.shape, matvec=lambda residual: scale * residual.reshape(-1))
    smooth = cg(matrix, mass * values, x0=values, rtol=tolerance, maxiter=most_steps, M=scaling)[0]
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


def interpolate_from_samples(
    quantity: Callable[[Float], Float],
    mesh: Mesh,
    most: int = 20_000,
    seed: int = 0,
    *,
    neighbours: int = 4,
    radian_spacings: float = 4.0,
) -> Float:
    """Return a positive, smooth and costly quantity at all vertices, of shape (V,), from its values at some of them.

    Values are inverse-distance means of the nearest samples' logarithms, because the quantity may span decades. The
    distance counts positions and normals, so that the two sides of a thin sheet do not mix.
    Source: Shepard, A two-dimensional interpolation function for irregularly-spaced data (1968).

    Parameters
    ----------
    quantity : function of points, of shape (N, 3), to positive values, of shape (N,)
    mesh : Mesh
    most : int
        Vertices at which it is evaluated; all where the mesh has no more.
    seed : int
        Of their choice.
    neighbours : int
        Samples that a vertex averages.
    radian_spacings : float
        Distance of normals one radian apart, in spacings of the samples.
    """
    if len(mesh.vertices) <= most:
        return quantity(mesh.vertices)
    chosen = np.sort(np.random.default_rng(seed).permutation(len(mesh.vertices))[:most])
    known = np.log(np.maximum(quantity(mesh.vertices[chosen]), np.finfo(np.float64).tiny))
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    spacing = np.median(cKDTree(centred[chosen]).query(centred[chosen], 2)[0][:, 1])
    places = np.concatenate([centred, radian_spacings * spacing * mesh.vertex_normals()], axis=1)
    distances, near = cKDTree(places[chosen]).query(places, neighbours)
    weights = 1 / np.maximum(distances, 1e-6 * max(spacing, np.finfo(np.float64).tiny)) ** 2
    values: Float = np.exp((weights * known[near]).sum(axis=1) / weights.sum(axis=1))
    return values

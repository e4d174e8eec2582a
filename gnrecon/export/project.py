"""Bring a mesh's vertices onto the zero level by Newton's method along the gradient.

Each step is x <- x - f grad f / |grad f|^2, the orthogonal Newton step of the paper (section on surface sampling). A
vertex keeps its step only where |f| falls, and its old place where it would have to go further than a limit: there the
linear model does not hold, or the vertex sits on the cap that closes the field at its box. Afterwards, vertices of
faces that have turned over or collapsed go back, until none is left.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gnrecon.advance import Advance, unheard
from gnrecon.cloud import Float
from gnrecon.errors import UsageError
from gnrecon.export.protocol import SignedDistance
from gnrecon.mesh import Mesh

Mask = npt.NDArray[np.bool_]

TURN, COLLAPSE = 0.3, 1e-3
"""Least cosine between a face's old and new normal, and least new area as a share of the old."""


def project(
    mesh: Mesh,
    field: SignedDistance,
    *,
    steps: int = 3,
    limit: float | None = None,
    batch: int = 65536,
    advance: Advance = unheard,
) -> Mesh:
    """Move vertices onto the zero level and give them normals.

    Parameters
    ----------
    mesh : Mesh
        As `extract` returns it, in file units.
    field : SignedDistance
        The field that it was extracted from.
    steps : int
        Newton steps; two bring a smooth field to rounding.
    limit : float, file units, optional
        Longest way that a vertex may go; by default half the median edge, which is less than half a cell.
    batch : int
        Most points to ask the field for at once.
    advance : callable
        Told of the share that is done after each batch.

    Returns
    -------
    Mesh
        The same faces; vertex normals are the field's unit gradients, and the faces' mean on caps.

    Raises
    ------
    UsageError
        When `steps` is negative or `limit` not positive.
    """
    if steps < 0:
        raise UsageError(f"The number of Newton steps is {steps}, but cannot be negative.")
    if limit is None:
        edges = np.diff(mesh.corners, axis=1, append=mesh.corners[:, :1])
        limit = 0.5 * float(np.median(np.linalg.norm(edges, axis=2)))
    if not limit > 0:
        raise UsageError(f"The limit is {limit} file units, but must be positive.")
    moved = np.empty_like(mesh.vertices)
    value = np.empty(len(moved))
    gradient = np.empty_like(moved)
    for start in range(0, len(moved), batch):
        rows = slice(start, start + batch)
        moved[rows], value[rows], gradient[rows] = _newton(mesh.vertices[rows], field, steps, limit)
        advance(min(start + batch, len(moved)) / len(moved))
    back = _undo_turned(mesh, moved)
    lengths = np.linalg.norm(gradient, axis=1, keepdims=True)
    normals = np.divide(gradient, lengths, out=np.zeros_like(gradient), where=lengths > 0)
    result = mesh.with_vertices(np.where(back[:, None], mesh.vertices, moved))
    by_faces = Mesh(result.vertices, result.faces).vertex_normals()
    # On a cap, and where the field folds, the gradient is not the surface's normal.
    unfit = (np.abs(value) > limit) | (np.einsum("ij,ij->i", normals, by_faces) <= 0)
    return Mesh(result.vertices, result.faces, np.where(unfit[:, None], by_faces, normals))


def _newton(start: Float, field: SignedDistance, steps: int, limit: float) -> tuple[Float, Float, Float]:
    """Points after the steps, with the field's value and gradient there."""
    points = start.copy()
    value, gradient = field.sdf(points), field.gradient(points)
    low, high = field.bounds
    for _ in range(steps):
        squares = np.maximum(np.einsum("ij,ij->i", gradient, gradient), np.finfo(np.float64).tiny)
        trial = points - (value / squares)[:, None] * gradient
        near = (np.linalg.norm(trial - start, axis=1) <= limit) & ((trial >= low) & (trial <= high)).all(axis=1)
        rows = np.flatnonzero(near)
        if not len(rows):
            break
        trial_value = field.sdf(trial[rows])
        better = np.abs(trial_value) < np.abs(value[rows])
        rows = rows[better]
        points[rows], value[rows] = trial[rows], trial_value[better]
        gradient[rows] = field.gradient(points[rows])
    return points, value, gradient


def _undo_turned(mesh: Mesh, moved: Float) -> Mask:
    """Which vertices must stay, of shape (V,), so that no face turns over or collapses.

    Every round returns at least one more vertex, and a face whose three vertices have stayed is as before, so it ends.
    """
    old = mesh.face_vectors
    squares = np.einsum("ij,ij->i", old, old)
    back = np.zeros(len(moved), dtype=bool)
    while True:
        new = mesh.with_vertices(np.where(back[:, None], mesh.vertices, moved)).face_vectors
        along = np.einsum("ij,ij->i", old, new)
        areas = np.linalg.norm(new, axis=1)
        bad = (along < TURN * areas * np.sqrt(squares)) | (areas < COLLAPSE * np.sqrt(squares))
        again = np.zeros_like(back)
        again[mesh.faces[bad]] = True
        if not (again & ~back).any():
            return back
        back |= again

"""Parts of a mesh that no scanned point supports.

Where a fitted field has no data it may cross zero by chance: ghost sheets in free space, and cavities within the solid.
Each input point votes for the component that its nearest face belongs to. A component with fewer votes than three, or
than half a percent of the points, is stray and dropped; the one with the most votes always stays. Of what remains,
components that lie within an even number of others are made outer shells (positive volume), those within an odd number
cavities (negative volume): dropping a shell may have changed which of the two a component is.
"""

from __future__ import annotations

import numpy as np

from gnrecon.export.nearest import nearest_on_surface
from gnrecon.export.topology import face_components, submesh
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import UsageError

LEAST_VOTES, LEAST_SHARE = 3, 0.005


def remove_stray(mesh: Mesh, points: Float) -> tuple[Mesh, list[str]]:
    """Drop components that too few points lie nearest to.

    A component stays when it is nearest to at least ``max(3, 0.5 % of the points)`` points, or to more than any other.

    Parameters
    ----------
    mesh : Mesh
        Closed, in file units.
    points : array of shape (N, 3), file units
        The cloud that was fitted.

    Returns
    -------
    Mesh
        The same mesh where nothing was dropped.
    list of str
        A sentence with counts for what was done.

    Raises
    ------
    UsageError
        When there are no points.
    """
    labels, stays, actions = _judged(mesh, points)
    if stays.all():
        return mesh, []
    parts = [submesh(mesh, labels == label) for label in np.flatnonzero(stays)]
    oriented = [_oriented(part, [other for other in parts if other is not part]) for part in parts]
    turned = sum(new is not old for new, old in zip(oriented, parts, strict=True))
    if turned:
        actions.append(f"Turned {turned} components round, because the shell around them was dropped.")
    return _joined(oriented), actions


def drop_stray(mesh: Mesh, points: Float) -> tuple[Mesh, list[str]]:
    """Drop the same components of a mesh that may have borders; those that stay keep their sides.

    Parameters, what is returned and what is raised are those of `remove_stray`.
    """
    labels, stays, actions = _judged(mesh, points)
    return (mesh, []) if stays.all() else (submesh(mesh, stays[labels]), actions)


def _judged(mesh: Mesh, points: Float) -> tuple[Int, Mask, list[str]]:
    """Return each face's component, which components stay, and a sentence about those that do not."""
    if not len(points):
        raise UsageError("There are no points to tell stray components by.")
    labels = face_components(mesh)
    count = int(labels.max(initial=-1)) + 1
    if count < 2:
        return labels, np.ones(count, dtype=bool), []
    votes = np.bincount(labels[nearest_on_surface(mesh, points)[1]], minlength=count)
    least = max(LEAST_VOTES, LEAST_SHARE * len(points))
    stays = votes >= least
    stays[votes.argmax()] = True
    dropped = np.count_nonzero(~stays)
    said = (
        f"Dropped {dropped} of {count} components, with {np.count_nonzero(~stays[labels])} of "
        f"{len(labels)} faces, that fewer than {least:g} of the {len(points)} points lie nearest to "
        f"(at most {votes[~stays].max(initial=0)})."
    )
    return labels, stays, [said] if dropped else []


def _oriented(part: Mesh, others: list[Mesh]) -> Mesh:
    """Turn a component round where its volume's sign does not fit the number of others around it."""
    outer = sum(_encloses(other, part.vertices[0]) for other in others) % 2 == 0
    if (part.volume > 0) == outer:
        return part
    return Mesh(part.vertices, part.faces[:, ::-1], None if part.normals is None else -part.normals)


def _encloses(shell: Mesh, point: Float) -> bool:
    """Whether a closed shell, either way round, winds about a point of shape (3,)."""
    if (point < shell.vertices.min(axis=0)).any() or (point > shell.vertices.max(axis=0)).any():
        return False
    a, b, c = np.moveaxis(shell.corners - point, 1, 0)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    # Half the solid angle of a triangle, by van Oosterom and Strackee (1983).
    half = np.arctan2(
        np.einsum("ij,ij->i", a, np.cross(b, c)),
        la * lb * lc
        + np.einsum("ij,ij->i", a, b) * lc
        + np.einsum("ij,ij->i", b, c) * la
        + np.einsum("ij,ij->i", c, a) * lb,
    )
    return bool(abs(half.sum() / (2 * np.pi)) > 0.5)


def _joined(parts: list[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)])
    normals = [part.normals for part in parts if part.normals is not None]
    return Mesh(np.concatenate([part.vertices for part in parts]), faces, np.concatenate(normals) if normals else None)

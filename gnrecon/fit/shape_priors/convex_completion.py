"""Completes scans of few points that lie in convex position, by samples of a smooth surface over their convex hull.

So few points leave a free field to bulge and fold between them. Where all of them lie on their convex hull, or hardly
beneath it, the hull is the simplest closed surface that explains them. Each of its triangles becomes a curved one that
passes through its corners at right angles to their normals, a cubic Bezier patch, and the fit takes samples of these
patches as if they had been scanned. Points in any other position are left to the fit.
Source: Vlachos, Peters, Boyd and Mitchell, Curved PN triangles (2001). Entry: `completed_convex`.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from gnrecon.fit.shape_priors.prior_parameters import ConvexCompletionParameters
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.point_cloud import Samples


def completed_convex(
    samples: Samples, *, parameters: ConvexCompletionParameters = ConvexCompletionParameters()
) -> Samples | None:
    """Return few samples in convex position with more between them, their own first, or None of any other scan.

    Normals that were estimated are replaced by those of the hull.
    """
    points = samples.points
    if len(points) > parameters.most_points:
        return None
    try:
        hull = ConvexHull(points)
    except QhullError:  # all in a plane, to within rounding
        return None
    spacing = float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))
    # Signed distances from the planes of all faces are negative inside.
    depth = -(points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
    if depth.max() > parameters.most_depth_spacings * spacing:
        return None
    faces = _outward(points, hull)
    own = _vertex_normals(points, faces) if samples.estimated else samples.normals
    # A cell of an equilateral triangle with sides of s has the area 0.43 s^2.
    step = float(np.sqrt(hull.area / parameters.samples / 0.43))
    patches = [_patch(points[face], own[face], _lattice(points[face], step)) for face in faces]
    more, normals = (np.concatenate(parts) for parts in zip(*patches, strict=True))
    if samples.estimated:
        beneath = np.setdiff1d(np.arange(len(points)), hull.vertices)
        own[beneath] = normals[cKDTree(more).query(points[beneath])[1]]
    return samples.replaced(np.concatenate([points, more]), np.concatenate([own, normals]))


def _outward(points: Float, hull: ConvexHull) -> Int:
    """Return the hull's faces, of shape (F, 3), counter-clockwise from outside."""
    faces: Int = hull.simplices.astype(np.int64)
    a, b, c = points[faces].transpose(1, 0, 2)
    turned = np.einsum("fc,fc->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[turned] = faces[turned][:, ::-1]
    return faces


def _vertex_normals(points: Float, faces: Int) -> Float:
    """Return the sum of the areas' vectors around each point, of unit length, of shape (N, 3); zero off the hull."""
    a, b, c = points[faces].transpose(1, 0, 2)
    sums = np.zeros_like(points)
    for corner in faces.T:
        np.add.at(sums, corner, np.cross(b - a, c - a))
    unit: Float = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return unit


def _lattice(corners: Float, step: float, *, finest: int = 12) -> Float:
    """Return barycentric coordinates, of shape (M, 3), of cells about a step wide within a triangle of shape (3, 3).

    None lies on the rim, where the samples of the next triangle would repeat it.
    """
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max()
    count = int(np.clip(np.ceil(longest / step), 1, finest))
    i, j = (index.ravel() for index in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    # Each parallelogram of the lattice has two triangles, but for those at the long side.
    cells = np.concatenate([np.stack([i, j], axis=1) + share for share in (1 / 3, 2 / 3)]) / count
    cells = cells[cells.sum(axis=1) < 1.0]
    return np.column_stack([cells, 1.0 - cells.sum(axis=1)])


def _patch(corners: Float, normals: Float, weights: Float, *, step: float = 1e-4) -> tuple[Float, Float]:
    """Return points and unit normals, of shape (M, 3), of the cubic patch over a triangle with normals at its corners.

    Normals are those of the patch, by central differences of `step` in barycentric coordinates.
    """
    # The control point next to corner i on the edge to j lies in the tangent plane of corner i.
    edge = {
        (i, j): (2 * corners[i] + corners[j] - ((corners[j] - corners[i]) @ normals[i]) * normals[i]) / 3
        for i in range(3)
        for j in range(3)
        if i != j
    }
    rim = np.mean(list(edge.values()), axis=0)
    middle = rim + (rim - corners.mean(axis=0)) / 2

    def at(w: Float) -> Float:
        found = 6 * np.prod(w, axis=1, keepdims=True) * middle
        for i in range(3):
            found = found + w[:, [i]] ** 3 * corners[i]
        for (i, j), control in edge.items():
            found = found + 3 * w[:, [i]] ** 2 * w[:, [j]] * control
        return np.asarray(found)

    first, second = step * np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]])
    across = np.cross(at(weights + first) - at(weights - first), at(weights + second) - at(weights - second))
    return at(weights), across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(np.float64).tiny)

"""Says what a scan cannot tell: how little few points show, and which parts are too small for the cells."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gnrecon.export.resolution import cells_for_sheet
from gnrecon.geometry.arrays import Float, Int


def few_points_remark(points: Float, *, few: int = 100) -> list[str]:
    """Return a sentence where fewer than `few` points, of shape (N, 3), leave the surface between them open."""
    if not 2 <= len(points) < few:
        return []
    spacing = float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))
    share = 100 * spacing / float(np.linalg.norm(np.ptp(points, axis=0)))
    return [
        f"There are only {len(points)} points, {spacing:.3g} apart ({share:.0f} % of the diagonal): between them the "
        "surface is the simplest guess, and shapes smaller than that are unknown."
    ]


def thin_sheet_remark(thickness: float | None, layers: float | None, cells: int, longest: float) -> list[str]:
    """Return a sentence where the mesh does not resolve the thinnest sheet that two layers of points show.

    Parameters
    ----------
    thickness : between layers that face opposite ways, file units, if there are any
    layers : distance of layers that face the same way by estimated normals, file units, if there are any
    cells : of the mesh, along its box
    longest : side of the box, file units
    """
    if layers is not None:
        return [
            "The two layers may also be the two sides of a thin sheet, which estimated normals do not show: give "
            f"outward normals and --resolution {cells_for_sheet(longest, layers)} for that."
        ]
    if thickness is None or cells >= (needed := cells_for_sheet(longest, thickness)):
        return []
    return [
        f"Two opposite layers of points are {thickness:.3g} apart, a sheet too thin for {cells} cells along the box; "
        f"--resolution {needed} resolves it."
    ]


def coarse_parts_remark(
    points: Float, cell: float, *, most_cell_spacings: float = 2.0, least_cells: float = 24.0, least_points: int = 10
) -> list[str]:
    """Return a sentence on parts, far from the rest, that the cells of the mesh do not resolve.

    Parameters
    ----------
    points : array of shape (N, 3), file units
    cell : edge of the mesh's cells, file units
    most_cell_spacings : a part is resolved with cells of at most so many distances of its points
    least_cells : and if it is at least so many cells long, however dense its points are
    least_points : fewer are no part of a surface
    """
    labels = _parts_apart(points)
    worst, spoilt = 0.0, 0
    for label in range(labels.max() + 1) if len(labels) else ():
        part = points[labels == label]
        if len(part) == len(points) or len(part) < least_points:
            continue
        some = part[:: max(1, len(part) // 1000)]
        spacing = float(np.median(cKDTree(part).query(some, 2)[0][:, 1]))
        length = float(np.linalg.norm(np.ptp(part, axis=0)))
        if length < least_cells * cell and cell > most_cell_spacings * spacing > 0:
            worst, spoilt = max(worst, cell / spacing), spoilt + 1
    if not spoilt:
        return []
    parts = "A part of the scan is" if spoilt == 1 else f"{spoilt} parts of the scan are"
    return [
        f"{parts} far smaller than the distance to the rest: a cell of {cell:.3g} is up to {worst:.0f} times the "
        "distance of points there, and the mesh is coarse or wrong. Reconstruct such parts one by one (--crop)."
    ]


def _parts_apart(points: Float, *, gap_share: float = 1 / 32, gap_spacings: float = 2.0) -> Int:
    """Return the number of each point's part, of shape (N,).

    Gaps between parts exceed this share of the diagonal, and these distances of nearest points, of which 95 % are less.
    """
    if len(points) < 2 or not np.ptp(points, axis=0).any():
        return np.zeros(len(points), dtype=np.int64)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    spacing = float(np.quantile(cKDTree(points).query(points, 2)[0][:, 1], 0.95))
    # Points of neighbouring voxels are at most two diagonals of a voxel apart.
    edge = max(gap_share * size / np.sqrt(12), gap_spacings * spacing)
    voxels, of_point = np.unique(((points - points.min(axis=0)) // edge).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(voxels).query_pairs(1.75, output_type="ndarray")
    ones = np.ones(len(pairs), dtype=bool)
    graph = coo_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(len(voxels), len(voxels)))
    return np.asarray(connected_components(graph, directed=False)[1][of_point.reshape(-1)], dtype=np.int64)

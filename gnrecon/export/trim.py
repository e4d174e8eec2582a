"""Trims a surface where no data supports it, and clips one to a box; both leave it open there.

Vertices farther than a reach D from every scanned point are cut away, and faces that the border crosses are cut along
the line where the distance, interpolated linearly along edges, is D. The distance is smoothed over the surface first,
over a third of D, because a line at a distance from single points is ragged. A crossing stays a tenth of its edge away
from both ends, so that no face becomes a sliver. Two kinds of small changes are not made: a hole of less than D^2 is
not cut, because the points around it support it well enough; and a leftover piece of less than 4 pi D^2, a disc of
radius 2 D, is removed too: it surrounds a few outliers.

A reach that spans the gaps between points also leaves a hem of that width around the data, which no point supports and
which may hang down or curl under. With an overhang E below D, the border is moved back from the first cut by D - E, but
not where a point is nearer than E: a morphological closing of the data by D, dilated by E.

A closed, oriented 2-manifold cut in this way is an oriented 2-manifold with borders: every vertex that stays keeps all
its faces, and every new one lies on an edge between two. The entries are `trim`, `clip_to_box` and `unsupported_area`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gnrecon.export.attributes import distances_between_points
from gnrecon.export.export_parameters import ExportParameters, TrimParameters
from gnrecon.geometry.arrays import Float, Int, Mask
from gnrecon.geometry.curvature import diffuse, vertex_areas
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import UsageError


@dataclass(frozen=True)
class Trimming:
    """What was cut off.

    Parameters
    ----------
    distance, overhang : float
        The reach, and how far the border is from the outermost points, in file units.
    area_share : float
        Share of the whole surface that was cut off.
    crumbs, filled : int
        Small leftover pieces that were removed; small holes that were not cut.
    """

    distance: float
    overhang: float
    area_share: float
    crumbs: int
    filled: int

    def as_dict(self) -> dict[str, float | int]:
        """All of it by name, ready for JSON."""
        return asdict(self)

    def describe(self, sheet: bool = False) -> list[str]:
        """Sentences for the user; `sheet` says whether it was done because the scan is a single sheet."""
        why = "The scan is a single sheet, so the mesh is left open at its border; --no-open closes it."
        return [why] * sheet + self._what()

    def _what(self) -> list[str]:
        if not self.area_share:
            return [f"Nothing was cut off: all of the surface lies within {self.distance:.6g} of a point."]
        crumbs = f", with {self.crumbs} small leftover pieces" if self.crumbs else ""
        filled = f" {self.filled} small gaps were left closed." if self.filled else ""
        hem = f", and what hangs over by more than {self.overhang:.6g}" if self.overhang < self.distance else ""
        return [
            f"Cut off {self.area_share:.1%} of the surface: the parts farther than {self.distance:.6g} from every "
            f"point that faces the same way{hem}{crumbs}.{filled}",
            "The mesh is open: an oriented edge-manifold with borders, not a solid.",
        ]


def trim(
    mesh: Mesh,
    distances: Float,
    reach: float,
    *,
    overhang: float | None = None,
    parameters: TrimParameters | None = None,
) -> tuple[Mesh, Trimming]:
    """Cut off what is farther than `reach` from data; return the same mesh where nothing is.

    Parameters
    ----------
    mesh : Mesh
        An oriented 2-manifold; normals and attributes are interpolated at the cut.
    distances : array of shape (V,)
        From each vertex to the nearest scanned point, in file units.
    reach : float
        Positive, in file units.
    overhang : float, optional
        How far the border may be from the outermost points, in file units; by default the reach.
    parameters : TrimParameters, optional
        By default ``TrimParameters()``.

    Raises
    ------
    UsageError
        When nothing would be left.
    """
    parameters = parameters or ExportParameters.trim
    level = reach if overhang is None else min(overhang, reach)
    smooth = diffuse(mesh, distances, parameters.smoothing_reaches * reach)
    near, filled, crumbs = _supported(mesh, smooth <= reach, reach, parameters)
    if level < reach and near.any() and not near.all():
        beyond = _beyond_data(mesh, near, distances, reach)
        smooth = diffuse(mesh, beyond, parameters.overhang_smoothing_reaches * reach)
        near, more_filled, more_crumbs = _supported(mesh, near & (smooth <= level), level, parameters)
        filled, crumbs = filled + more_filled, crumbs + more_crumbs
    if not near.any():
        raise UsageError(
            f"Trimming at {reach:.6g} leaves nothing: every point is at least {distances.min():.6g} away. "
            f"Choose a larger distance."
        )
    if near.all():
        return mesh, Trimming(reach, level, 0.0, 0, filled)
    result = cut_at_level(mesh, near, smooth, level, clearance=parameters.edge_clearance)
    return result, Trimming(reach, level, 1 - result.area / mesh.area, crumbs, filled)


def _supported(mesh: Mesh, near: Mask, reach: float, parameters: TrimParameters) -> tuple[Mask, int, int]:
    """The near vertices without small holes and pieces, and the numbers of both."""
    areas = vertex_areas(mesh)
    least_hole, least_piece = (
        share * reach**2 for share in (parameters.hole_squared_reaches, parameters.crumb_squared_reaches)
    )
    # Small holes first: a piece counts as small only with its own holes filled.
    near, filled = _absorb_small_patches(mesh, near, areas, least_hole, of=False)
    near, crumbs = _absorb_small_patches(mesh, near, areas, least_piece, of=True)
    return near, filled, crumbs


def _beyond_data(mesh: Mesh, near: Mask, distances: Float, reach: float) -> Float:
    """How far each vertex is beyond the outermost points, of shape (V,), by its distance from where support ends.

    It is at most the reach, at least minus that, and no more than the distance from the nearest point.
    """
    from scipy.spatial import cKDTree

    ends = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    border = mesh.vertices[ends[near[ends[:, 0]] != near[ends[:, 1]]]].mean(axis=1)
    inside = cKDTree(border).query(mesh.vertices[near])[0]
    beyond = np.full(len(near), reach)
    beyond[near] = np.maximum(np.minimum(distances[near], reach - inside), -reach)
    return beyond


def same_side_distances(
    mesh: Mesh,
    distances: Float,
    points: Float,
    normals: Float,
    reach: float,
    *,
    one_sided: bool = False,
    neighbours: int = 16,
    least_cosine: float = 0.25,
    far_reaches: float = 2.0,
    batch: int = 200_000,
) -> Float:
    """Return distances to data that count only points that face the same way as the surface, of shape (V,).

    A closed mesh of an open sheet has an underside, which may be as near to the points as the sheet itself. Its normals
    are opposite to theirs, and those of the rim between are at right angles.

    Parameters
    ----------
    mesh : Mesh
        With V vertices.
    distances : array of shape (V,)
        From each vertex to the nearest scanned point, in file units.
    points, normals : arrays of shape (N, 3)
        Scanned points, in file units, and their outward unit normals.
    reach : float
        Distance at which support ends, in file units.
    one_sided : bool
        Whether the data is a sheet, see `distances_between_points`.
    neighbours : int
        Nearest points among which one has to face the same way; enough to find the face beyond an edge.
    least_cosine : float
        Of the angle between normals that face the same way, about 75 degrees: more than noise and edges need.
    far_reaches : float
        Distance that is returned for vertices without such a point.
    batch : int
        Vertices handled at a time, which bounds memory.
    """
    from scipy.spatial import cKDTree

    middle = points.mean(axis=0)
    tree, directions = cKDTree(points - middle), mesh.vertex_normals()
    result = distances.copy()
    near = np.flatnonzero(distances <= reach)
    ranks = list(range(1, min(neighbours, len(points)) + 1))
    for rows in np.array_split(near, -(-max(len(near), 1) // batch)):
        found = tree.query(mesh.vertices[rows] - middle, ranks)[1]
        cosines = np.einsum("gki,gi->gk", normals[found], directions[rows])
        alone = rows[(cosines < least_cosine).all(axis=1)]
        result[alone] = np.maximum(result[alone], far_reaches * reach)
    return distances_between_points(mesh, result, points, normals, reach) if one_sided else result


def _absorb_small_patches(mesh: Mesh, near: Mask, areas: Float, least: float, of: bool) -> tuple[Mask, int]:
    """Move vertex patches below an area from the side `of` to the other; whole components and the largest stay."""
    start, end = mesh.faces.reshape(-1), np.roll(mesh.faces, -1, axis=1).reshape(-1)
    same = near[start] == near[end]
    size = len(near)
    # Patches are the components of the graph of edges that do not cross the border.
    links = coo_array((np.ones(same.sum(), dtype=np.int8), (start[same], end[same])), shape=(size, size))
    count, labels = connected_components(links, directed=False)
    area = np.bincount(labels, areas, minlength=count)
    bordered = np.zeros(count, dtype=bool)
    bordered[labels[start[~same]]] = True
    bordered[labels[end[~same]]] = True
    side = np.zeros(count, dtype=bool)
    side[labels] = near == of
    small = side & bordered & (area < least)
    # Something must be left: if every piece is small, the largest stays.
    if of and not (side & ~small).any() and small.any():
        small[np.flatnonzero(small)[area[small].argmax()]] = False
    return np.where(small[labels], not of, near), int(small.sum())


def cut_at_level(
    mesh: Mesh,
    near: Mask,
    distances: Float,
    reach: float,
    *,
    clearance: float = ExportParameters.trim.edge_clearance,
) -> Mesh:
    """The part of a mesh around its near vertices, ending where the distance is the reach.

    Crossings stay a share `clearance` of their edge away from its ends.
    """
    flags = near[mesh.faces]
    count = flags.sum(axis=1)
    # The one corner that differs from the two others comes first.
    single = np.flatnonzero((count == 1) | (count == 2))
    alone = np.where(count[single] == 1, flags[single].argmax(axis=1), flags[single].argmin(axis=1))
    a, b, c = np.take_along_axis(mesh.faces[single], (alone[:, None] + np.arange(3)) % 3, axis=1).T
    # Each crossed edge gets one new vertex, which its two faces share.
    ends, which = np.unique(np.sort(np.stack([a, b, a, c], axis=1).reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    low, high = ends.T
    share = np.clip((reach - distances[low]) / (distances[high] - distances[low]), clearance, 1 - clearance)
    full = _with_edge_points(mesh, low, high, share)
    ab, ac = (len(near) + which.reshape(-1, 2)).T
    tip = count[single] == 1
    corners = full.vertices
    # The quadrilateral that is left of a face with one far corner is cut along its shorter diagonal.
    shorter = np.linalg.norm(corners[ab] - corners[c], axis=1) < np.linalg.norm(corners[b] - corners[ac], axis=1)
    one, other = ~tip & shorter, ~tip & ~shorter
    pieces = [
        mesh.faces[count == 3],
        np.stack([a, ab, ac], axis=1)[tip],
        np.stack([ab, b, c], axis=1)[one],
        np.stack([ab, c, ac], axis=1)[one],
        np.stack([ab, b, ac], axis=1)[other],
        np.stack([b, c, ac], axis=1)[other],
    ]
    return extract_faces(full, np.concatenate(pieces))


def _with_edge_points(mesh: Mesh, low: Int, high: Int, share: Float) -> Mesh:
    """The mesh with further vertices, each at a share of the way between two."""
    vertices = _interpolated_rows(mesh.vertices, low, high, share)
    normals = None
    if mesh.normals is not None:
        normals = _interpolated_rows(mesh.normals, low, high, share)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    attributes = {name: _interpolated_rows(values, low, high, share) for name, values in mesh.attributes.items()}
    return Mesh(vertices, mesh.faces, normals, attributes)


def _interpolated_rows(values: npt.NDArray[Any], low: Int, high: Int, share: Float) -> npt.NDArray[Any]:
    """The values followed by those between two rows: interpolated numbers, and the nearer row of what is no number."""
    if values.dtype.kind == "f":
        weight = share.reshape(-1, *[1] * (values.ndim - 1))
        mixed = (1 - weight) * values[low] + weight * values[high]
    else:
        mixed = values[np.where(share < 0.5, low, high)]
    return np.concatenate([values, mixed.astype(values.dtype)])


def extract_faces(mesh: Mesh, faces: Int) -> Mesh:
    """The given faces with the vertices that they use."""
    used, corners = np.unique(faces, return_inverse=True)
    normals = None if mesh.normals is None else mesh.normals[used]
    attributes = {name: values[used] for name, values in mesh.attributes.items()}
    return Mesh(mesh.vertices[used], corners.reshape(-1, 3), normals, attributes)


def clip_to_box(mesh: Mesh, bounds: Float, *, tolerance_diagonals: float = 1e-9) -> Mesh:
    """Return the part of an oriented 2-manifold within a box; it has no faces where nothing is inside.

    Faces that cross a side are cut along it, by linear interpolation along their edges, as in `trim`. Where the sides
    are planes of the lattice that the mesh was extracted on, no face crosses them and the border lies in them exactly.

    Parameters
    ----------
    mesh : Mesh
        Normals and attributes are interpolated at the cut.
    bounds : array of shape (2, 3)
        Lower and upper corner.
    tolerance_diagonals : float, diagonals of the box
        Distance at which a vertex counts as on a side: above rounding only.
    """
    tolerance = tolerance_diagonals * float(np.linalg.norm(bounds[1] - bounds[0]))
    for axis in range(3):
        for side, sign in ((0, -1.0), (1, 1.0)):
            beyond = sign * (mesh.vertices[:, axis] - bounds[side, axis])
            # A face beyond that only touches the side is dropped, though its corners on the side count as near.
            mesh = extract_faces(mesh, mesh.faces[(beyond[mesh.faces] < -tolerance).any(axis=1)])
            beyond = sign * (mesh.vertices[:, axis] - bounds[side, axis])
            near = beyond <= tolerance
            if not near.all():
                mesh = cut_at_level(mesh, near, beyond, 0.0)
    return mesh


@dataclass(frozen=True)
class UnsupportedArea:
    """The part of a closed surface that no data supports: where a scan has holes or ends.

    Parameters
    ----------
    invented_area_share : float from 0 to 1
    invented_beyond : float, file units
        Distance from the nearest point beyond which surface counts as unsupported.
    """

    invented_area_share: float
    invented_beyond: float

    def as_dict(self) -> dict[str, float]:
        """Both by name, ready for JSON."""
        return asdict(self)

    def describe(self, *, notable_share: float = 0.03) -> list[str]:
        """A sentence for the user from a notable share of the surface on."""
        if self.invented_area_share < notable_share:
            return []
        return [
            f"{self.invented_area_share:.1%} of the surface is invented: it is farther than {self.invented_beyond:.6g} "
            f"(three point spacings) from every point. Use --trim 3s to cut it off."
        ]


def unsupported_area(mesh: Mesh, distances: Float, spacing: float, *, reach_spacings: float = 3.0) -> UnsupportedArea:
    """Return which share of a surface no data supports.

    Parameters
    ----------
    mesh : Mesh
    distances : array of shape (V,)
        From each vertex to the nearest scanned point, in file units.
    spacing : float
        Of the points, in file units.
    reach_spacings : float
        Distance from the nearest point beyond which surface counts. Of points spread at random over a surface, less
        than one part in 10^12 of it is three spacings away from all of them.
    """
    beyond = reach_spacings * spacing
    areas = np.linalg.norm(mesh.face_vectors, axis=1)
    far = distances[mesh.faces].mean(axis=1) > beyond
    return UnsupportedArea(float(areas[far].sum() / max(areas.sum(), np.finfo(np.float64).tiny)), beyond)

"""`Contents`, what a reader returns: the points and all else that a file stores, before it becomes a cloud or a mesh.

Also holds what many readers need: sorting named columns, concatenating and moving scans, and cutting polygons into
triangles. Whatever does not fit together ends in an `InputError`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Values
from gnrecon.geometry.colors import as_bytes
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io.column_names import COLOR, NORMAL, columns_of_role, require_position
from gnrecon.runtime.errors import InputError
from gnrecon.runtime.plugins import describe_error, guarded

Columns = Mapping[str, Values]


def no_faces() -> Int:
    """Return an empty face array, of shape (0, 3)."""
    return np.empty((0, 3), dtype=np.int64)


@dataclass(frozen=True)
class Contents:
    """Arrays of one file, in the file's order.

    Parameters
    ----------
    points : array of shape (N, 3), file units
    normals : array of shape (N, 3), optional, as stored
    faces : integer array of shape (F, 3); empty for a cloud
    attributes : mapping of name to array of N rows
    unread : descriptions of what else the file holds, such as ``"texture coordinates"``
    origins : array of shape (N, 3), optional, the scanner position for each point; NaN where it is unknown
    remarks : sentences about how the file was read, where it could be read in several ways
    """

    points: Float
    normals: Float | None = None
    faces: Int = field(default_factory=no_faces)
    attributes: Columns = field(default_factory=dict)
    unread: tuple[str, ...] = ()
    origins: Float | None = None
    remarks: tuple[str, ...] = ()

    def shape(self) -> Mesh | PointCloud:
        """Return a mesh, with colours in 8 bits, where there are faces; else a cloud."""
        if not len(self.faces):
            return self.cloud()
        colors = {name: as_bytes(values) for name, values in self.attributes.items() if name == "colors"}
        return Mesh(self.points, self.faces, self.normals, {**self.attributes, **colors})

    def cloud(self) -> PointCloud:
        """Return the points; see `without_faces` for the normals of a mesh."""
        found = without_faces(self)
        return PointCloud(found.points, found.normals, dict(found.attributes), found.origins)

    def moved(self, rotation: Float, translation: Float, origin: Float | None = None) -> Contents:
        """Return the points, rows x, as ``rotation x + translation``, with the position of the scanner, of shape (3,).

        ``rotation`` has shape (3, 3) and turns normals, too; ``translation`` has shape (3,).
        """
        points = self.points @ rotation.T + translation
        normals = None if self.normals is None else self.normals @ rotation.T
        seen_from = self.origins if origin is None else np.broadcast_to(origin, points.shape)
        return replace(self, points=points, normals=normals, origins=seen_from)


def from_columns(columns: Columns, faces: Int | None = None, points: Values | None = None) -> Contents:
    """Sort named columns, of shape (N,) or (N, C), into positions, normals, ``colors`` and other attributes.

    Columns of shape (N, 3) named ``normals`` are normals, and those of three or four named ``colors``, ``rgb`` or the
    like are colours; see `gnrecon.io.column_names` for the names that single ones may have. ``faces``, of shape (F, 3),
    are none by default, and ``points``, of shape (N, 3), the columns x, y and z.
    """
    rest = dict(columns)
    if points is None:
        points = np.column_stack([rest.pop(name).astype(np.float64) for name in require_position(rest)])
    for name, values in rest.items():
        if len(values) != len(points):
            raise InputError(f"{name!r} has {len(values)} values, but there are {len(points)} points.")
    normal = _taken(rest, ("normals", "normal", "point_normals", "norm"), NORMAL, (3,))
    names = (*COLOR, "alpha") if columns_of_role(rest, (*COLOR, "alpha")) else COLOR
    color = _taken(rest, ("colors", "colours", "rgb", "rgba"), names, (3, 4))
    normals, unread = (None, ()) if normal is None else decoded_normals(normal)
    rest |= {} if color is None else {"colors": color}
    return Contents(points.astype(np.float64), normals, no_faces() if faces is None else faces, rest, unread)


def _taken(
    rest: dict[str, Values], titles: tuple[str, ...], role: tuple[str, ...], widths: Sequence[int]
) -> Values | None:
    """Remove the array of one of these titles, or the single columns of a role, from the rest, and return it."""
    for name, values in rest.items():
        if name.lower() in titles and values.ndim == 2 and values.shape[1] in widths:
            return rest.pop(name)
    single = {name: values for name, values in rest.items() if values.ndim == 1}
    names = columns_of_role(single, role)
    return np.column_stack([rest.pop(name) for name in names]) if names else None


def decoded_normals(
    stored: Values, *, least_share: float = 0.9, tolerance: float = 0.05
) -> tuple[Float | None, tuple[str, ...]]:
    """Return normals, of shape (N, 3), as float64, and what could not be read of them.

    Integers of 8 or 16 bits hold shares of the largest one: signed, or with the middle of the range for zero. So do
    whole numbers in text. The encoding is that in which at least a share of the non-zero rows has unit length, within
    a tolerance, as bytes round to one hundredth; normals that have it in none are kept where they are signed, because
    their directions are right.
    """
    values = stored.astype(np.float64)
    whole = stored.dtype.kind in "iu" or bool(np.isfinite(values).all() and (values == np.rint(values)).all())
    rows = values[(values != 0).any(axis=1)] if whole else values[:0]
    if not len(rows):
        return values, ()
    signed = bool((rows < 0).any()) or stored.dtype.kind == "i"
    sizes = (1, 2) if stored.dtype.kind == "f" else (stored.dtype.itemsize,)
    scales = [(1.0, 0.0)]
    for top in ((256**size - 1) >> signed for size in sizes):
        # Zero is the middle of the range, or the whole number above it.
        scales += [(top, 0.0)] if signed else [(top / 2, 1.0), ((top - 1) / 2, (top + 1) / (top - 1))]
    for scale, middle in scales:
        lengths = np.linalg.norm(rows / scale - middle, axis=1)
        if (np.abs(lengths - 1) < tolerance).mean() >= least_share:
            return (values / scale - middle if scale > 1 else values), ()
    if signed:
        return values, ()
    return None, (f"normals, which are {stored.dtype} and not of unit length in any usual encoding",)


def concatenated(pieces: Sequence[Contents]) -> Contents:
    """Return the contents of all pieces, in their order, as one.

    Normals and attributes are kept where all pieces have them in the same shape; `Contents.unread` names the others.
    Scan origins that only some pieces have are NaN for the rest.
    """
    if len(pieces) < 2:
        return pieces[0] if pieces else Contents(np.empty((0, 3)))
    starts = np.cumsum([0, *(len(piece.points) for piece in pieces[:-1])])
    normals = [piece.normals for piece in pieces if piece.normals is not None]
    found: dict[str, list[Values]] = {}
    for name, values in (item for piece in pieces for item in piece.attributes.items()):
        found.setdefault(name, []).append(values)
    # Dropped rather than filled up, because later stages cannot tell made-up values from measured ones.
    kinds = {name: {one.shape[1:] for one in values} for name, values in found.items()}
    lost = [name for name, values in found.items() if len(values) < len(pieces) or len(kinds[name]) > 1]
    lost += ["normals"] if 0 < len(normals) < len(pieces) else []
    rest = [f"{name} of some of the scans" for name in lost]
    unknown = [np.full((len(piece.points), 3), np.nan) if piece.origins is None else piece.origins for piece in pieces]
    return Contents(
        np.concatenate([piece.points for piece in pieces]),
        np.concatenate(normals) if len(normals) == len(pieces) else None,
        np.concatenate([piece.faces + start for piece, start in zip(pieces, starts, strict=True)]),
        {name: np.concatenate(values) for name, values in found.items() if name not in lost},
        tuple(dict.fromkeys([*(words for piece in pieces for words in piece.unread), *rest])),
        None if all(piece.origins is None for piece in pieces) else np.concatenate(unknown),
        tuple(dict.fromkeys(sentence for piece in pieces for sentence in piece.remarks)),
    )


def without_opaque_alpha(attributes: Columns) -> Columns:
    """Return attributes whose ``colors``, bytes of shape (N, 4), have no alpha where all are opaque."""
    colors = attributes.get("colors")
    opaque = colors is not None and (as_bytes(colors)[:, 3:] == 255).all()
    return {**attributes, "colors": colors[:, :3]} if colors is not None and opaque else attributes


def without_faces(contents: Contents, *, least_share: float = 0.5) -> Contents:
    """Return contents without faces; where they have no normals, and at least a share of the points is a corner of a
    face, with the area-weighted normals of the faces.
    """
    normals, faces = contents.normals, contents.faces
    if normals is None and len(faces) and len(np.unique(faces)) >= least_share * len(contents.points):
        normals = Mesh(contents.points, faces).vertex_normals()
    return replace(contents, normals=normals, faces=no_faces())


def fan_triangles(counts: Int, corners: Int, strips: bool = False) -> Int:
    """Return the triangles, of shape (F, 3), of polygons that are each cut into a fan, or of triangle strips.

    A polygon v0 v1 ... v(n-1) becomes the n - 2 triangles v0 v(k+1) v(k+2); fewer than three corners give none.
    ``counts``, of shape (P,), are the numbers of corners, and ``corners`` the vertex indices of all polygons.
    """
    triangles = np.maximum(counts - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), triangles)
    first = (np.cumsum(counts) - counts)[polygon]
    k = np.arange(len(polygon)) - (np.cumsum(triangles) - triangles)[polygon]
    # Every other triangle of a strip has the opposite orientation.
    a, b = (k + k % 2, k + 1 - k % 2) if strips else (0, k + 1)
    return np.column_stack([corners[first + a], corners[first + b], corners[first + k + 2]])


def polygon_remarks(counts: Int) -> tuple[str, ...]:
    """Return sentences on what `fan_triangles` changes in polygons of so many corners, an array of shape (P,)."""
    larger, smaller = int((counts > 3).sum()), int((counts < 3).sum())
    cut = (f"{larger} polygons of more than three corners as such (they are cut into triangles)",) if larger else ()
    return (*cut, *((f"{smaller} polygons of less than three corners",) if smaller else ()))


def guard_parser(kind: str) -> AbstractContextManager[None]:
    """Turn any exception of a library that parses a file of a kind, such as ``"LAS"``, into an `InputError`."""
    return guarded(InputError, lambda error: f"the file is not a well-formed {kind} file ({describe_error(error)}).")

"""Triangle meshes as plain arrays, with areas, volume and vertex normals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gnrecon.geometry.arrays import Float, Int, Values
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.errors import InputError


@dataclass(frozen=True)
class Mesh:
    """Triangles over shared vertices; counter-clockwise seen from outside.

    Parameters
    ----------
    vertices : array of shape (V, 3)
        Positions, in file units unless stated otherwise.
    faces : integer array of shape (F, 3)
        Rows of vertex indices.
    normals : array of shape (V, 3), optional
        Unit vertex normals, outward.
    attributes : mapping of name to array of shape (V,) or (V, C)
        Per-vertex attributes: ``colors`` (8-bit, 3 or 4 columns) and scalar fields.

    Raises
    ------
    InputError
        When array shapes do not match, or a face refers to a vertex that does not exist.
    """

    vertices: Float
    faces: Int
    normals: Float | None = None
    attributes: Mapping[str, Values] = field(default_factory=dict)

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.ascontiguousarray(self.faces, dtype=np.int64).reshape(-1, 3)
        if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise InputError(f"A face names a vertex outside of 0 to {len(vertices) - 1}.")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        if self.normals is not None:
            normals = np.ascontiguousarray(self.normals, dtype=np.float64)
            if normals.shape != vertices.shape:
                raise InputError(f"Normals of shape {normals.shape} do not fit {len(vertices)} vertices.")
            object.__setattr__(self, "normals", normals)
        for name, values in self.attributes.items():
            if len(values) != len(vertices):
                raise InputError(f"{len(values)} values of {name!r} do not fit {len(vertices)} vertices.")

    def __repr__(self) -> str:
        held = "".join(f", {name}" for name in self.attributes)
        return f"<Mesh: {len(self.vertices):,} vertices, {len(self.faces):,} faces{held}>"

    @property
    def corners(self) -> Float:
        """Corner positions of every face, of shape (F, 3, 3)."""
        return self.vertices[self.faces]

    @property
    def face_vectors(self) -> Float:
        """Area vectors of the faces, of shape (F, 3): along the normal, with the area as length."""
        vectors = np.empty((len(self.faces), 3))
        for rows in slices(len(self.faces)):
            vectors[rows] = area_vectors(self.vertices, self.faces[rows])
        return vectors

    @property
    def area(self) -> float:
        """Surface area, in squared units of the vertices."""
        return float(np.linalg.norm(self.face_vectors, axis=1).sum())

    @property
    def volume(self) -> float:
        """Signed enclosed volume by the divergence theorem; positive when the faces look outward."""
        if not len(self.faces):
            return 0.0
        total = 0.0
        for rows in slices(len(self.faces)):
            # Relative to a vertex of the mesh, because coordinates far from the origin would cancel badly.
            a, b, c = np.moveaxis(self.vertices[self.faces[rows]] - self.vertices[0], 1, 0)
            total += float(np.einsum("ij,ij->", a, np.cross(b, c)))
        return total / 6.0

    @property
    def euler_characteristic(self) -> int:
        """V - E + F, counting only vertices that belong to a face."""
        edges = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        return len(np.unique(self.faces)) - len(np.unique(edges, axis=0)) + len(self.faces)

    def vertex_normals(self) -> Float:
        """Unit vertex normals, of shape (V, 3): the stored ones, or else area-weighted means of face normals."""
        if self.normals is not None:
            return self.normals
        return self._directions([self.face_vectors] * 3)

    def smooth_normals(self, *, folded_degrees: float = 45.0) -> Float:
        """Unit normals of the smooth surface through the vertices, of shape (V, 3): the stored ones, or from the faces.

        A corner between edges a and b of its face adds a x b / (|a|^2 |b|^2). On a sphere this is exact for faces of
        any shape, where area weights are off by degrees. Source: Max, *Weights for Computing Vertex Normals from Facet
        Normals* (1999). Short edges amplify noise, so the area-weighted normal is used where the two differ widely.

        Parameters
        ----------
        folded_degrees : angle between the two normals from which the area-weighted one is used; only folded faces
            bring smooth surfaces that far apart
        """
        by_area = self.vertex_normals()
        if self.normals is not None:
            return by_area
        corners = self.corners
        squares = np.square(np.roll(corners, -1, axis=1) - corners).sum(axis=2)
        both = squares * np.roll(squares, 1, axis=1)  # edges after and before each corner
        both = np.maximum(both, np.finfo(np.float64).tiny)
        vectors = self.face_vectors
        normals = self._directions([vectors / both[:, corner, None] for corner in range(3)])
        folded = np.einsum("ij,ij->i", normals, by_area) < math.cos(math.radians(folded_degrees))
        return np.where(folded[:, None], by_area, normals)

    def _directions(self, additions: Sequence[Float]) -> Float:
        """Return unit sums at the vertices of the vectors, (F, 3) each, of first, second and third corners of faces."""
        sums = np.zeros_like(self.vertices)
        # Damaged files hold vertices of any size: a face whose products overflow, or are lost, has no direction.
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            for corner, added in enumerate(additions):
                finite = np.isfinite(added).all(axis=1, keepdims=True)
                np.add.at(sums, self.faces[:, corner], np.where(finite, added, 0.0))
            lengths = np.linalg.norm(sums, axis=1, keepdims=True)
            sums /= np.maximum(lengths, np.finfo(np.float64).tiny)
        return np.where(np.isfinite(lengths), sums, 0.0)

    def with_vertices(self, vertices: Float) -> Mesh:
        """Return the same faces, normals and attributes over moved vertices, of shape (V, 3)."""
        return replace(self, vertices=vertices)

    def with_attributes(self, attributes: Mapping[str, Values]) -> Mesh:
        """Return the same mesh with these attributes, of V rows each, added to its own."""
        return replace(self, attributes={**self.attributes, **attributes})


def area_vectors(vertices: Float, faces: Int) -> Float:
    """Area vectors, of shape (F, 3), of faces of shape (F, 3): along the normal, with the area as length."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    # Vertices of damaged files may be of any size; their area vectors are then not finite.
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        vectors: Float = 0.5 * np.cross(b - a, c - a)
    return vectors

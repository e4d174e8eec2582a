"""The distance to a mesh as a field, so that surfaces at a distance from it can be extracted.

A fitted field is a distance near its surface only; farther off its slope is not one, and it may have further sheets.
Offsets are therefore measured from the finished mesh: the distance to its nearest point, with the sign by ray casting.
Convex edges are rounded at a positive level. The entry is `OffsetField`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from gnrecon.export.boolean import centre_and_size
from gnrecon.export.metrics import SurfaceQuery
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import Frame
from gnrecon.runtime.errors import UsageError


@dataclass(frozen=True)
class OffsetField:
    """The signed distance to a closed mesh, less a level: its zero level lies that far outside (or inside) the mesh.

    Parameters
    ----------
    mesh : Mesh
        Closed and oriented outward, in file units.
    level : float, file units
        Positive outside.
    frame : Frame
        In whose unit coordinates the field is sampled.
    bounds : array of shape (2, 3), file units
        The box to be meshed.
    least_level : float, halves of the mesh's longest side
        Smallest magnitude of the level: nearer to the surface, ray casting in float32 confuses its two sides.

    Raises
    ------
    UsageError
        When the level is too small.
    """

    mesh: Mesh
    level: float
    frame: Frame
    bounds: Float
    least_level: float = 1e-5

    def __post_init__(self) -> None:
        least = self.least_level * centre_and_size(self.mesh)[1]
        if not abs(self.level) >= least:
            raise UsageError(
                f"An offset of {self.level:g} is too small for this shape. Use at least {least:.2g} units."
            )

    @cached_property
    def _surface(self) -> SurfaceQuery:
        return SurfaceQuery(self.mesh)

    def single(self) -> OffsetField:
        """Return this field, which is fast as it is."""
        return self

    def distance(self, points: Float) -> Float:
        """Return the signed distance to the mesh, in file units and of shape (N,), at points of shape (N, 3)."""
        lengths = np.linalg.norm(points - self._surface.nearest(points)[0], axis=1)
        # Ray casting decides the sign, since the nearest face's normal is ambiguous at edges.
        signed: Float = np.where(self._surface.inside(points), -lengths, lengths)
        return signed

    def sdf(self, points: Float) -> Float:
        """Return the distance less the level, in file units and of shape (N,), at points of shape (N, 3)."""
        return self.distance(points) - self.level

    def gradient(self, points: Float) -> Float:
        """Return the distance's gradient, of shape (N, 3), at points of shape (N, 3); the face's normal on the mesh."""
        feet, faces = self._surface.nearest(points)
        ways = np.where(self._surface.inside(points)[:, None], feet - points, points - feet)
        lengths = np.linalg.norm(ways, axis=1, keepdims=True)
        vectors = self.mesh.face_vectors[faces]
        areas = np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(np.float64).tiny)
        # On the mesh the way has no direction; the face's normal takes its place.
        gradient: Float = np.divide(ways, lengths, out=vectors / areas, where=lengths > 0)
        return gradient

"""The distance to a mesh as a field, so that surfaces at a distance from it can be extracted.

A fitted field is a distance near its surface only; farther off its slope is not one, and it may have sheets of its own.
Offsets are therefore measured afresh, from the finished mesh: the length of the way to its nearest point, and the sign
by ray casting. Outward corners of the surface at a positive level are round, as points at one distance are.
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

LEAST_LEVEL = 1e-5
"""Of half the mesh's longest side: nearer to the surface, its two sides are not told apart reliably."""


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

    Raises
    ------
    UsageError
        When the level is too small to be told from the surface itself.
    """

    mesh: Mesh
    level: float
    frame: Frame
    bounds: Float

    def __post_init__(self) -> None:
        least = LEAST_LEVEL * centre_and_size(self.mesh)[1]
        if not abs(self.level) >= least:
            raise UsageError(
                f"An offset of {self.level:g} is too small for this shape; the least is {least:.2g} units."
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
        gradient: Float = np.divide(ways, lengths, out=vectors / areas, where=lengths > 0)
        return gradient

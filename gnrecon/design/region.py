"""The design region: the solid inside of a closed mesh, its signed distance, and points around it."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from gnrecon.export.metrics import Surface, sample_surface
from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.signed_distance import Box

_NEAR_SHARE, _NEAR_SPREAD = 0.5, 0.03


class DesignRegion:
    """The inside of a closed mesh.

    Parameters
    ----------
    mesh : Mesh
        Closed, unit coordinates.
    margin : float
        How far the box of the problem reaches beyond the mesh on each side.
    """

    def __init__(self, mesh: Mesh, margin: float) -> None:
        self.mesh = mesh
        self.box = Box.around(mesh.vertices, margin)

    @cached_property
    def _surface(self) -> Surface:
        return Surface(self.mesh)

    def inside(self, points: Float) -> Mask:
        """Return which points, of shape (N, 3), lie in the region, of shape (N,)."""
        return self._surface.inside(points)

    def distance(self, points: Float) -> Float:
        """Return the signed distance, of shape (N,), from the region's border, negative inside of it."""
        lengths = np.linalg.norm(points - self._surface.nearest(points)[0], axis=1)
        signed: Float = np.where(self.inside(points), -lengths, lengths)
        return signed

    def around(self, count: int, rng: np.random.Generator) -> Float:
        """Return points of the box, of shape (count, 3), half of them uniform, half of them near the region's border.

        Most of what leaves a region does so by little, where uniform points are few.
        """
        near = sample_surface(self.mesh, round(_NEAR_SHARE * count), rng).points
        near = near + _NEAR_SPREAD * rng.standard_normal(near.shape)
        points = np.concatenate([self.box.sample(count - len(near), rng), near])
        within: Float = np.clip(points, self.box.lower, self.box.upper)
        return within

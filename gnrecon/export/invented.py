"""How much of a surface no data supports.

A closed surface must go on where a scan has holes or ends; what lies there was invented. Surface counts as invented
where it is farther from every scanned point than three times their spacing. On points thrown evenly at random onto a
surface, less than one part in 10^12 of it is as far as that from all of them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh

SPACINGS = 3.0
NOTABLE = 0.03
"""Share of the surface from which on a user is told."""


@dataclass(frozen=True)
class Invented:
    """The part of a surface that no data supports.

    Parameters
    ----------
    invented_area_share : float from 0 to 1
    invented_beyond : float, file units
        Distance from the nearest point from which on surface counts as invented.
    """

    invented_area_share: float
    invented_beyond: float

    def as_dict(self) -> dict[str, float]:
        """Both by name, ready for JSON."""
        return asdict(self)

    def describe(self) -> list[str]:
        """A sentence for the user where the share is notable."""
        if self.invented_area_share < NOTABLE:
            return []
        return [
            f"{self.invented_area_share:.1%} of the surface is invented: it lies farther than "
            f"{self.invented_beyond:.6g}, three times the points' spacing, from every point; --trim 3s cuts it off."
        ]


def invented(mesh: Mesh, distances: Float, spacing: float) -> Invented:
    """Return which share of a surface is invented.

    Parameters
    ----------
    mesh : Mesh
    distances : array of shape (V,)
        From each vertex to the nearest scanned point, in file units.
    spacing : float
        Of the points, in file units.
    """
    beyond = SPACINGS * spacing
    areas = np.linalg.norm(mesh.face_vectors, axis=1)
    far = distances[mesh.faces].mean(axis=1) > beyond
    return Invented(float(areas[far].sum() / max(areas.sum(), np.finfo(np.float64).tiny)), beyond)

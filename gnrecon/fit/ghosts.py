"""Where in free space a field has the wrong sign: what makes the ghost sheets and the horns of a mesh.

The sign is that of the winding number, which costs as much as several values of a field. But from place to place it
changes only through the data, or where a hole is closed: so the nearest sample of known sign nearly always tells it,
and the winding number is asked for only where the field contradicts that sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.signed_distance import CoarseDistance


@dataclass
class GhostSearch:
    """A search that remembers the signs which it has found.

    Parameters
    ----------
    coarse : CoarseDistance
    points : array of shape (K, 3), samples whose sign is known; there may be none
    signs : array of shape (K,)
    """

    coarse: CoarseDistance
    points: Float
    signs: Float

    def ghosts(self, x: Float, value: Callable[[Float], Float]) -> tuple[Float, Float]:
        """Return those of x where the value has the wrong sign, of shape (G, 3), and the coarse distances there.

        Parameters
        ----------
        x : array of shape (Q, 3); what is too near to the data for a coarse distance is left out
        value : gives the field's values, of shape (N,), at points, of shape (N, 3)
        """
        known, size, _ = self.coarse.size(x)
        x = x[known]
        own = value(x)
        doubtful = np.flatnonzero(own * self._nearest_signs(x) <= 0)
        x, own, size = x[doubtful], own[doubtful], size[doubtful]
        sign = self.coarse.sign(x)
        self.points, self.signs = np.concatenate([self.points, x]), np.concatenate([self.signs, sign])
        wrong = own * sign <= 0
        return x[wrong], (sign * size)[wrong]

    def _nearest_signs(self, x: Float) -> Float:
        """Return the signs of the nearest known samples, of shape (Q,), or zeros where none is known."""
        if not len(self.points):
            return np.zeros(len(x))
        signs: Float = self.signs[cKDTree(self.points).query(x)[1]]
        return signs

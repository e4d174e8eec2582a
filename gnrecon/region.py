"""The part of space whose points are wanted: within one of some boxes, and on the kept side of all clipping planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gnrecon.geometry.arrays import Float, Mask

Box = tuple[Sequence[float], Sequence[float]]


@dataclass(frozen=True)
class Region:
    """Boxes and half-spaces, in file units.

    Parameters
    ----------
    boxes : pairs of a lower and an upper corner; a point is wanted that lies in any of them, borders included, and
        where there are no boxes each is
    planes : rows of four numbers a, b, c, d; of the wanted ones stay those with a x + b y + c z + d >= 0 for all rows
    """

    boxes: tuple[Box, ...] = ()
    planes: tuple[Sequence[float], ...] = ()

    @property
    def everything(self) -> bool:
        """Whether nothing is cut away."""
        return not self.boxes and not self.planes

    def holds(self, points: Float) -> Mask:
        """Return the mask, of shape (N,), of wanted points; one that is not finite is not told to lie outside."""
        wanted = np.full(len(points), not self.boxes)
        for lower, upper in self.boxes:
            wanted |= ~((points < np.asarray(lower)) | (points > np.asarray(upper))).any(axis=1)
        for *normal, offset in self.planes:
            with np.errstate(invalid="ignore", over="ignore"):
                wanted &= ~(points @ np.asarray(normal) + offset < 0)
        return wanted | ~np.isfinite(points).all(axis=1)

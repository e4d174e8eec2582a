"""The typical distance between neighbouring points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]

_QUERIES = 20_000


def mean_spacing(points: Float) -> float:
    """Return the median distance to the nearest other point, in the unit of `points`, of shape (N, 3), N > 1.

    In large clouds it is taken over evenly chosen rows.
    """
    from scipy.spatial import cKDTree

    centred = points - points.mean(axis=0)
    stride = -(-len(points) // _QUERIES)
    return float(np.median(cKDTree(centred).query(centred[::stride], 2)[0][:, 1]))

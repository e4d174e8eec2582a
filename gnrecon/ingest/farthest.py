"""Farthest-point thinning: each further point is the one that lies farthest from all that were taken, by fpsample.

It is the greedy 2-approximation of the k-centre problem (Gonzalez 1985), and reaches into every corner of a cloud. The
library buckets the points in a tree, so that a step looks at a few of them only (Han et al., QuickFPS, 2023).
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float, Int

_SMALL, _LARGE = 3, 7
"""Heights of the tree that suit fewer than 10,000 points, and more."""


def farthest_points(points: Float, count: int, rng: np.random.Generator) -> Int:
    """Return `count` row indices, beginning with a random one.

    Parameters
    ----------
    points : array of shape (N, 3), centred, distinct, N >= count >= 1
    """
    import fpsample

    first = int(rng.integers(len(points)))
    # Scaled, because the library works in single precision.
    scaled = (points / np.abs(points).max()).astype(np.float32)
    height = min(_SMALL if len(points) < 10_000 else _LARGE, len(points).bit_length() - 1)
    chosen: Int = fpsample.bucket_fps_kdline_sampling(scaled, count, height, first).astype(np.intp)
    return chosen

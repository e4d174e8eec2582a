"""Statistics that a few outliers hardly move."""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float


def deviation(off: Float) -> float:
    """Return the standard deviation of what is off its middle, of shape (N,), by the median of its size.

    It is that of a normal distribution of as large a median.
    """
    return 1.4826 * float(np.median(np.abs(off)))

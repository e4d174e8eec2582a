"""Statistics that a few outliers hardly move."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def deviation(off: npt.NDArray[np.float64]) -> float:
    """Return the standard deviation of what is off its middle, of shape (N,), by the median of its size.

    It is that of a normal distribution of as large a median.
    """
    return 1.4826 * float(np.median(np.abs(off)))

"""Names for the kinds of arrays that annotations use; shapes and units stand in each docstring."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]
"""Coordinates, distances and other measured values."""

Int = npt.NDArray[np.integer]
"""Indices and counts, of any width: faces of shape (F, 3), rows of shape (N,), labels."""

Mask = npt.NDArray[np.bool_]
"""Which rows are meant, of shape (N,)."""

Values = npt.NDArray[np.generic]
"""Attributes of points or vertices, of shape (N,) or (N, K), of any type that a file may hold."""

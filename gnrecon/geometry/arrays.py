"""Aliases for array types in annotations; docstrings give shapes and units."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]
"""Coordinates, distances and other real values."""

Int = npt.NDArray[np.integer]
"""Indices and counts, of any width: faces of shape (F, 3), rows of shape (N,), labels."""

Mask = npt.NDArray[np.bool_]
"""A selection of rows, of shape (N,)."""

Values = npt.NDArray[np.generic]
"""Attributes of points or vertices, of shape (N,) or (N, K), of any type that a file can store."""

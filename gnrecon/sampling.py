"""Where a field is sampled: in the volume, near the surface; and a coarse signed distance to supervise it there.

The coarse distance is that to the nearest point; its sign is trusted to the generalised winding number
w(x) = sum_j a_j n_j . (p_j - x) / (4 pi |p_j - x|^3) of the cloud, with a_j the area that point j stands for: above one
half means inside. It closes holes and open scans the way a soap film would, where the nearest normals alone would call
all that lies behind a scan solid. Close to the data the sum is singular, so there the nearest normals vote.

Source of the sum over points: Barill et al., Fast Winding Numbers for Soups and Clouds (2018).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float64]

_SOURCES = 4000
_NEIGHBOURS = 8


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, unit coordinates."""

    lower: Float
    upper: Float

    @classmethod
    def around(cls, points: Float, margin: float) -> Box:
        """Return the bounding box of `points`, of shape (N, 3), widened by `margin` on each side."""
        return cls(points.min(axis=0) - margin, points.max(axis=0) + margin)

    def sample(self, count: int, rng: np.random.Generator) -> Float:
        """Return uniform points, of shape (count, 3)."""
        return rng.uniform(self.lower, self.upper, (count, 3))


def near_surface(points: Float, spread: float, count: int, rng: np.random.Generator) -> Float:
    """Return `count` points, of shape (count, 3): data points moved by normal noise of standard deviation `spread`."""
    return points[rng.integers(len(points), size=count)] + spread * rng.standard_normal((count, 3))


class CoarseDistance:
    """Distance to the nearest point of a cloud, signed by winding number and normals; negative inside.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3), unit coordinates, outward unit normals
    rng : draws the subset of at most 4,000 points that the winding number sums over
    """

    def __init__(self, points: Float, normals: Float, rng: np.random.Generator) -> None:
        from scipy.spatial import cKDTree

        self._tree = cKDTree(points)
        self._points, self._normals = points, normals
        self.spacing = float(np.median(self._tree.query(points, k=2)[0][:, 1]))
        chosen = np.sort(rng.permutation(len(points))[:_SOURCES])
        self._sources = points[chosen]
        k = min(_NEIGHBOURS, len(chosen) - 1)
        reach = cKDTree(self._sources).query(self._sources, k + 1)[0][:, -1]
        # The disk that reaches the k-th neighbour is shared by k points.
        self._dipoles = normals[chosen] * (reach**2 / (4 * k))[:, None]
        self._near = 2.0 * float(np.median(reach))

    def __call__(self, x: Float) -> Float:
        """Return signed distances, of shape (Q,), at points x, of shape (Q, 3)."""
        k = min(_NEIGHBOURS, len(self._points))
        distances, nearest = self._tree.query(x, k=k, workers=-1)
        heights = np.einsum("qkc,qkc->qk", x[:, None, :] - self._points[nearest], self._normals[nearest])
        vote = (heights / (distances**2 + 1e-12)).sum(axis=1)
        far = distances[:, 0] > self._near
        vote[far] = 0.5 - self.winding_number(x[far])
        signed: Float = np.where(vote < 0, -1.0, 1.0) * distances[:, 0]
        return signed

    def winding_number(self, x: Float, batch: int = 2048) -> Float:
        """Return w, of shape (Q,), at points x, of shape (Q, 3), away from the data."""
        # sum_j d_j . (p_j - x) / |p_j - x|^3, with the squares expanded so that both factors are matrix products.
        offset = np.einsum("jc,jc->j", self._dipoles, self._sources)
        squares = np.einsum("jc,jc->j", self._sources, self._sources)
        parts = [np.zeros(0)]
        for start in range(0, len(x), batch):
            q = x[start : start + batch]
            square = np.einsum("qc,qc->q", q, q)[:, None] - 2 * (q @ self._sources.T) + squares
            flux = offset - q @ self._dipoles.T
            square = np.maximum(square, 1e-12)
            parts.append((flux / (square * np.sqrt(square))).sum(axis=1))
        return np.concatenate(parts)


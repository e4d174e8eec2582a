"""Fit residuals in file units: the field's values at its points, and angles between its gradient and their normals.

Both vanish for an exact signed distance of exact points. A noisy scan leaves residuals as large as its noise; smaller
ones mean that noise was fitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gnrecon.fit.field_model import NeuralSDF
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Samples
from gnrecon.geometry.statistics import Histogram


@dataclass(frozen=True)
class Misfit:
    """Residuals at points of the fit.

    Parameters
    ----------
    distances : array of shape (N,), file units
        Values of the field: how far outside (positive) or inside of the surface each point lies, to first order.
    angles : array of shape (N,), degrees
        Between the field's gradient and the point's normal.
    """

    distances: Float
    angles: Float

    @classmethod
    def of(cls, sdf: NeuralSDF, samples: Samples, *, most_points: int = 20_000) -> Misfit:
        """Measure the residuals at evenly spaced rows of `samples`, at most `most_points`: more change no figure."""
        rows = slice(None, None, -(-len(samples) // most_points))
        points, normals = samples.frame.to_world(samples.points[rows]), samples.normals[rows]
        distances, gradient = sdf.sdf_and_gradient(points)
        lengths = np.maximum(np.linalg.norm(gradient, axis=1), np.finfo(np.float64).tiny)
        cosines = np.einsum("ij,ij->i", gradient, normals) / lengths
        return cls(distances, np.degrees(np.arccos(np.clip(cosines, -1, 1))))

    def describe(self) -> str:
        """Return a sentence with the distances, in file units, and the angles."""
        sizes = np.abs(self.distances)
        return (
            f"distances {sizes.mean():.3g} on the mean, {np.percentile(sizes, 95):.3g} for 95 % of them, "
            f"{sizes.max():.3g} at most; normals {np.median(self.angles):.1f} degrees off in the median."
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the figures and a histogram of each residual, ready for JSON."""
        reach = _reach(np.abs(self.distances))
        return {
            "points": len(self.distances),
            "contradicted": float((self.angles > 90).mean()),
            "distance": _figures(np.abs(self.distances)) | {"histogram": _counts(self.distances, -reach, reach)},
            "angle": _figures(self.angles) | {"histogram": _counts(self.angles, 0.0, _reach(self.angles))},
        }


def _figures(sizes: Float) -> dict[str, float]:
    return {
        "mean": float(sizes.mean()),
        "rms": float(np.sqrt(np.mean(sizes**2))),
        "median": float(np.median(sizes)),
        "p95": float(np.percentile(sizes, 95)),
        "max": float(sizes.max()),
    }


def _reach(sizes: Float, *, percentile: float = 99.0) -> float:
    """Return where a histogram of sizes, of shape (N,), ends: a percentile, or 1 where that is zero or not finite."""
    reach = float(np.percentile(sizes, percentile))
    return reach if 0 < reach < np.inf else 1.0


def _counts(values: Float, low: float, high: float) -> dict[str, Any]:
    return Histogram.of(values, low, high).as_dict()

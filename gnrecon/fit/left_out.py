"""How far off predictions are where data is left out: the fit's own check of its uncertainty, without any truth.

For a linear least-squares fit with whitened rows R of some left-out points and residuals e = r at the mode, the fit
without them would have had the residuals (I - H)^-1 e, of covariance (I - H)^-1, with H = R C R^T: nothing is fitted
again. Source: Cook and Weisberg, Residuals and Influence in Regression (1982), section 2.

Points are left out one by one, and in patches of neighbours, as a hole of the scan would leave them out: errors between
points and errors across holes count alike.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.cloud import Float
from gnrecon.fit.data_rows import DataRows
from gnrecon.fit.laplace import Laplace

PATCHES = {1: 200, 8: 40, 40: 12}
"""Number of patches of each number of points."""

COVERED = 0.9545
"""Share of a normal distribution within two standard deviations."""

BATCH_POINTS = 240
JITTER = 1e-9


def calibration(data: DataRows, posterior: Laplace, seed: int = 0) -> float:
    """Return the factor by which predicted standard deviations must grow to cover what was left out.

    With it, 95.45 % of the left-out positions lie within two standard deviations; each size of patch has the same say.
    """
    rng = np.random.default_rng(seed)
    sizes = [size for size in PATCHES if size == 1 or 5 * size <= len(data)]
    scores = [np.abs(left_out_scores(data, posterior, size, PATCHES[size], rng)) for size in sizes]
    weights = np.concatenate([np.full(len(z), 1 / len(z)) for z in scores]) / len(scores)
    together = np.concatenate(scores)
    order = np.argsort(together)
    place = np.searchsorted(np.cumsum(weights[order]), COVERED)
    return float(together[order][min(place, len(order) - 1)]) / 2


def left_out_scores(data: DataRows, posterior: Laplace, size: int, count: int, rng: np.random.Generator) -> Float:
    """Return errors of left-out positions over their predicted standard deviations, `size` for each patch."""
    points = data.points.cpu().numpy()
    centres = rng.permutation(len(points))[:count]
    patches = cKDTree(points).query(points[centres], list(range(1, size + 1)))[1]
    several = max(1, BATCH_POINTS // size)
    parts = [_scores(data, posterior, patches[start : start + several]) for start in range(0, len(patches), several)]
    return np.concatenate(parts)


def _scores(data: DataRows, posterior: Laplace, patches: npt.NDArray[np.intp]) -> Float:
    """Return the scores of some patches, of shape (count, size), flattened."""
    rows, residuals = _whitened(data, posterior, torch.as_tensor(patches.ravel(), device=data.theta.device))
    shape = (-1, *patches.shape)  # rows of a point, patches, points of a patch
    half = torch.linalg.solve_triangular(posterior.factor, rows.T, upper=False).T
    found = []
    for number in range(len(patches)):
        R = half.reshape(*shape, half.shape[1])[:, number].flatten(0, 1)
        e = residuals.reshape(shape)[:, number].flatten()
        identity = torch.eye(len(e), dtype=e.dtype, device=e.device)
        spread = torch.linalg.inv((1 + JITTER) * identity - R @ R.T)
        # Interface rows come first, one a point.
        found.append(((spread @ e) / spread.diagonal().clamp_min(1.0).sqrt())[: patches.shape[1]])
    return torch.cat(found).cpu().numpy()


def _whitened(data: DataRows, posterior: Laplace, points: Tensor) -> tuple[Tensor, Tensor]:
    """Return rows and residuals at the mode of some points, term by term, in units of their noise."""
    rows, residuals = [], []
    for term, s in zip(data.terms(points), posterior.noise, strict=True):
        jacobian, residual = data.linearise(term)
        rows.append(torch.cat(list(_copied(jacobian.dense()))) / s)
        residuals.append((residual + jacobian.mv(posterior.shift)) / s)
    return torch.cat(rows), torch.cat(residuals)


def _copied(chunks: Iterator[Tensor]) -> Iterator[Tensor]:
    # The next chunk may overwrite the last one.
    return (chunk.clone() for chunk in chunks)

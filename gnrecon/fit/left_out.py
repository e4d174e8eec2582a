"""How far off a fit is where data is left out: its own check of its uncertainty, without any truth.

For a linear least-squares fit with whitened rows R of some left-out points and residuals e at the mode, the fit without
them would have had the residuals (I - H)^-1 e, of covariance (I - H)^-1, with H = R C R^T: nothing is fitted again.
Source: Cook and Weisberg, Residuals and Influence in Regression (1982), section 2.
Where the fitted field is not the mode, because it heeds more than the data, its distance from it adds to the error, as
an independent error would.

Points are left out one by one, and in patches of neighbours, as a hole of the scan would leave them out: errors between
points and errors across holes count alike.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gnrecon.fit.data_rows import DataRows
from gnrecon.fit.laplace import Laplace
from gnrecon.geometry.arrays import Float, Int
from gnrecon.runtime.parallel import slices

PATCHES = {1: 200, 8: 40, 40: 12}
"""Number of patches of each number of points."""

COVERED = 0.9545
"""Share of a normal distribution within two standard deviations."""

BATCH_POINTS = 240
LEAST_REST = 1e-10


def calibration(data: DataRows, posterior: Laplace, seed: int = 0) -> float:
    """Return the factor, at least one, by which predicted standard deviations must grow to cover what was left out.

    With it, 95.45 % of the left-out positions lie within two standard deviations, or more where it is one; each size of
    patch has the same say.
    """
    rng = np.random.default_rng(seed)
    sizes = [size for size in PATCHES if size == 1 or 5 * size <= len(data)]
    scores = [np.abs(left_out_scores(data, posterior, size, PATCHES[size], rng)) for size in sizes]
    weights = np.concatenate([np.full(len(z), 1 / len(z)) for z in scores]) / len(scores)
    together = np.concatenate(scores)
    order = np.argsort(together)
    place = int(np.searchsorted(np.cumsum(weights[order]), COVERED))
    return max(1.0, float(together[order[min(place, len(order) - 1)]]) / 2)


def left_out_scores(data: DataRows, posterior: Laplace, size: int, count: int, rng: np.random.Generator) -> Float:
    """Return errors of left-out positions over their predicted standard deviations, `size` for each patch."""
    points = data.points.cpu().numpy()
    centres = rng.permutation(len(points))[:count]
    patches = cKDTree(points).query(points[centres], list(range(1, size + 1)))[1]
    several = max(1, BATCH_POINTS // size)
    return np.concatenate([_scores(data, posterior, patches[rows]) for rows in slices(len(patches), several)])


def _scores(data: DataRows, posterior: Laplace, patches: Int) -> Float:
    """Return the scores of some patches, of shape (count, size), flattened."""
    count, size = patches.shape
    rows, residuals, steps = _whitened(data, posterior, torch.as_tensor(patches.ravel(), device=data.theta.device))
    half = torch.linalg.solve_triangular(posterior.factor, rows.T, upper=False).T
    # A point has several rows, of which the interface's comes first.
    half, at_mode = half.reshape(-1, count, size, half.shape[1]), (residuals + steps).reshape(-1, count, size)
    beside = steps.reshape(-1, count, size)[0]
    found = []
    for number in range(count):
        spread = _without(half[:, number].flatten(0, 1))
        error = torch.hypot((spread @ at_mode[:, number].flatten())[:size], beside[number])
        found.append(error / spread.diagonal()[:size].sqrt())
    return torch.cat(found).cpu().numpy()


def _without(half: Tensor) -> Tensor:
    """Return (I - H)^-1, of shape (m, m), for H = A A^T with A of shape (m, p)."""
    # By eigenvectors, because rounding may take an eigenvalue of H, which is less than one, beyond one.
    values, vectors = torch.linalg.eigh(half @ half.T)
    spread: Tensor = (vectors / (1.0 - values).clamp(LEAST_REST, 1.0)) @ vectors.T
    return spread


def _whitened(data: DataRows, posterior: Laplace, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return rows J, residuals r and J s for the shift s to the mode, in units of the noise."""
    jacobian, residual = data.linearise(points)
    # The next chunk may overwrite the last one.
    rows = torch.cat([chunk.clone() for chunk in jacobian.dense()])
    return rows / posterior.noise, residual / posterior.noise, jacobian.mv(posterior.shift) / posterior.noise

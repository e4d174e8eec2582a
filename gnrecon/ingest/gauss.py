"""Outward normals of a sparse closed cloud from Gauss's theorem alone, without neighbourhoods.

Lin, Xiao, Shi, Wang, *Surface Reconstruction from Point Clouds without Normals by Parametrizing the Gauss Formula* (ACM
TOG 2022): the unknown area vectors mu_j = a_j n_j must make the winding number 1/2 at every point,

    sum_j K(p_i, p_j) . mu_j = 1/2,     K(q, p) = (p - q) / (4 pi max(|p - q|, width_q)^3),

that is A mu = 1/2 with A of shape (N, 3N). Its least-norm solution is mu = A^T xi with A A^T xi = 1/2, where the
diagonal of A A^T is multiplied by alpha > 1 as regularisation. As the unknowns are global, thin walls and sparse
regions where neighbouring tangent planes say nothing are oriented rightly. The price is a dense system, so N is to be
at most a few thousand.
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float
from gnrecon.ingest.spacing import mean_distances

_ALPHA = 2.0


def gauss_normals(points: Float) -> Float:
    """Return outward unit normals, of shape (N, 3).

    Parameters
    ----------
    points : array of shape (N, 3), distinct, samples of a closed surface
    """
    from scipy.linalg import cho_factor, cho_solve

    width, _ = mean_distances(points)
    offsets = points[None, :, :] - points[:, None, :]
    distances = np.maximum(np.linalg.norm(offsets, axis=2), width[:, None])
    A = (offsets / (4 * np.pi * distances**3)[:, :, None]).reshape(len(points), -1)
    gram = A @ A.T  # A A^T, of shape (N, N)
    gram[np.diag_indices(len(points))] *= _ALPHA
    xi = cho_solve(cho_factor(gram, overwrite_a=True), np.full(len(points), 0.5))
    mu = (A.T @ xi).reshape(-1, 3)  # least-norm area vectors
    normals: Float = mu / np.maximum(np.linalg.norm(mu, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return normals

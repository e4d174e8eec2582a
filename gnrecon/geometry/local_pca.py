"""Principal component analysis of neighbourhoods: tangent planes, surface variation, local coordinates.

The tangent plane of a point is taken to be the plane that fits its k nearest neighbours best (Hoppe et al., *Surface
Reconstruction from Unorganized Points*, 1992). With centroid c = (1/k) sum_i p_i, the sum of squared distances to the
plane through c across a unit vector n is

    sum_i (n . (p_i - c))^2 = n^T S n,      S = sum_i (p_i - c)(p_i - c)^T.

S is symmetric and not negative, so the minimum over unit vectors is its smallest eigenvalue, at that eigenvector: the
normal, of either sign. The other two eigenvectors span the plane. S / k is the covariance of the neighbourhood.

All functions take G neighbourhoods of k points at once, of shape (G, k, 3).
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float


def principal_axes(groups: Float, *, covariance: bool = False) -> tuple[Float, Float]:
    """Return the eigenvalues of S, of shape (G, 3), smallest first, and the unit eigenvectors as columns, (G, 3, 3).

    Parameters
    ----------
    groups : array of shape (G, k, 3)
    covariance : whether the eigenvalues are those of S / k, the variances along the axes
    """
    scatter = _scatter(groups)
    values, axes = np.linalg.eigh(scatter / groups.shape[1] if covariance else scatter)
    return values, axes


def principal_sums(groups: Float) -> Float:
    """Return the eigenvalues of S, of shape (G, 3), smallest first: sums of squared distances along the axes."""
    return np.asarray(np.linalg.eigvalsh(_scatter(groups)), dtype=np.float64)


def plane_normals(groups: Float) -> Float:
    """Return unit normals of either sign, of shape (G, 3), of the planes that fit best."""
    return principal_axes(groups)[1][:, :, 0]


def surface_variation(groups: Float) -> Float:
    """Return the share of the smallest eigenvalue in the sum of all three, of shape (G,); 0 where all points coincide.

    It is 0 in a plane, at most about 0.03 on a curved sheet, and 1/3 for points that fill a ball (Pauly, Gross and
    Kobbelt, *Efficient Simplification of Point-Sampled Surfaces*, 2002).
    """
    values = principal_sums(groups)
    sums = values.sum(axis=1)
    shares: Float = np.maximum(values[:, 0], 0) / np.where(sums > 0, sums, 1)
    return shares


def tangent_coordinates(groups: Float) -> Float:
    """Return points in the frame of their own neighbourhood, of shape (G, k, 3).

    The origin is the first point of the neighbourhood, and the unit its distance to the farthest one. The first two
    coordinates lie in the tangent plane, that along the larger eigenvalue first; the third is along the normal.
    """
    centred = groups - groups[:, :1]
    reach = np.linalg.norm(centred, axis=2).max(axis=1)
    # Distinct points may lie so close that their distance underflows.
    centred = centred / np.maximum(reach, np.finfo(np.float64).tiny)[:, None, None]
    axes = principal_axes(centred)[1][:, :, ::-1]
    local: Float = np.einsum("gki,gij->gkj", centred, axes)
    return local


def _scatter(groups: Float) -> Float:
    """Return S, of shape (G, 3, 3)."""
    centred = groups - groups.mean(axis=1, keepdims=True)
    scatter: Float = np.einsum("gki,gkj->gij", centred, centred)
    return scatter


def quadric_terms(u: Float, v: Float) -> Float:
    """Return 1, u, v, u^2, u v, v^2 as the last axis: the terms of a quadric height over tangent coordinates."""
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)

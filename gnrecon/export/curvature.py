"""Mean and Gauss curvature of level sets, from a field's gradient and second derivatives.

With g = grad f and the Hessian H, the level set of f through a point has there

    mean  = (|g|^2 tr H - g . H g) / (2 |g|^3),        Gauss = g . adj(H) g / |g|^4,

where adj is the adjugate, the transposed matrix of cofactors. Where f is negative inside, the mean curvature of a
sphere of radius r is 1/r: it is the mean of the two principal curvatures, each positive where the surface bends away
from the outward normal. They follow as mean +- sqrt(mean^2 - Gauss).

Source: Goldman, Curvature formulas for implicit curves and surfaces, Computer Aided Geometric Design 22 (2005).
"""

from __future__ import annotations

import numpy as np

from gnrecon.geometry.arrays import Float


def curvatures(gradient: Float, hessian: Float) -> tuple[Float, Float]:
    """Return mean and Gauss curvature, each of shape (N,); not a number where the gradient vanishes.

    Parameters
    ----------
    gradient : array of shape (N, 3)
    hessian : array of shape (N, 3, 3)
        Symmetric; per the unit in which the curvatures come.
    """
    length = np.linalg.norm(gradient, axis=1)
    bend = np.einsum("ni,nij,nj->n", gradient, hessian, gradient)
    spread = np.einsum("nii->n", hessian)
    rows = np.roll(hessian, -1, axis=1), np.roll(hessian, -2, axis=1)
    # The cofactors of a row are the cross product of the two that follow it; the matrix is symmetric, so they are adj.
    adjugate = np.cross(*rows)
    twist = np.einsum("ni,nij,nj->n", gradient, adjugate, gradient)
    defined = length > 0
    mean, gauss = np.full((2, len(length)), np.nan)
    np.divide(length**2 * spread - bend, 2 * length**3, out=mean, where=defined)
    np.divide(twist, length**4, out=gauss, where=defined)
    return mean, gauss

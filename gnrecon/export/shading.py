"""Light on surfaces: two lamps, a hemisphere of sky, and the share of the sky that a point sees.

All lamps are fixed to the camera, so that every view is lit alike. Colours are mixed in linear light.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from gnrecon.geometry.arrays import Float

KEY = (np.array([-0.65, 0.7, 0.45]), 1.45)
FILL = (np.array([0.85, 0.1, 0.35]), 0.28)
"""Directions to the two lamps in the camera's axes (right, up, backward), and their strengths."""

SKY, GROUND = np.array([0.46, 0.52, 0.62]), np.array([0.20, 0.17, 0.15])
"""Light from straight above and from straight below."""

EXPOSURE = 1.5
"""Light that a white surface gives back as white."""

DIRECTIONS = 48
"""Directions over the whole sphere in which the sky is looked for."""


def shade(normals: Float, color: Float, axes: Float, sky: Float | float) -> Float:
    """Linear light, of shape (N, 3), from surfaces with unit normals of shape (N, 3).

    Parameters
    ----------
    normals : array of shape (N, 3)
    color : array of shape (3,) or (N, 3), linear
    axes : array of shape (3, 3)
        The camera's, as rows.
    sky : array of shape (N,), or float
        Share of the sky that is seen.
    """
    # In the precision of the normals, of which there may be millions.
    kind = normals.dtype
    seen = normals @ axes.T.astype(kind)
    # Squared, because light that bounces between close walls is missing, and hollows should read as hollows.
    share = np.broadcast_to(np.square(np.asarray(sky, dtype=kind)), len(seen))[:, None]
    height = (seen[:, 1:2] + 1) / 2
    light = (GROUND.astype(kind) + (SKY - GROUND).astype(kind) * height) * share
    for direction, strength in (KEY, FILL):
        # Wrapping the light a little round the form keeps the shaded side readable.
        facing = np.clip((seen @ (direction / np.linalg.norm(direction)).astype(kind) + 0.15) / 1.15, 0, 1)
        light += strength * facing[:, None] * (0.35 + 0.65 * share)
    half = KEY[0] / np.linalg.norm(KEY[0]) + np.array([0, 0, 1])
    gloss = np.clip(seen @ (half / np.linalg.norm(half)).astype(kind), 0, 1) ** 40
    result: Float = color.astype(kind) * light / EXPOSURE + 0.06 * gloss[:, None] * share
    return result


def open_sky(scene: Any, points: Float, normals: Float, reach: float, directions: Float) -> Float:
    """Share of the sky, of shape (N,), that surface points with unit normals see in directions of shape (D, 3).

    The other parameters are those of `sky_share`.
    """
    from open3d import core

    seen = np.zeros(len(points))
    total = np.zeros(len(points))
    for direction in directions:
        weight = normals @ direction
        rows = np.flatnonzero(weight > 0.05)
        rays = np.empty((len(rows), 6), dtype=np.float32)
        rays[:, :3] = points[rows] + 2e-3 * normals[rows]
        rays[:, 3:] = direction
        covered = scene.test_occlusions(core.Tensor.from_numpy(rays), tnear=0.0, tfar=reach).numpy()
        total[rows] += weight[rows]
        seen[rows] += weight[rows] * ~covered
    share: Float = seen / np.maximum(total, 1e-9)
    return share


def sky_share(scene: Any, points: Float, normals: Float, hit: Any, reach: float) -> Float:
    """Share of the sky seen from surface points, as an image, smoothed over about a pixel.

    Parameters
    ----------
    scene : open3d's ray-casting scene of the surface
    points, normals : arrays of shape (N, 3)
        At the pixels that show the surface.
    hit : boolean array of shape (H, W)
        Which pixels these are.
    reach : float
        How near something must be to cover the sky.
    """
    image = np.zeros(hit.shape)
    image[hit] = open_sky(scene, points, normals, reach, sphere_directions())
    # Averaging over the surface's own pixels alone keeps the outline free of a halo.
    smooth = gaussian_filter(image, 1.2) / np.maximum(gaussian_filter(hit.astype(np.float64), 1.2), 1e-9)
    return np.asarray(smooth)


def sphere_directions() -> Float:
    """Directions spread evenly over the sphere, of shape (N, 3), on a Fibonacci spiral."""
    z = 1 - (2 * np.arange(DIRECTIONS) + 1) / DIRECTIONS
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(DIRECTIONS)
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def to_linear(color: tuple[int, int, int]) -> Float:
    """Linear light, of shape (3,), of an sRGB colour from 0 to 255."""
    return np.asarray((np.array(color) / 255.0) ** 2.2)


def to_bytes(light: Float) -> Any:
    """sRGB bytes of an image of linear light; what is brighter than white becomes white."""
    return np.uint8(np.round(255 * np.clip(light, 0, 1) ** (1 / 2.2)))

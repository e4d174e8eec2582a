"""Point clouds as small shaded balls, drawn into a depth buffer."""

from __future__ import annotations

import numpy as np

from gnrecon.export.camera import Camera
from gnrecon.export.shading import shade
from gnrecon.geometry.arrays import Float, Int

FADE = 0.6
"""Share of the background in the furthest point's colour."""


def draw_points(
    points: Float, normals: Float | None, radius: float, camera: Camera, color: Float, background: Float
) -> Float:
    """Draw balls on a picture of linear light.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3)
        With normals, a ball is shaded half by its own form and half by the surface that it stands for, and left out
        where that faces away. Without, balls fade with their depth.
    radius : float
        Of the balls.
    camera : Camera
    color : array of shape (3,), linear
    background : array of shape (H, W, 3), linear

    Returns
    -------
    array of shape (H, W, 3)
    """
    if normals is not None:
        facing = np.einsum("ij,ij->i", normals, camera.eye - points) > 0
        points, normals = points[facing], normals[facing]
    if not len(points):
        return background
    column, row, depth = camera.project(points)
    # From 0 for the nearest point to 1 for the furthest.
    far = (depth - depth.min()) / max(float(np.ptp(depth)), 1e-9)
    # A ball smaller than about a pixel would flicker.
    size = np.maximum(radius * camera.focal / depth, 1.0)
    nearest = np.full(camera.height * camera.width, np.inf)
    stamps = [_stamp(column, row, depth, size, camera, offset) for offset in _offsets(float(size.max()))]
    for _, pixel, front, _ in stamps:
        np.minimum.at(nearest, pixel, front)
    image = background.reshape(-1, 3).copy()
    for drawn, pixel, front, ball in stamps:
        visible = front == nearest[pixel]
        form = ball[visible] @ camera.axes
        if normals is not None:
            form = form + normals[drawn[visible]]
            form /= np.maximum(np.linalg.norm(form, axis=1, keepdims=True), 1e-9)
        light = shade(form, color, camera.axes, 1.0)
        if normals is None:
            haze = FADE * far[drawn[visible], None]
            light = (1 - haze) * light + haze * background.reshape(-1, 3)[pixel[visible]]
        image[pixel[visible]] = light
    return image.reshape(background.shape)


def _offsets(size: float) -> list[tuple[int, int]]:
    reach = int(np.ceil(size))
    steps = range(-reach, reach + 1)
    return [(x, y) for x in steps for y in steps if x * x + y * y <= (size + 1) ** 2]


def _stamp(
    column: Float, row: Float, depth: Float, size: Float, camera: Camera, offset: tuple[int, int]
) -> tuple[Int, Int, Float, Float]:
    """Of every ball one pixel, at an offset from the middle's: which balls cover it, where, how deep, what normal."""
    x, y = np.floor(column).astype(np.int64) + offset[0], np.floor(row).astype(np.int64) + offset[1]
    dx, dy = (x + 0.5 - column) / size, (y + 0.5 - row) / size
    rest = 1 - dx**2 - dy**2
    drawn = np.flatnonzero((rest >= 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height))
    height = np.sqrt(rest[drawn])
    front = depth[drawn] - height * size[drawn] * depth[drawn] / camera.focal
    ball = np.stack([dx[drawn], -dy[drawn], height], axis=1)
    return drawn, y[drawn] * camera.width + x[drawn], front, ball

"""A perspective camera that frames a shape from a named direction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_array
from scipy.spatial.transform import Rotation

from gnrecon.export.boolean import centre_and_size
from gnrecon.export.metrics import ray_scene
from gnrecon.geometry.arrays import Float, Int
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import UsageError

View = str | tuple[float, float]
"""A name of `VIEWS`, or the azimuth and elevation in degrees from which the shape is seen."""

VIEWS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "front": (0.0, 0.0),
        "right": (90.0, 0.0),
        "back": (180.0, 0.0),
        "left": (-90.0, 0.0),
        "top": (0.0, 89.9),
        "bottom": (0.0, -89.9),
        "three-quarter": (-35.0, 22.0),
    }
)

HALF_FIELD = float(np.tan(np.radians(12.0)))
"""Half the picture's shorter side at distance one: a field of view of 24 degrees, narrow enough to look undistorted."""

MARGIN = 0.92
"""Share of the picture that the shape may fill."""


@dataclass(frozen=True)
class Camera:
    """Where the eye is and what a pixel looks at.

    Parameters
    ----------
    eye : array of shape (3,)
    axes : array of shape (3, 3)
        Rows: right, up, and backward, towards the eye.
    width, height : int
        Of the picture in pixels.
    """

    eye: Float
    axes: Float
    width: int
    height: int

    @property
    def focal(self) -> float:
        """Pixels per unit of slope."""
        return min(self.width, self.height) / (2 * HALF_FIELD)

    @classmethod
    def framing(cls, points: Float, view: View, up: str, width: int, height: int) -> Camera:
        """Return the camera that sees all `points`, of shape (N, 3), as large as possible.

        Raises
        ------
        UsageError
            When the view or the upward axis is unknown.
        """
        axes = _axes(view, up)
        right, upward, backward = axes @ points.T
        slopes = np.array([width, height]) / min(width, height) * HALF_FIELD * MARGIN
        # A point (x, y, z) is in the picture when |x - x0| <= s (d - z): each side is a plane, so the eye's distance d
        # and its offset x0 follow from the two extreme planes of the wider direction.
        planes = [
            (np.max(x / s + backward), np.max(-x / s + backward)) for x, s in zip((right, upward), slopes, strict=True)
        ]
        distance = max((high + low) / 2 for high, low in planes)
        offsets = [s * (high - low) / 2 for (high, low), s in zip(planes, slopes, strict=True)]
        return cls(np.array([*offsets, distance]) @ axes, axes, width, height)

    def rays(self) -> Float:
        """Origins and unit directions through the pixels' middles, of shape (height, width, 6)."""
        x = (np.arange(self.width) + 0.5 - self.width / 2) / self.focal
        y = (self.height / 2 - np.arange(self.height) - 0.5) / self.focal
        rays = np.empty((self.height, self.width, 6))
        rays[..., :3] = self.eye
        rays[..., 3:] = x[None, :, None] * self.axes[0] + y[:, None, None] * self.axes[1] - self.axes[2]
        rays[..., 3:] /= np.linalg.norm(rays[..., 3:], axis=2, keepdims=True)
        return rays

    def project(self, points: Float) -> tuple[Float, Float, Float]:
        """Column, row and depth, each of shape (N,), at which points of shape (N, 3) appear."""
        x, y, z = self.axes @ (points - self.eye).T
        return self.width / 2 - self.focal * x / z, self.height / 2 + self.focal * y / z, -z


def _axes(view: View, up: str) -> Float:
    """Right, up and backward directions, as rows, of the camera that looks from a view."""
    if isinstance(view, str) and view not in VIEWS:
        raise UsageError(f"The view {view!r} is unknown; expected one of {', '.join(VIEWS)}, or azimuth and elevation.")
    if up not in ("y", "z"):
        raise UsageError(f"The upward axis is {up!r}, but must be 'y' or 'z'.")
    azimuth, elevation = np.radians(VIEWS[view] if isinstance(view, str) else view)
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    # With z upward, the front is seen from -y; with y upward, from +z.
    axes = np.array([[ca, sa, 0], [sa * -se * -1, -ca * -se * -1, ce], [sa * ce, -ca * ce, se]])
    axes[1] = np.cross(axes[2], axes[0])
    return axes if up == "z" else axes[:, [0, 2, 1]] * np.array([1, 1, -1])


KEY = (np.array([-0.65, 0.7, 0.45]), 1.45)

FILL = (np.array([0.85, 0.1, 0.35]), 0.28)
"""Directions to the two lamps in the camera's axes (right, up, backward), and their strengths."""

SKY, GROUND = np.array([0.46, 0.52, 0.62]), np.array([0.20, 0.17, 0.15])
"""Light from straight above and from straight below."""

EXPOSURE = 1.5
"""Light that a white surface gives back as white."""

DIRECTIONS = 48
"""Directions over the whole sphere in which the sky is looked for."""


# Light on surfaces: two lamps, a hemisphere of sky, and the share of the sky that a point sees.
#
# All lamps are fixed to the camera, so that every view is lit alike. Colours are mixed in linear light.


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


def sky_visibility(scene: Any, points: Float, normals: Float, reach: float, directions: Float) -> Float:
    """Share of the sky, of shape (N,), that surface points with unit normals see in directions of shape (D, 3).

    The other parameters are those of `ambient_occlusion`.
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


def ambient_occlusion(scene: Any, points: Float, normals: Float, hit: Any, reach: float) -> Float:
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
    image[hit] = sky_visibility(scene, points, normals, reach, sphere_directions())
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


REACH = 0.7
"""How near something must be to cover the sky, in halves of the mesh's longest side."""

TURNS = 8
"""Sets of directions, turned against each other: were they the same for all vertices, they would show as bands."""

PASSES = 6
"""How often a vertex takes the mean of itself and its neighbours, and so mixes their directions."""


# How much of the sky each vertex of a mesh sees, for viewers that cannot cast rays themselves.


def vertex_ambient_occlusion(mesh: Mesh) -> Float:
    """Return the share of the sky that each vertex sees, of shape (V,), from 0 to 1, smoothed over its neighbours."""
    centre, size = centre_and_size(mesh)
    unit = (mesh.vertices - centre) / size
    scene, normals = ray_scene(unit, mesh.faces), mesh.vertex_normals()
    share = np.empty(len(unit))
    # Normal numbers make quaternions of uniformly distributed rotations.
    rotations = Rotation.from_quat(np.random.default_rng(0).normal(size=(TURNS, 4)))
    for turn, rotation in enumerate(rotations):
        part = slice(turn, None, TURNS)
        share[part] = sky_visibility(scene, unit[part], normals[part], REACH, rotation.apply(sphere_directions()))
    start, end = mesh.faces[:, [0, 1, 2]].reshape(-1), mesh.faces[:, [1, 2, 0]].reshape(-1)
    own = np.arange(len(share))
    rows, columns = np.concatenate([start, end, own]), np.concatenate([end, start, own])
    near = coo_array((np.ones(len(rows)), (rows, columns)), shape=2 * (len(share),)).tocsr()
    count = near.sum(axis=1)
    for _ in range(PASSES):
        share = near @ share / count
    return share


FADE = 0.6
"""Share of the background in the furthest point's colour."""


# Point clouds as small shaded balls, drawn into a depth buffer.


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

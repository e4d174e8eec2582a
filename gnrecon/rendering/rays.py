"""A perspective camera, the shading of surfaces, ambient occlusion, and points drawn as shaded balls.

`Camera` frames a shape from a named direction. `shade` lights surfaces by two lamps and a hemisphere of sky;
`ambient_occlusion` and `vertex_ambient_occlusion` compute how much of that sky places see, and `draw_points` draws a
cloud into a depth buffer.
"""

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
from gnrecon.rendering.rendering_parameters import LightParameters, RenderingParameters
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


@dataclass(frozen=True)
class Camera:
    """Position, orientation and size of a picture.

    Parameters
    ----------
    eye : array of shape (3,)
    axes : array of shape (3, 3)
        Rows: right, up, and backward, towards the eye.
    width, height : int
        Of the picture in pixels.
    field_of_view : float, degrees
        Over the picture's shorter side.
    """

    eye: Float
    axes: Float
    width: int
    height: int
    field_of_view: float = RenderingParameters.field_of_view_degrees

    @property
    def focal(self) -> float:
        """Pixels per unit of slope."""
        return min(self.width, self.height) / (2 * _half_field(self.field_of_view))

    @classmethod
    def framing(
        cls, points: Float, view: View, up: str, width: int, height: int, *, fill_share: float = 0.92
    ) -> Camera:
        """Return the camera that sees all `points`, of shape (N, 3), within `fill_share` of the picture.

        Raises
        ------
        UsageError
            When the view or the upward axis is unknown.
        """
        axes = _axes(view, up)
        right, upward, backward = axes @ points.T
        slopes = np.array([width, height]) / min(width, height) * _half_field(cls.field_of_view) * fill_share
        # A point (x, y, z) is in the picture when |x - x0| <= s (d - z): each side is a plane, so the eye's distance d
        # and its offset x0 follow from the two extreme planes of the wider direction.
        planes = [
            (np.max(x / s + backward), np.max(-x / s + backward)) for x, s in zip((right, upward), slopes, strict=True)
        ]
        distance = max((high + low) / 2 for high, low in planes)
        offsets = [s * (high - low) / 2 for (high, low), s in zip(planes, slopes, strict=True)]
        return cls(np.array([*offsets, distance]) @ axes, axes, width, height)

    def rays(self, column: Float, row: Float) -> Float:
        """Origins and unit directions through places of the picture, of shape (N, 6).

        `column` and `row`, of shape (N,), count pixels from the upper left corner; pixels' middles are at halves.
        """
        x, y = (column - self.width / 2) / self.focal, (self.height / 2 - row) / self.focal
        ways = x[:, None] * self.axes[0] + y[:, None] * self.axes[1] - self.axes[2]
        rays = np.empty((len(x), 6))
        rays[:, :3] = self.eye
        rays[:, 3:] = ways / np.sqrt(x**2 + y**2 + 1.0)[:, None]
        return rays

    def project(self, points: Float) -> tuple[Float, Float, Float]:
        """Column, row and depth, each of shape (N,), at which points of shape (N, 3) appear."""
        x, y, z = self.axes @ (points - self.eye).T
        return self.width / 2 - self.focal * x / z, self.height / 2 + self.focal * y / z, -z


def _half_field(field_of_view: float) -> float:
    """Half the picture's shorter side at distance one, from an angle in degrees."""
    return float(np.tan(np.radians(field_of_view / 2)))


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


def shade(
    normals: Float,
    color: Float,
    axes: Float,
    sky: Float | float,
    *,
    parameters: LightParameters = RenderingParameters.light,
) -> Float:
    """Linear light, of shape (N, 3), from surfaces with unit normals of shape (N, 3).

    Parameters
    ----------
    normals : array of shape (N, 3)
    color : array of shape (3,) or (N, 3), linear
    axes : array of shape (3, 3)
        The camera's, as rows.
    sky : array of shape (N,), or float
        Share of the sky that is seen.
    parameters : LightParameters
    """
    sky_color, ground_color = np.array(parameters.sky_color), np.array(parameters.ground_color)
    key, fill = (np.array(direction) for direction in (parameters.key_direction, parameters.fill_direction))
    # In the precision of the normals, of which there may be millions.
    kind = normals.dtype
    seen = normals @ axes.T.astype(kind)
    # Squared, because light reflected between close walls is missing, and hollows should look hollow.
    share = np.broadcast_to(np.square(np.asarray(sky, dtype=kind)), len(seen))[:, None]
    height = (seen[:, 1:2] + 1) / 2
    light = (ground_color.astype(kind) + (sky_color - ground_color).astype(kind) * height) * share
    for direction, strength in ((key, parameters.key_strength), (fill, parameters.fill_strength)):
        # Wrapped lighting keeps the shaded side readable.
        facing = np.clip((seen @ (direction / np.linalg.norm(direction)).astype(kind) + 0.15) / 1.15, 0, 1)
        light += strength * facing[:, None] * (0.35 + 0.65 * share)
    half = key / np.linalg.norm(key) + np.array([0, 0, 1])
    gloss = np.clip(seen @ (half / np.linalg.norm(half)).astype(kind), 0, 1) ** 40
    result: Float = color.astype(kind) * light / parameters.exposure + 0.06 * gloss[:, None] * share
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


def ambient_occlusion(
    scene: Any,
    points: Float,
    normals: Float,
    hit: Any,
    reach: float = RenderingParameters.light.occlusion_reach,
) -> Float:
    """Share of the sky seen from surface points, as an image, smoothed over about a pixel.

    Neighbouring pixels look in different directions, a quarter of all each, and share what they see by the smoothing.

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
    row, column = np.nonzero(hit)
    turn = 2 * (row % 2) + column % 2
    directions = sphere_directions(RenderingParameters.light.sky_directions // 4)
    image[hit] = _sky_in_turns(scene, points, normals, reach, turn, directions)
    # Averaging over the surface's own pixels alone keeps the outline free of a halo.
    smooth = gaussian_filter(image, 1.2) / np.maximum(gaussian_filter(hit.astype(np.float64), 1.2), 1e-9)
    return np.asarray(smooth)


def _sky_in_turns(scene: Any, points: Float, normals: Float, reach: float, turn: Int, directions: Float) -> Float:
    """Share of the sky that points see in `directions`, turned about at random: equal numbers `turn` by the same turn.

    With the same directions for all, bands would show.
    """
    share = np.empty(len(points))
    # Normal numbers make quaternions of uniformly distributed rotations.
    rotations = Rotation.from_quat(np.random.default_rng(0).normal(size=(int(turn.max(initial=0)) + 1, 4)))
    for number, rotation in enumerate(rotations):
        part = np.flatnonzero(turn == number)
        share[part] = sky_visibility(scene, points[part], normals[part], reach, rotation.apply(directions))
    return share


def sphere_directions(count: int = RenderingParameters.light.sky_directions) -> Float:
    """Directions spread evenly over the sphere, of shape (N, 3), on a Fibonacci spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def gamma_decoded(color: tuple[int, int, int]) -> Float:
    """Linear light, of shape (3,), of a colour from 0 to 255, by the power 2.2 that approximates sRGB."""
    return np.asarray((np.array(color) / 255.0) ** 2.2)


def gamma_encoded(light: Float) -> Any:
    """Bytes of an image of linear light, by the power 1 / 2.2; what is brighter than white becomes white."""
    return np.uint8(np.round(255 * np.clip(light, 0, 1) ** (1 / 2.2)))


def vertex_ambient_occlusion(
    mesh: Mesh,
    *,
    reach: float = RenderingParameters.light.occlusion_reach,
    direction_sets: int = 8,
    smoothing_passes: int = 6,
) -> Float:
    """Return the share of the sky that each vertex sees, of shape (V,), for viewers that cannot cast rays.

    Parameters
    ----------
    mesh : Mesh
    reach : float, halves of the mesh's longest side
        How near something must be to cover the sky.
    direction_sets : int
        Rotated sets of directions that vertices take in turn.
    smoothing_passes : int
        Times that a vertex takes the mean of itself and its neighbours, which mixes their directions.
    """
    centre, size = centre_and_size(mesh)
    unit = (mesh.vertices - centre) / size
    scene, normals = ray_scene(unit, mesh.faces), mesh.vertex_normals()
    turn = np.arange(len(unit)) % direction_sets
    share = _sky_in_turns(scene, unit, normals, reach, turn, sphere_directions())
    start, end = mesh.faces[:, [0, 1, 2]].reshape(-1), mesh.faces[:, [1, 2, 0]].reshape(-1)
    own = np.arange(len(share))
    rows, columns = np.concatenate([start, end, own]), np.concatenate([end, start, own])
    near = coo_array((np.ones(len(rows)), (rows, columns)), shape=2 * (len(share),)).tocsr()
    count = near.sum(axis=1)
    for _ in range(smoothing_passes):
        share = near @ share / count
    return share


def draw_points(
    points: Float,
    normals: Float | None,
    radius: float,
    camera: Camera,
    color: Float,
    background: Float,
    *,
    haze_share: float = 0.6,
) -> Float:
    """Draw points as shaded balls on a picture of linear light.

    Parameters
    ----------
    points, normals : arrays of shape (N, 3)
        With normals, a ball is shaded half by its own form and half by the surface's normal, and skipped where that
        faces away. Without, balls fade with their depth.
    radius : float
        Of the balls.
    camera : Camera
    color : array of shape (3,), linear
    background : array of shape (H, W, 3), linear
    haze_share : float
        Share of the background in the farthest point's colour.

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
            haze = haze_share * far[drawn[visible], None]
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

"""A range camera that scans a mesh from all around.

From each viewpoint, on a sphere about the middle of the bounding box, one ray goes through
each pixel of a square image that just holds the bounding sphere. The first hit's range is disturbed by Gaussian noise.
As in a real range image, only ranges are known: the normal is the cross product of the differences between the measured
neighbours left and right, above and below, and points to the camera; pixels without all four neighbours, and those seen
at a grazing angle by this normal (which includes the false slopes across depth edges), are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud


@dataclass(frozen=True)
class Scanner:
    """A camera of `pixels` x `pixels` rays.

    Parameters
    ----------
    pixels : rays along each side of the image
    noise : standard deviation of a range, in bounding radii
    reach : distance in pixels to the neighbours that a normal is computed from
    grazing : largest angle between normal and ray that still returns, in degrees
    outliers : share of the rays whose range is replaced by one drawn uniformly within a bounding radius of it
    distance : from the middle of the object to a camera, in bounding radii
    rings : elevation in degrees and number of cameras of each ring; one more camera looks down the axis and one up
    """

    pixels: int = 200
    noise: float = 0.0005
    reach: int = 1
    grazing: float = 75.0
    outliers: float = 0.0
    distance: float = 4.0
    rings: tuple[tuple[float, int], ...] = ((50.0, 5), (0.0, 6), (-50.0, 5))

    def view_directions(self) -> Float:
        """Return the unit directions from the object to the cameras, of shape (18, 3) with the default rings."""
        directions = [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0)]
        for elevation, count in self.rings:
            up = np.radians(elevation)
            # Rings are rotated against each other by half a step.
            turns = 2.0 * np.pi * (np.arange(count) + (0.5 if elevation else 0.0)) / count
            directions += [(np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)) for turn in turns]
        return np.array(directions)

    def pixel_rays(self, direction: Float) -> Float:
        """Return the unit rays of a camera that looks along -`direction`, of shape (pixels, pixels, 3)."""
        side = np.array([0.0, 0.0, 1.0]) if abs(direction[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
        right = np.cross(side, direction)
        right /= np.linalg.norm(right)
        up = np.cross(direction, right)
        half_width = np.tan(np.arcsin(1.0 / self.distance))
        offsets = half_width * (2.0 * (np.arange(self.pixels) + 0.5) / self.pixels - 1.0)
        rays = offsets[None, :, None] * right - offsets[:, None, None] * up - direction
        unit: Float = rays / np.linalg.norm(rays, axis=2, keepdims=True)
        return unit


def image_normals(places: Float, rays: Float, reach: int) -> Float:
    """Return unit normals at `places`, toward the camera; both of shape (H, W, 3), NaN where nothing was measured."""
    normals = np.full_like(places, np.nan)
    across = places[reach:-reach, 2 * reach :] - places[reach:-reach, : -2 * reach]
    down = places[2 * reach :, reach:-reach] - places[: -2 * reach, reach:-reach]
    inner = np.cross(down, across)
    inner /= np.linalg.norm(inner, axis=2, keepdims=True)
    facing = np.einsum("ijk,ijk->ij", inner, rays[reach:-reach, reach:-reach])
    normals[reach:-reach, reach:-reach] = -np.sign(facing)[..., None] * inner
    return normals


def scan(mesh: Mesh, scanner: Scanner, count: int, rng: np.random.Generator) -> PointCloud:
    """Scan a closed mesh from all viewpoints.

    Parameters
    ----------
    mesh : of any unit; the cloud has the same
    scanner : the camera
    count : number of points to keep, drawn at random from all that returned, in random order
    rng : source of noise

    Raises
    ------
    ValueError
        When fewer than `count` rays return.
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle, radius = (low + high) / 2.0, float(np.linalg.norm(high - low)) / 2.0
    # Rays are cast in bounding radii about the origin, because the scene works in float32.
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        open3d.core.Tensor.from_numpy(((mesh.vertices - middle) / radius).astype(np.float32)),
        open3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)),
    )
    views = [_one_view(scene, scanner, direction, rng) for direction in scanner.view_directions()]
    points, normals = (np.concatenate(parts) for parts in zip(*views, strict=True))
    if len(points) < count:
        raise ValueError(f"{len(points)} rays returned, fewer than the {count} points that were requested.")
    rows = rng.permutation(len(points))[:count]
    return PointCloud(middle + radius * points[rows], normals[rows])


def _one_view(
    scene: open3d.t.geometry.RaycastingScene, scanner: Scanner, direction: Float, rng: np.random.Generator
) -> tuple[Float, Float]:
    camera, rays = scanner.distance * direction, scanner.pixel_rays(direction)
    # From the front of the bounding sphere on, where float32 ranges are finest.
    start = camera + (scanner.distance - 1.0) * rays
    hits = scene.cast_rays(open3d.core.Tensor.from_numpy(np.concatenate([start, rays], axis=2).astype(np.float32)))
    ranges = hits["t_hit"].numpy().astype(np.float64)
    ranges[np.isinf(ranges)] = np.nan
    ranges += scanner.noise * rng.standard_normal(ranges.shape)
    places = start + ranges[..., None] * rays
    normals = image_normals(places, rays, scanner.reach)
    # NaN compares as false, so rays without a normal go as well; one without a return may have one, by its neighbours.
    seen = np.isfinite(ranges) & (-np.einsum("ijk,ijk->ij", normals, rays) >= np.cos(np.radians(scanner.grazing)))
    wrong = seen & (rng.random(seen.shape) < scanner.outliers)
    places[wrong] += rng.uniform(-1.0, 1.0, (int(wrong.sum()), 1)) * rays[wrong]
    normals[wrong] = -rays[wrong]
    return places[seen], normals[seen]

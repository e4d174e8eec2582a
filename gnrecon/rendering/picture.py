"""Pictures of meshes and scans by ray casting, so that no display and no graphics card is needed.

A pixel is the mean of nine samples, or a single one where its neighbours look the same. Surfaces are shaded by
interpolated vertex normals, points as small balls. The entries are `render` and `render_sheet`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial import cKDTree

from gnrecon.export.metrics import ray_scene
from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.colors import as_bytes, to_linear
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.rendering.rays import Camera, View, ambient_occlusion, draw_points, gamma_decoded, gamma_encoded, shade
from gnrecon.rendering.rendering_parameters import RenderingParameters, SheetParameters
from gnrecon.runtime.chunks import slices
from gnrecon.runtime.errors import UsageError

Image = npt.NDArray[np.uint8]


def render(
    mesh: Mesh | None,
    path: str | Path | None = None,
    *,
    size: tuple[int, int] = (900, 600),
    views: Sequence[View] = ("three-quarter",),
    color: tuple[int, int, int] = (230, 208, 180),
    points: PointCloud | None = None,
    point_color: tuple[int, int, int] = (86, 120, 164),
    up: str = "z",
) -> Image:
    """Draw a mesh, a scan, or both side by side.

    Parameters
    ----------
    mesh : Mesh, optional
    path : path, optional
        PNG file to write; an older one is replaced.
    size : pair of int
        Width and height of the whole picture in pixels.
    views : sequence of names or (azimuth, elevation) in degrees
        Each is a panel; see `rays.VIEWS` for the names.
    color, point_color : sRGB from 0 to 255
        Of a mesh without the attribute ``colors``, which is drawn where there is one, and of points.
    points : PointCloud, optional
        Drawn in a panel of its own left of the mesh's, from the same place.
    up : str
        The axis that points upward, ``"y"`` or ``"z"``.

    Returns
    -------
    array of shape (height, width, 3), uint8

    Raises
    ------
    UsageError
        When there is nothing to draw, or a view or the size is invalid.
    OutputError
        When the file cannot be written.
    """
    shown = [part for part in (points, mesh) if part is not None and len(_places(part))]
    panels = len(shown) * len(views)
    if not panels:
        raise UsageError("There is nothing to draw: give a mesh or points, and a view.")
    if size[0] < panels or size[1] < 1:
        raise UsageError(f"A picture of {size[0]} x {size[1]} pixels has no room for {panels} panels.")
    strips = _draw_panels(shown, views, up, size, (gamma_decoded(color), gamma_decoded(point_color)))
    image: Image = gamma_encoded(np.concatenate(strips, axis=1))
    if path is not None:
        write_image(image, Path(path))
    return image


def _draw_panels(
    shown: Sequence[Mesh | PointCloud],
    views: Sequence[View],
    up: str,
    size: tuple[int, int],
    colors: tuple[Float, Float],
) -> list[Float]:
    """Linear light of each panel; the colours are those of a mesh and of points."""
    # Everything is centred and scaled to about one, because the ray caster uses float32.
    places = np.concatenate([_places(part) for part in shown])
    centre = (places.min(axis=0) + places.max(axis=0)) / 2
    scale = float(np.linalg.norm(places - centre, axis=1).max()) or 1.0
    samples = RenderingParameters.supersampling
    edges = np.linspace(0, size[0], len(shown) * len(views) + 1).astype(int) * samples
    strips = []
    for index, width in enumerate(np.diff(edges)):
        view, part = views[index // len(shown)], shown[index % len(shown)]
        # All panels of a view share the camera, so that scan and mesh can be compared.
        camera = Camera.framing((places - centre) / scale, view, up, int(width), size[1] * samples)
        unit = (_places(part) - centre) / scale
        if isinstance(part, Mesh):
            strips.append(_draw_mesh(part.with_vertices(unit), camera, colors[0]))
        else:
            strips.append(_draw_cloud(PointCloud(unit, part.normals), camera, colors[1]))
    return strips


def _pixels(light: Float, samples: int = RenderingParameters.supersampling) -> Float:
    """Means over the samples, `samples` along each side of a pixel, of an image of light of shape (H, W, 3)."""
    height, width = light.shape[0] // samples, light.shape[1] // samples
    return np.asarray(light.reshape(height, samples, width, samples, 3).mean(axis=(1, 3)))


def _places(part: Mesh | PointCloud) -> Float:
    return part.vertices if isinstance(part, Mesh) else part.points


def _background(camera: Camera, *, top: float = 1.0, bottom: float = 0.86) -> Float:
    """Linear light of a white background, a little darker towards the bottom, of shape (H, W, 3)."""
    rows = np.linspace(top, bottom, camera.height)
    return np.broadcast_to(rows[:, None, None], (camera.height, camera.width, 3)).copy()


class _Surface:
    """A mesh of about unit size, which rays are cast at.

    Parameters
    ----------
    mesh : Mesh
    color : array of shape (3,), linear; of a mesh without colours of its own
    """

    def __init__(self, mesh: Mesh, color: Float) -> None:
        self.scene, self.faces = ray_scene(mesh.vertices, mesh.faces), mesh.faces
        # Single precision is enough for a picture, and there are millions of samples.
        self._normals, self._color, self._colors = mesh.vertex_normals().astype(np.float32), color, None
        if "colors" in mesh.attributes:
            self._colors = to_linear(as_bytes(mesh.attributes["colors"])[:, :3]).astype(np.float32)

    def cast(self, rays: Float) -> tuple[Mask, Float, Float, Float]:
        """Which rays, (N, 6), hit, and of the M that do the places, unit normals and colours, (M, 3), or one colour."""
        from open3d import core

        answer = self.scene.cast_rays(core.Tensor.from_numpy(rays.astype(np.float32)))
        distance = answer["t_hit"].numpy()
        hit = np.isfinite(distance)
        corners = self.faces[answer["primitive_ids"].numpy()[hit]]
        u, v = answer["primitive_uvs"].numpy()[hit].T
        shares = np.stack([1 - u - v, u, v], axis=1)
        normals = np.einsum("ij,ijk->ik", shares, self._normals[corners])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.float32(1e-9))
        colors = self._color if self._colors is None else np.einsum("ij,ijk->ik", shares, self._colors[corners])
        return hit, rays[hit, :3] + distance[hit, None] * rays[hit, 3:], normals, colors


def _draw_mesh(
    mesh: Mesh,
    camera: Camera,
    color: Float,
    *,
    samples: int = RenderingParameters.supersampling,
    least_change: float = 0.02,
    batch_pixels: int = 1 << 15,
) -> Float:
    """Linear light of the pixels, each `samples` of the camera's wide.

    One is sampled more than once where its light differs from a neighbour's by `least_change` or more.
    """
    surface = _Surface(mesh, color)
    image = _pixels(_background(camera), samples)
    row, column = np.indices(image.shape[:2], dtype=np.float64).reshape(2, -1)
    found, places, normals, colors = surface.cast(camera.rays(samples * (column + 0.5), samples * (row + 0.5)))
    hit = found.reshape(image.shape[:2])
    sky = ambient_occlusion(surface.scene, places, normals, hit)
    paper = image.reshape(-1, 3).copy()
    image[hit] = shade(normals, colors, camera.axes, sky[hit])
    # What a pixel has outside of its middle shows in a neighbour; a margin finds what is narrower than a pixel.
    change = maximum_filter(image, (3, 3, 1)) - minimum_filter(image, (3, 3, 1))
    edge = np.flatnonzero(maximum_filter(change.max(axis=2), 3) >= least_change)
    image = image.reshape(-1, 3)
    steps = np.indices((samples, samples)).reshape(2, -1) + 0.5
    for part in slices(len(edge), batch_pixels):
        pixels = edge[part]
        across, down = (
            samples * places[pixels, None] + step for places, step in zip((column, row), steps, strict=True)
        )
        found, _, normals, colors = surface.cast(camera.rays(across.ravel(), down.ravel()))
        light = paper[pixels].repeat(samples**2, 0)
        light[found] = shade(normals, colors, camera.axes, sky.reshape(-1)[pixels].repeat(samples**2)[found])
        image[pixels] = light.reshape(len(pixels), -1, 3).mean(axis=1)
    return image.reshape(*hit.shape, 3)


def _draw_cloud(cloud: PointCloud, camera: Camera, color: Float) -> Float:
    spacing = 0.02
    if len(cloud) > 1:
        # Two thousand points are enough for the median spacing.
        some = cloud.points[:: -(-len(cloud) // 2000)]
        spacing = float(np.median(cKDTree(cloud.points).query(some, k=2)[0][:, 1]))
    # Files that hold zeros for normals hold none; points without a side are seen from all sides.
    normals = cloud.normals if cloud.has_directions else None
    if normals is not None:
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    return _pixels(draw_points(cloud.points, normals, min(0.55 * spacing, 0.02), camera, color, _background(camera)))


def write_image(image: Image, path: Path) -> None:
    """Write an image of shape (H, W, 3) as PNG, atomically; an older file is replaced.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    from PIL import Image as Pillow

    from gnrecon.runtime.files import atomic_write

    with atomic_write(path, overwrite=True) as temporary:
        Pillow.fromarray(image).save(temporary, format="PNG")


def render_sheet(
    mesh: Mesh,
    path: str | Path | None = None,
    *,
    points: PointCloud | None = None,
    up: str = "z",
    layout: SheetParameters = RenderingParameters.sheet,
) -> Image:
    """Draw a contact sheet: the scan and the mesh large, and the mesh from its sides, each with a label.

    Parameters
    ----------
    mesh : Mesh
    path : path, optional
        PNG file to write; an older one is replaced.
    points : PointCloud, optional
        Left of the mesh, from the same place.
    up : str
        The axis that points upward, ``"y"`` or ``"z"``.
    layout : SheetParameters

    Returns
    -------
    array of shape (960, 1200, 3) by default, uint8

    Raises
    ------
    UsageError
        When there is nothing to draw.
    OutputError
        When the file cannot be written.
    """
    upper = render(mesh, size=(layout.width, layout.upper_height), points=points, up=up)
    lower = render(mesh, size=(layout.width, layout.lower_height), views=layout.lower_views, up=up)
    labels = [f"{len(points):,} points"] if points is not None and len(points) else []
    labels.append(f"{len(mesh.faces):,} triangles")
    sheet = np.concatenate([_labelled(upper, labels, layout), _labelled(lower, layout.lower_views, layout)])
    if path is not None:
        write_image(sheet, Path(path))
    return sheet


def _labelled(image: Image, labels: Sequence[str], layout: SheetParameters) -> Image:
    """Write a label below each of a row's panels."""
    from PIL import Image as Pillow
    from PIL import ImageDraw, ImageFont

    height = layout.label_height
    # The last line of a picture is background: no shape comes so near to the edge.
    picture = Pillow.fromarray(np.concatenate([image, image[-1:].repeat(height, axis=0)]))
    pen = ImageDraw.Draw(picture)
    font = ImageFont.load_default(layout.label_size)
    for index, label in enumerate(labels):
        place = ((2 * index + 1) * image.shape[1] // (2 * len(labels)), image.shape[0] + height / 2 - 4)
        pen.text(place, label, fill=layout.label_color, font=font, anchor="mm")
    return np.asarray(picture)

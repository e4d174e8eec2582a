"""A sheet of pictures: the scan and the mesh large, and the mesh from its sides, each with its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gnrecon.export.camera import View
from gnrecon.export.picture import Image, render, write_image
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud

SIDES: tuple[View, ...] = ("front", "right", "top")
"""The smaller pictures, from the left."""

WIDTH, TALL, LOW, FOOT = 1200, 524, 364, 36
"""Width of the sheet, heights of its rows of pictures, and of the foot below each row, in pixels."""

INK = (96, 96, 100)


def render_sheet(
    mesh: Mesh, path: str | Path | None = None, *, points: PointCloud | None = None, up: str = "z"
) -> Image:
    """Draw a mesh from four sides, and the scan that it was made from.

    Parameters
    ----------
    mesh : Mesh
    path : path, optional
        PNG file to write; an older one is replaced.
    points : PointCloud, optional
        Left of the mesh, from the same place.
    up : str
        The axis that points upward, ``"y"`` or ``"z"``.

    Returns
    -------
    array of shape (960, 1200, 3), uint8

    Raises
    ------
    UsageError
        When there is nothing to draw.
    OutputError
        When the file cannot be written.
    """
    top = render(mesh, size=(WIDTH, TALL), points=points, up=up)
    bottom = render(mesh, size=(WIDTH, LOW), views=SIDES, up=up)
    above = [f"{len(points):,} points"] if points is not None and len(points) else []
    above.append(f"{len(mesh.faces):,} triangles")
    sheet = np.concatenate([_labelled(top, above), _labelled(bottom, [str(side) for side in SIDES])])
    if path is not None:
        write_image(sheet, Path(path))
    return sheet


def _labelled(image: Image, labels: list[str]) -> Image:
    """Write a label below each of a row's panels."""
    from PIL import Image as Pillow
    from PIL import ImageDraw, ImageFont

    # The last line of a picture is paper: no shape comes so near to the edge.
    picture = Pillow.fromarray(np.concatenate([image, image[-1:].repeat(FOOT, axis=0)]))
    pen = ImageDraw.Draw(picture)
    for index, label in enumerate(labels):
        place = ((2 * index + 1) * image.shape[1] // (2 * len(labels)), image.shape[0] + FOOT / 2 - 4)
        pen.text(place, label, fill=INK, font=ImageFont.load_default(17), anchor="mm")
    return np.asarray(picture)

"""Contact sheets: a row per case; the scan, the meshes and the truth, seen from the same side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.rendering import render
from gnrecon.runtime.errors import GnreconError
from gnrecon.runtime.files import atomic_write

Pixels = np.ndarray[Any, np.dtype[np.uint8]]
Part = PointCloud | Mesh | str
"""What a panel shows: points, a mesh, or a sentence instead."""


@dataclass(frozen=True)
class Row:
    """A case: the parts to draw by their titles, the upward axis, and the view: azimuth and elevation in degrees."""

    parts: dict[str, Part]
    up: str
    view: tuple[float, float]


def draw_row(row: Row, panel: tuple[int, int] = (460, 400)) -> Pixels:
    """Return the panels of a case side by side, each of `panel` width and height in pixels below its caption."""
    return np.concatenate([_panel(title, part, row, panel) for title, part in row.parts.items()], axis=1)


def write_sheet(rows: Sequence[Pixels], path: Path) -> None:
    """Write drawn rows of equal width, one below the other, as a PNG file; an older file is replaced.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    sheet = Image.fromarray(np.concatenate(rows, axis=0))
    with atomic_write(path, overwrite=True) as temporary:
        sheet.save(temporary, format="PNG")


def _panel(title: str, part: Part, row: Row, size: tuple[int, int], *, caption_pixels: int = 32) -> Pixels:
    panel = Image.new("RGB", (size[0], size[1] + caption_pixels), "white")
    letter_pixels = min(18, size[0] // 21)
    font = ImageFont.load_default(letter_pixels)
    if not isinstance(part, str):
        part = _draw_part(part, row, size, panel, caption_pixels)
    pen = ImageDraw.Draw(panel)
    pen.multiline_text((12, caption_pixels + 8), _wrapped(part, size[0], letter_pixels), fill="gray", font=font)
    pen.text((12, 8), title, fill="black", font=font)
    return np.asarray(panel)


def _draw_part(part: PointCloud | Mesh, row: Row, size: tuple[int, int], panel: Image.Image, top: int) -> str:
    """Paste a picture below the caption; return the message where it cannot be drawn."""
    mesh, points = (part, None) if isinstance(part, Mesh) else (None, part)
    try:
        image = render(mesh, size=size, views=[row.view], points=points, up=row.up)
    except GnreconError as error:
        return str(error)
    panel.paste(Image.fromarray(image), (0, top))
    return ""


def _wrapped(sentence: str, width: int, letter_pixels: int) -> str:
    # The mean letter is 0.53 font sizes wide; the margins are 12 pixels each.
    return "\n".join(wrap(sentence, int((width - 24) / (0.53 * letter_pixels))))

"""A contact sheet: a row a case; the scan, the meshes and the truth, seen from the same side."""

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

PANEL = (460, 400)
"""Width and height of a panel, in pixels."""

CAPTION = 32
"""Height of the line above each panel, in pixels."""

LETTER = 0.53
"""Mean width of a letter, in font sizes."""

Pixels = np.ndarray[Any, np.dtype[np.uint8]]
Part = PointCloud | Mesh | str
"""What a panel shows: points, a mesh, or a sentence in their place."""


@dataclass(frozen=True)
class Row:
    """A case: what its panels show, by their titles, and from where: the upward axis, azimuth and elevation."""

    parts: dict[str, Part]
    up: str
    view: tuple[float, float]


def draw_row(row: Row, panel: tuple[int, int] = PANEL) -> Pixels:
    """Return the panels of a case side by side, each of the given width and height without its caption."""
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


def _panel(title: str, part: Part, row: Row, size: tuple[int, int]) -> Pixels:
    panel = Image.new("RGB", (size[0], size[1] + CAPTION), "white")
    letter = min(18, size[0] // 21)
    letters = ImageFont.load_default(letter)
    if not isinstance(part, str):
        part = _picture(part, row, size, panel)
    pen = ImageDraw.Draw(panel)
    pen.multiline_text((12, CAPTION + 8), _folded(part, size[0], letter), fill="gray", font=letters)
    pen.text((12, 8), title, fill="black", font=letters)
    return np.asarray(panel)


def _picture(part: PointCloud | Mesh, row: Row, size: tuple[int, int], panel: Image.Image) -> str:
    """Paste a picture below the caption; return what is to be said where it cannot be drawn."""
    mesh, points = (part, None) if isinstance(part, Mesh) else (None, part)
    try:
        image = render(mesh, size=size, views=[row.view], points=points, up=row.up)
    except GnreconError as error:
        return str(error)
    panel.paste(Image.fromarray(image), (0, CAPTION))
    return ""


def _folded(sentence: str, width: int, letter: float) -> str:
    return "\n".join(wrap(sentence, int((width - 24) / (LETTER * letter))))

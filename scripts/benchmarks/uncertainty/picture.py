"""A scan, its mesh coloured by sigma, and the same mesh coloured by its true error, over one scale of colours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from benchmarks.uncertainty.check import Check
from gnrecon.geometry.arrays import Float
from gnrecon.rendering import render
from gnrecon.runtime.files import atomic_write

PANEL = (420, 400)
"""Width and height of a panel, in pixels."""

CAPTION, BAR = 34, 64
"""Heights of the line above the panels and of the scale below them, in pixels."""

VIEW = (-55.0, 28.0)
LOWEST, HIGHEST = 1e-3, 1e-1
"""Ends of the scale, in radii."""

STOPS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]])
"""Five colours of viridis, dark to bright (van der Walt and Smith 2015)."""

Pixels = npt.NDArray[np.uint8]


def draw_picture(check: Check, path: Path) -> None:
    """Write a PNG file of three panels; an older file is replaced.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    mesh, scale = check.result.mesh, check.result.sdf.frame.scale
    drawn: list[tuple[str, Any]] = [
        (f"{len(check.scan):,} points", render(None, size=PANEL, views=[VIEW], points=check.scan))
    ]
    for title, lengths in (("sigma", check.sigma), ("true error", check.error)):
        coloured = mesh.with_attributes({"colors": colors(lengths / scale)})
        drawn.append((title, render(coloured, size=PANEL, views=[VIEW])))
    sheet = Image.new("RGB", (PANEL[0] * len(drawn), PANEL[1] + CAPTION + BAR), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(17)
    for number, (title, pixels) in enumerate(drawn):
        sheet.paste(Image.fromarray(pixels), (number * PANEL[0], CAPTION))
        pen.text((number * PANEL[0] + 12, 8), title, fill="black", font=font)
    _scale(sheet, pen)
    with atomic_write(path, overwrite=True) as temporary:
        sheet.save(temporary, format="PNG", optimize=True)


def colors(lengths: Float) -> Pixels:
    """Return sRGB bytes, of shape (N, 3), for lengths in radii, of shape (N,), on a logarithmic scale."""
    share = np.log(np.maximum(lengths, LOWEST) / LOWEST) / np.log(HIGHEST / LOWEST)
    place = np.clip(share, 0, 1) * (len(STOPS) - 1)
    return np.stack([np.interp(place, np.arange(len(STOPS)), channel) for channel in STOPS.T], axis=1).astype(np.uint8)


def _scale(sheet: Image.Image, pen: ImageDraw.ImageDraw) -> None:
    """Draw the bar of colours below the two coloured panels, with a mark a third of a decade."""
    left, width, top, font = PANEL[0] + 40, 2 * PANEL[0] - 80, PANEL[1] + CAPTION + 12, ImageFont.load_default(15)
    bar = colors(LOWEST * (HIGHEST / LOWEST) ** np.linspace(0, 1, width))
    sheet.paste(Image.fromarray(np.tile(bar, (16, 1, 1))), (left, top))
    for value in (0.001, 0.003, 0.01, 0.03, 0.1):
        x = left + width * np.log(value / LOWEST) / np.log(HIGHEST / LOWEST)
        pen.text((x, top + 20), f"{1e3 * value:g}", fill="black", font=font, anchor="ma")
    pen.text((left - 12, top + 8), "1e-3 of the radius", fill="black", font=font, anchor="rm")

"""A contact sheet: a row a case; the scan, the two meshes and the truth, seen from the same side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from benchmarks.cases import CASES, Shape
from benchmarks.trial import load_mesh, load_scan
from gnrecon.atomic import atomic_write
from gnrecon.cloud import PointCloud
from gnrecon.export import render
from gnrecon.mesh import Mesh

PANEL = (460, 400)
"""Width and height of a panel, in pixels."""

CAPTION = 32
"""Height of the line above each panel, in pixels."""


def draw_sheet(summaries: Sequence[dict[str, Any]], folder: Path, path: Path) -> None:
    """Write a PNG file of the cases whose trials, of the first seed, lie in `folder`; an older file is replaced.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    rows = [_row(summary, folder / summary["case"]) for summary in summaries]
    sheet = Image.fromarray(np.concatenate(rows, axis=0))
    with atomic_write(path, overwrite=True) as temporary:
        sheet.save(temporary, format="PNG")


def _row(summary: dict[str, Any], folder: Path) -> np.ndarray[Any, np.dtype[np.uint8]]:
    shape = CASES[summary["case"]].shape
    parts: dict[str, PointCloud | Mesh | None] = {
        f"{summary['case']}: {summary['points']:,} points": PointCloud(*load_scan(folder / "scan-0.npz"))
    }
    for method in ("gnrecon", "Poisson"):
        result = summary[method]
        failed = "error" in result
        title = f"{method}: failed" if failed else f"{method}: {1e3 * result['chamfer_mean']:.2f}e-3"
        parts[title] = None if failed else load_mesh(Path(result["folder"]) / "mesh.npz")
    parts["truth"] = load_mesh(folder / "truth.npz")
    return np.concatenate([_panel(title, part, shape) for title, part in parts.items()], axis=1)


def _panel(title: str, part: PointCloud | Mesh | None, shape: Shape) -> np.ndarray[Any, np.dtype[np.uint8]]:
    panel = Image.new("RGB", (PANEL[0], PANEL[1] + CAPTION), "white")
    if part is not None:
        mesh, points = (part, None) if isinstance(part, Mesh) else (None, part)
        image = render(mesh, size=PANEL, views=[shape.view], points=points, up=shape.up)
        panel.paste(Image.fromarray(image), (0, CAPTION))
    ImageDraw.Draw(panel).text((12, 8), title, fill="black", font=ImageFont.load_default(18))
    return np.asarray(panel)

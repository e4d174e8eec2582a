"""The paper's figures from finished experiments: loss and Chamfer over time, and surfaces coloured by curvature."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.harness.contact_sheet import Row, draw_row, write_sheet

from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.io import read_mesh
from gnrecon.rendering import render
from reproduction.experiments import Experiment

NAMES = {"gn": "Gauss-Newton", "lbfgs": "L-BFGS", "adam": "Adam"}
UP = {"bunny": "y", "bunny-sparse": "y", "rockerarm": "y"}
"""Upward axis of the pictures where it is not z."""


def draw_convergence(done: Sequence[Experiment], path: Path) -> None:
    """Write a PNG file of loss and Chamfer divergence over time, a column for each problem."""
    from matplotlib.figure import Figure

    problems = list(dict.fromkeys(one.problem for one in done))
    figure = Figure(figsize=(4.2 * len(problems), 7), layout="constrained")
    axes = figure.subplots(2, len(problems), squeeze=False)
    for column, problem in enumerate(problems):
        for one in (one for one in done if one.problem == problem):
            figures = one.figures()
            for row, quantity in enumerate(("loss", "chamfer")):
                _curve(axes[row, column], figures, quantity, NAMES[one.optimiser])
        axes[0, column].set_title(problem)
        axes[1, column].set_xlabel("seconds")
    for row, label in enumerate(("loss", "Chamfer divergence")):
        axes[row, 0].set_ylabel(label)
    axes[0, 0].legend()
    figure.savefig(path, dpi=110)


def _curve(axes: Any, figures: dict[str, Any], quantity: str, label: str) -> None:
    # What was not finite, as where the surface was lost, is null in the report, and a gap here.
    values = [np.nan if value is None else value for value in figures[f"{quantity}_history"]]
    axes.plot(figures["seconds_history"], values, label=label, marker=".")
    axes.set_yscale("log")
    axes.grid(alpha=0.3)


def draw_surfaces(
    done: Sequence[Experiment],
    folder: Path,
    *,
    size: tuple[int, int] = (700, 560),
    panel: tuple[int, int] = (460, 400),
    view: tuple[float, float] = (35.0, 25.0),
    percentile: float = 98.0,
) -> None:
    """Write a PNG file of each learned surface, coloured by its curvature, and ``surfaces.png`` of all of them.

    Blue is below zero, red above. Each surface's colours would end at a percentile of its absolute curvature; to be
    comparable, all surfaces of one problem end at the median of these. The curvature is Gauss's for the cone, and the
    mean curvature elsewhere.

    Parameters
    ----------
    size, panel : width and height of a surface's own picture and of its panel in ``surfaces.png``, in pixels
    view : azimuth and elevation in degrees
    percentile : of the absolute curvature, for the end of the colours
    """
    rows = []
    for problem in dict.fromkeys(one.problem for one in done):
        runs = [one for one in done if one.problem == problem]
        meshes = [read_mesh(one.mesh) for one in runs]
        curvature = "gauss_curvature" if problem == "cone" else "mean_curvature"
        values = [np.asarray(mesh.attributes[curvature], dtype=np.float64) for mesh in meshes]
        most = float(np.median([np.nanpercentile(np.abs(value), percentile) for value in values]))
        shown = [coloured(mesh, value, most) for mesh, value in zip(meshes, values, strict=True)]
        for one, mesh in zip(runs, shown, strict=True):
            render(mesh, one.mesh.with_suffix(".png"), size=size, views=[view], up=UP.get(problem, "z"))
        titles = [f"{problem}, {NAMES[one.optimiser]}" for one in runs]
        titles[0] += f"; full colour at {most:.0e}"
        rows.append(draw_row(Row(dict(zip(titles, shown, strict=True)), UP.get(problem, "z"), view), panel))
    write_sheet(rows, folder / "surfaces.png")


def coloured(
    mesh: Mesh,
    values: Float,
    most: float,
    *,
    low: tuple[int, int, int] = (33, 102, 172),
    middle: tuple[int, int, int] = (247, 247, 247),
    high: tuple[int, int, int] = (178, 24, 43),
) -> Mesh:
    """Return a mesh with colours of values of shape (V,), white at zero and full from `most` on.

    The sRGB colours are those of the diverging scale RdBu of ColorBrewer.
    """
    share = np.clip(np.nan_to_num(values) / max(most, np.finfo(np.float64).tiny), -1, 1)[:, None]
    ends = np.where(share < 0, low, high)
    colors = np.rint(np.array(middle) * (1 - np.abs(share)) + ends * np.abs(share))
    return mesh.with_attributes({"colors": colors.astype(np.uint8)})

"""Sigma compared with the true error: shares within two sigma, and rank correlation.

The scans are of exactly known shapes, and sparse, noisy or with holes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.table import Table
from sample_shapes import SHAPES, Shape, gradient, project
from scipy.spatial import cKDTree
from scipy.stats import spearmanr

from benchmarks.accuracy.scans import unit
from benchmarks.harness import command_line
from benchmarks.harness.contact_sheet import Part, Pixels, Row, draw_row, write_sheet
from benchmarks.harness.tables import Figure, row_table
from gnrecon.export.metrics import sample_surface
from gnrecon.geometry.arrays import Float, Mask
from gnrecon.geometry.point_cloud import Frame, PointCloud
from gnrecon.io import read_mesh
from gnrecon.pipeline import Reconstruction, reconstruct
from gnrecon.runtime.errors import ExitCode

COLUMNS = (
    Figure("points", "points"),
    Figure("within", "within 2 sigma", "{:.1%}"),
    Figure("within_near", "near data", "{:.1%}"),
    Figure("within_far", "far from it", "{:.1%}"),
    Figure("rank", "rank corr.", "{:.2f}"),
    Figure("rank_of_distance", "of distance", "{:.2f}"),
    Figure("median_sigma", "median sigma", "{:.2f}"),
    Figure("median_error", "median error", "{:.2f}"),
    Figure("factor", "factor", "{:.2f}"),
)


def main(
    arguments: Sequence[str], cases: Mapping[str, Case] | None = None, options: dict[str, Any] | None = None
) -> int:
    """Run the benchmark with arguments; return the exit code.

    Raises
    ------
    OutputError
        When a result cannot be written.
    """
    cases, options = cases or CASES, options or {"resolution": 96}
    chosen = _parser(cases).parse_args(arguments)
    command_line.require_folders(chosen.json, chosen.picture)
    report: dict[str, Any] = command_line.provenance("uncertainty", arguments) | {"options": options, "trials": []}
    for name in chosen.cases:
        for seed in range(chosen.repeat):
            print(f"bench: {name}, seed {seed}", file=sys.stderr)
            check = run(cases[name], seed, options)
            report["trials"].append({"case": name, "seed": seed} | figures(check))
            # After each one, so that an interrupted run keeps its results.
            command_line.write_report(chosen.json, report)
            if chosen.picture and (name, seed) == (chosen.pictured, 0):
                draw_picture(check, chosen.picture)
    Console(highlight=False, width=140).print(table(report["trials"]))
    return ExitCode.OK


def table(trials: Sequence[dict[str, Any]]) -> Table:
    """Return a table of the trials, a line per case, with medians over its seeds."""
    rows = []
    for name in dict.fromkeys(trial["case"] for trial in trials):
        own = [trial for trial in trials if trial["case"] == name]
        rows.append((name, *(_cell([column.value(trial) for trial in own], column.form) for column in COLUMNS)))
    caption = "Lengths in 1e-3 of the radius; medians over seeds. Rank correlations are with the error."
    return row_table(["scan", *(column.label for column in COLUMNS)], rows, caption=caption)


def _cell(values: Sequence[float | None], form: str) -> str:
    known = [value for value in values if value is not None]
    return form.format(median(known)) if known else ""


def _parser(cases: Mapping[str, Case], *, pictured: str = "bracket, holed") -> argparse.ArgumentParser:
    parser = command_line.benchmark_parser("uncertainty", __doc__)
    parser.add_argument(
        "--cases", nargs="+", choices=cases, default=list(cases), metavar="CASE", help=f"of {', '.join(cases)}"
    )
    command_line.add_repeat(parser, "scans of each case")
    command_line.add_outputs(parser, picture="draw one of the cases")
    parser.add_argument(
        "--pictured", choices=cases, default=pictured, metavar="CASE", help=f"case to draw (default: {pictured})"
    )
    return parser


@dataclass(frozen=True)
class Check:
    """A scan, its reconstruction, and the true error of each vertex, of shape (V,), in the unit of the scan."""

    scan: PointCloud
    result: Reconstruction
    error: Float

    @property
    def sigma(self) -> Float:
        """Of each vertex."""
        return np.asarray(self.result.mesh.attributes["sigma"], dtype=np.float64)

    @property
    def distance(self) -> Float:
        """From each vertex to the nearest point."""
        return np.asarray(self.result.mesh.attributes["distance"], dtype=np.float64)


def run(case: Case, seed: int, options: dict[str, Any]) -> Check:
    """Reconstruct the scan of a case."""
    scan = draw(case, seed)
    result = reconstruct(scan, uncertainty=True, attributes="distance", outliers="off", seed=seed, **options)
    return Check(scan, result, errors(case, result.mesh.vertices))


def figures(check: Check, *, far_spacings: float = 2.0) -> dict[str, Any]:
    """Return shares within two sigma, rank correlations with the error, and sizes in 1e-3 of the radius.

    Vertices farther than `far_spacings` of the points from the nearest point count as those of holes.
    """
    uncertainty = check.result.uncertainty
    assert uncertainty is not None, "the option is on"
    scale = 1e3 / check.result.sdf.frame.scale
    sigma, error = check.sigma, check.error
    far = check.distance > far_spacings * spacing(check.scan)
    stages = {stage["name"]: stage["seconds"] for stage in check.result.report["stages"]}
    return {
        "points": len(check.scan),
        "vertices": len(error),
        "within": _share(error <= 2 * sigma),
        "within_near": _share((error <= 2 * sigma)[~far]),
        "within_far": _share((error <= 2 * sigma)[far]),
        "far": _share(far),
        "rank": float(spearmanr(sigma, error).statistic),
        "rank_of_distance": float(spearmanr(check.distance, error).statistic),
        "median_sigma": scale * float(np.median(sigma)),
        "median_error": scale * float(np.median(error)),
        "factor": uncertainty.factor,
        "noise": scale * uncertainty.noise,
        "seconds": stages["attributes"],
        "seconds_of_all": sum(stages.values()),
    }


def spacing(scan: PointCloud) -> float:
    """Return the median distance from a point to its nearest neighbour."""
    return float(np.median(cKDTree(scan.points).query(scan.points, k=2)[0][:, 1]))


def _share(mask: Mask) -> float | None:
    return float(np.mean(mask)) if len(mask) else None


@dataclass(frozen=True)
class Case:
    """A scan.

    Parameters
    ----------
    shape : name in `sample_shapes.SHAPES`
    points : number, drawn uniformly by area outside the holes
    noise : standard deviation of each coordinate, in radii
    holes : balls about random places of the surface in which there are no points
    reach : radius of the balls, in radii
    """

    shape: str
    points: int
    noise: float
    holes: int = 0
    reach: float = 0.0

    @property
    def truth(self) -> Shape:
        """The shape itself."""
        return SHAPES[self.shape]


CASES = {
    "bracket, sparse": Case("bracket", 800, 0.001),
    "bracket, noisy": Case("bracket", 1500, 0.006),
    "bracket, holed": Case("bracket", 1500, 0.001, 6, 0.2),
    "bracket, sparse and holed": Case("bracket", 700, 0.0005, 6, 0.25),
    "knot, sparse": Case("knot", 700, 0.001),
    "knot, holed": Case("knot", 1500, 0.002, 6, 0.25),
}


def draw(case: Case, seed: int, *, normal_noise: float = 0.05) -> PointCloud:
    """Return the scan of a case and a seed, in millimetres.

    `normal_noise` is the standard deviation of each component of the normals before they are normalised.
    """
    rng = np.random.default_rng(seed)
    reference = read_mesh(command_line.REPOSITORY / "sample_data" / f"{case.shape}_reference.ply")
    radius = Frame.of(reference.vertices).scale
    # Twice as many, because the holes remove some.
    points = project(case.truth.distance, sample_surface(reference, 2 * case.points, rng).points)
    centres = points[rng.integers(len(points), size=case.holes)]
    away = np.linalg.norm(points[:, None] - centres, axis=2)
    points = points[(away > case.reach * radius).all(axis=1)][: case.points]
    normals = gradient(case.truth.distance, points)
    normals = unit(unit(normals) + normal_noise * rng.standard_normal(normals.shape))
    return PointCloud(points + case.noise * radius * rng.standard_normal(points.shape), normals)


def errors(case: Case, points: Float) -> Float:
    """Return how far points, of shape (N, 3), lie from the shape, in millimetres, along the gradient."""
    return np.asarray(np.linalg.norm(project(case.truth.distance, points, steps=6) - points, axis=1))


@dataclass(frozen=True)
class ColorScale:
    """A logarithmic scale of colours.

    Parameters
    ----------
    lowest, highest : lengths at its ends, in radii
    stops : sRGB colours at equal steps, here of viridis, dark to bright (van der Walt and Smith 2015)
    """

    lowest: float = 1e-3
    highest: float = 1e-1
    stops: tuple[tuple[int, int, int], ...] = (
        (68, 1, 84),
        (59, 82, 139),
        (33, 145, 140),
        (94, 201, 98),
        (253, 231, 37),
    )

    def share(self, lengths: Float) -> Float:
        """Return the place of lengths along the scale, 0 to 1 between its ends."""
        return np.asarray(np.log(lengths / self.lowest) / np.log(self.highest / self.lowest))

    def colors(self, lengths: Float) -> Pixels:
        """Return sRGB bytes, of shape (N, 3), for lengths in radii, of shape (N,)."""
        place = np.clip(self.share(np.maximum(lengths, self.lowest)), 0, 1) * (len(self.stops) - 1)
        levels = np.arange(len(self.stops))
        channels = [np.interp(place, levels, channel) for channel in np.array(self.stops).T]
        return np.stack(channels, axis=1).astype(np.uint8)


def draw_picture(check: Check, path: Path, *, panel: tuple[int, int] = (420, 400)) -> None:
    """Write a PNG file of the scan, and of its mesh coloured by sigma and by its true error; an older file is replaced.

    `panel` is the size of each picture in pixels.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    mesh, scale = check.result.mesh, check.result.sdf.frame.scale
    colors = ColorScale()
    sigma, error = (
        mesh.with_attributes({"colors": colors.colors(lengths / scale)}) for lengths in (check.sigma, check.error)
    )
    parts: dict[str, Part] = {f"{len(check.scan):,} points": check.scan, "sigma": sigma, "true error": error}
    row = draw_row(Row(parts, "z", (-55.0, 28.0)), panel)
    write_sheet([row, _draw_scale(colors, panel[0])], path)


def _draw_scale(colors: ColorScale, panel_width: int, *, height: int = 64) -> Pixels:
    """Return the bar of colours below the two coloured panels, with marks in steps of about a factor of 3."""
    sheet = Image.new("RGB", (3 * panel_width, height), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    left, width, top = panel_width + 40, 2 * panel_width - 80, 12
    bar = colors.colors(colors.lowest * (colors.highest / colors.lowest) ** np.linspace(0, 1, width))
    sheet.paste(Image.fromarray(np.tile(bar, (16, 1, 1))), (left, top))
    for value in (0.001, 0.003, 0.01, 0.03, 0.1):
        x = left + width * float(colors.share(np.array(value)))
        pen.text((x, top + 20), f"{1e3 * value:g}", fill="black", font=font, anchor="ma")
    pen.text((left - 12, top + 8), "1e-3 of the radius", fill="black", font=font, anchor="rm")
    return np.asarray(sheet)

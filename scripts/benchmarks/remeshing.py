"""Remeshing and decimation: gnrecon compared with pymeshlab and manifold3d, on the same extracted meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.accuracy.analytic_solids import FunctionField
from benchmarks.harness import command_line
from benchmarks.harness.measurement import Stopwatch
from gnrecon.export import RefineOptions, SignedDistance, extract, project, quality, refine
from gnrecon.export.boolean import centre_and_size, from_meshlab, to_meshlab
from gnrecon.export.project import face_sample_points
from gnrecon.export.remeshing.decimate import simplify_by_collapses
from gnrecon.fit import NeuralSDF
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import ExitCode

Work = Callable[[Mesh], Mesh]


def main(arguments: Sequence[str], *, cells: int = 48, model_cells: int = 128) -> int:
    """Run the benchmark with arguments; return the exit code.

    The shapes are meshed with `cells` along the box, a model with `model_cells`.

    Raises
    ------
    InputError
        When the model cannot be read.
    OutputError
        When the result cannot be written.
    """
    parser = command_line.benchmark_parser("refine", __doc__)
    parser.add_argument("--model", type=Path, metavar="FILE", help="a fitted field (.gnr) to remesh as well")
    command_line.add_outputs(parser)
    chosen = parser.parse_args(arguments)
    fields: dict[str, tuple[SignedDistance, float, int]] = {
        name: (shape, length, cells) for name, (shape, length) in SHAPES.items()
    }
    if chosen.model:
        sdf = NeuralSDF.load(chosen.model)
        fields[chosen.model.stem] = (sdf, float(np.ptp(sdf.bounds, axis=0).max()) / 60, model_cells)
    figures = [record for name, given in fields.items() for record in compare(name, *given)]
    Console(highlight=False).print(table(figures))
    command_line.write_report(chosen.json, command_line.provenance("refine", arguments) | {"figures": figures})
    return ExitCode.OK


def compare(
    name: str, field: SignedDistance, length: float, cells: int, *, decimation: int = 10
) -> list[dict[str, Any]]:
    """Return the figures of each method on one field's extracted mesh; decimation keeps a face in `decimation`."""
    mesh = project(extract(field, resolution=cells), field, steps=2)
    faces = len(mesh.faces) // decimation
    cell = float(np.ptp(field.bounds, axis=0).max()) / cells

    def ours(options: RefineOptions) -> Work:
        return lambda given: refine(given, field, options)[0]

    methods: dict[str, Work] = {
        "extracted": lambda given: given,
        "remeshed by pymeshlab": lambda given: pymeshlab_remesh(given, length),
        "remeshed by gnrecon": ours(RefineOptions(remesh=length)),
        "collapsed by pymeshlab": lambda given: pymeshlab_collapse(given, faces),
        "fewer faces by gnrecon": ours(RefineOptions(faces=faces)),
        "simplified by manifold3d": lambda given: simplify_by_collapses(given, cell / 4),
        "simplified by gnrecon": ours(RefineOptions(simplify=cell / 4)),
    }
    return [{"field": name, "method": method} | measured(work, mesh, field) for method, work in methods.items()]


def measured(work: Work, mesh: Mesh, field: SignedDistance) -> dict[str, Any]:
    """Return figures of a method's mesh: its faces, their least angles, and its distance from the zero level."""
    with Stopwatch() as watch:
        made = work(mesh)
    angles = quality(made).angle_degrees
    return {
        "faces": len(made.faces),
        "least_angle": angles["min"],
        "angle_p1": angles["p1"],
        "vertices_off": float(np.abs(field.sdf(made.vertices)).max()),
        "between_off": float(np.abs(field.sdf(face_sample_points(made.corners))).max()),
        "cpu_seconds": watch.cpu_seconds,
    }


def pymeshlab_remesh(mesh: Mesh, length: float) -> Mesh:
    """Remesh by pymeshlab's isotropic explicit remeshing, ten iterations, features of 30 degrees kept."""
    import pymeshlab

    _, size = centre_and_size(mesh)

    def work(meshes: Any) -> None:
        target = pymeshlab.PureValue(length / size)
        meshes.meshing_isotropic_explicit_remeshing(iterations=10, targetlen=target, featuredeg=30)

    return _by_pymeshlab(mesh, work)


def pymeshlab_collapse(mesh: Mesh, faces: int) -> Mesh:
    """Collapse edges by pymeshlab's quadric edge collapse, topology kept."""
    return _by_pymeshlab(
        mesh,
        lambda meshes: meshes.meshing_decimation_quadric_edge_collapse(targetfacenum=faces, preservetopology=True),
    )


def _by_pymeshlab(mesh: Mesh, work: Callable[[Any], None]) -> Mesh:
    meshes = to_meshlab(mesh)
    work(meshes)
    return from_meshlab(meshes, mesh)


def table(figures: Sequence[dict[str, Any]]) -> Table:
    """Return the figures as a table, a block per field."""
    titles = ("method", "faces", "least angle", "1st percentile", "vertices off", "between off", "CPU s")
    shown = Table(*titles, title="Distances: at most, to the zero level.")
    for number, record in enumerate(figures):
        if number == 0 or figures[number - 1]["field"] != record["field"]:
            shown.add_section()
            shown.add_row(f"[bold]{record['field']}[/bold]")
        angles = f"{record['least_angle']:.1f}", f"{record['angle_p1']:.1f}"
        off = f"{record['vertices_off']:.1e}", f"{record['between_off']:.1e}"
        shown.add_row(record["method"], f"{record['faces']:,}", *angles, *off, f"{record['cpu_seconds']:.1f}")
    return shown


def sphere(x: Float) -> Float:
    """Return the distance to a sphere of radius 0.8."""
    distance: Float = np.linalg.norm(x, axis=1) - 0.8
    return distance


def cylinder(x: Float) -> Float:
    """Return the distance, exact inside and near the faces, to a cylinder of radius 0.6 and half height 0.5."""
    around, along = np.hypot(x[:, 0], x[:, 1]) - 0.6, np.abs(x[:, 2]) - 0.5
    distance: Float = np.maximum(around, along)
    return distance


def notched(x: Float) -> Float:
    """Return the distance, likewise, to a box of half side 0.6 with a notch cut out of one of its edges."""
    box = (np.abs(x) - 0.6).max(axis=1)
    notch = np.maximum(0.1 - x[:, 0], 0.1 - x[:, 1])
    distance: Float = np.maximum(box, -notch)
    return distance


SHAPES = {
    "cylinder": (FunctionField(cylinder, step=1e-6), 0.08),
    "notched box": (FunctionField(notched, step=1e-6), 0.08),
    "sphere": (FunctionField(sphere, step=1e-6), 0.05),
}
"""Fields with the edge length to remesh them to."""

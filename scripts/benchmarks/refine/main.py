"""Remeshing and fewer faces: gnrecon beside pymeshlab's and manifold3d's own, on the same extracted meshes."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.provenance import provenance
from benchmarks.refine.shapes import SHAPES
from gnrecon.export import RefineOptions, SignedDistance, extract, project, quality, refine
from gnrecon.export.boolean import centre_and_size, from_meshlab, to_meshlab
from gnrecon.export.project import face_sample_points
from gnrecon.export.remeshing.decimate import simplify_by_collapses
from gnrecon.fit import NeuralSDF
from gnrecon.geometry.mesh import Mesh
from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.files import write_text

CELLS, MODEL_CELLS = 48, 128
FEWER = 10
"""The share of faces that decimation keeps is one in so many."""

Work = Callable[[Mesh], Mesh]


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark as the arguments say; return the exit code.

    Raises
    ------
    InputError
        When the model cannot be read.
    OutputError
        When the result cannot be written.
    """
    parser = argparse.ArgumentParser(prog="bench refine", description=__doc__)
    parser.add_argument("--model", type=Path, metavar="FILE", help="a fitted field (.gnr) to remesh as well")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers; an older file is replaced")
    chosen = parser.parse_args(arguments)
    fields: dict[str, tuple[SignedDistance, float, int]] = {
        name: (shape, length, CELLS) for name, (shape, length) in SHAPES.items()
    }
    if chosen.model:
        sdf = NeuralSDF.load(chosen.model)
        fields[chosen.model.stem] = (sdf, float(np.ptp(sdf.bounds, axis=0).max()) / 60, MODEL_CELLS)
    figures = [record for name, given in fields.items() for record in compare(name, *given)]
    Console(highlight=False).print(table(figures))
    if chosen.json:
        report = provenance("refine", arguments) | {"figures": figures}
        write_text(chosen.json, json.dumps(report, indent=2) + "\n", overwrite=True)
    return ExitCode.OK


def compare(name: str, field: SignedDistance, length: float, cells: int) -> list[dict[str, Any]]:
    """Return the figures of each method on one field's extracted mesh."""
    mesh = project(extract(field, resolution=cells), field, steps=2)
    faces = len(mesh.faces) // FEWER
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
    """Return what a method makes of a mesh: its faces, their least angles, and how far off the field it lies."""
    begin = time.process_time()
    made = work(mesh)
    seconds = time.process_time() - begin
    angles = quality(made).angle_degrees
    return {
        "faces": len(made.faces),
        "least_angle": angles["min"],
        "angle_p1": angles["p1"],
        "vertices_off": float(np.abs(field.sdf(made.vertices)).max()),
        "between_off": float(np.abs(field.sdf(face_sample_points(made.corners))).max()),
        "cpu_seconds": seconds,
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
    """Return the figures as a table."""
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

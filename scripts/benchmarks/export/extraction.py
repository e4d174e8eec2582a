"""One extraction with projection: evaluations, times and, by its process, memory."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from gnrecon.export import extract, project
from gnrecon.export.lattice import Lattice
from gnrecon.fit import NeuralSDF
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import Frame


class Counting:
    """A field that counts the points which it is asked for, of values and of gradients."""

    def __init__(self, field: NeuralSDF) -> None:
        self._field = field
        self.values = self.gradients = 0

    @property
    def frame(self) -> Frame:
        """Of the field."""
        return self._field.frame

    @property
    def bounds(self) -> Float:
        """Of the field."""
        return self._field.bounds

    def sdf(self, points: Float) -> Float:
        """Ask the field for values."""
        self.values += len(points)
        return self._field.sdf(points)

    def sdf_around(self, centers: Float, offsets: Float) -> Float:
        """Ask the field for values around centres."""
        self.values += len(centers) * len(offsets)
        return self._field.sdf_around(centers, offsets)

    def gradient(self, points: Float) -> Float:
        """Ask the field for gradients."""
        self.gradients += len(points)
        return self._field.gradient(points)


def measure(folder: str, model: str, resolution: int) -> dict[str, Any]:
    """Extract a saved field in single precision, project in its own, and return the figures.

    The whole box is searched: nothing tells where the surface is. A gradient counts as an evaluation, as a value does.
    """
    del folder
    sdf = NeuralSDF.load(model)
    field, exact = Counting(sdf.single()), Counting(sdf)
    nodes = int(np.prod(Lattice.over(sdf, resolution, None, 1).cells + 1))
    start, cpu_start = time.perf_counter(), time.process_time()
    mesh = extract(field, resolution=resolution)
    middle, cpu_middle = time.perf_counter(), time.process_time()
    mesh = project(mesh, exact, steps=2)
    end, cpu_end = time.perf_counter(), time.process_time()
    evaluations = field.values + field.gradients
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "nodes": nodes,
        "evaluations": evaluations,
        "gradients": field.gradients,
        "share": evaluations / nodes,
        "project_evaluations": exact.values + exact.gradients,
        "seconds": middle - start,
        "cpu_seconds": cpu_middle - cpu_start,
        "project_seconds": end - middle,
        "project_cpu_seconds": cpu_end - cpu_middle,
    }

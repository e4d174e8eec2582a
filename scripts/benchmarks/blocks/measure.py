"""One reconstruction of a ball in a process of its own: ``python -m benchmarks.blocks.measure FOLDER``.

The folder holds job.json (points, blocks, options); it receives the scan, the work folder, mesh.ply and figures.json.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from threading import Event, Thread
from types import TracebackType
from typing import Any, Self

import numpy as np
import psutil

from benchmarks.blocks.scan import Ball, Float
from gnrecon import NeuralSDF, read_mesh, reconstruct
from gnrecon.io import write_cloud

SAMPLES, STEP = 20_000, 1e-8
"""Places on the surface that are looked at, and how far on either side of a border, in radii."""

INTERVAL = 0.5


class TreeMemory:
    """Watches the memory of this process and those that it started, shared pages counted once (PSS), in MB of 10^6."""

    def __init__(self) -> None:
        self.own = self.largest_other = self.together = 0.0
        self._ended = Event()
        self._thread = Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        me = psutil.Process()
        while not self._ended.wait(INTERVAL):
            own, others = _pss(me), [_pss(child) for child in me.children(recursive=True)]
            self.own = max(self.own, own)
            self.largest_other = max([self.largest_other, *others])
            self.together = max(self.together, own + sum(others))


def _pss(process: psutil.Process) -> float:
    try:
        return float(process.memory_full_info().pss) / 1e6
    except psutil.Error:  # it has just ended
        return 0.0


def measure(folder: Path, points: int, blocks: bool, options: dict[str, Any]) -> dict[str, Any]:
    """Reconstruct the scan of so many points, by blocks or as its size has it, and return the figures."""
    ball, scan = Ball(points), folder / "scan.ply"
    write_cloud(ball.scan(), scan, overwrite=True)
    start, before = time.perf_counter(), _processor_seconds()
    with TreeMemory() as memory:
        result = reconstruct(scan, work_dir=str(folder / "work") if blocks else None, **options)
        result.save(folder / "mesh.ply", overwrite=True)
    seconds, cpu = time.perf_counter() - start, _processor_seconds() - before
    result.sdf.save(folder / "field.gnr", overwrite=True)
    (folder / "report.json").write_text(json.dumps(result.report), encoding="utf-8")
    mesh = read_mesh(folder / "mesh.ply")
    errors = np.abs(ball.distances(mesh.vertices))
    detail, facts = result.report["fit"]["detail"], result.report["mesh"]
    return {
        "points": points,
        "options": options,
        "seconds": seconds,
        "cpu_seconds": cpu,
        "stages": {stage["name"]: stage["seconds"] for stage in result.report["stages"]},
        "stage_cpu_seconds": {stage["name"]: stage["cpu_seconds"] for stage in result.report["stages"]},
        "memory_mb": {"own": memory.own, "worker": memory.largest_other, "together": memory.together},
        "cubes": detail["cubes"],
        "length": detail["length"],
        "cells": result.report["fineness"]["resolution"],
        "vertices": len(mesh.vertices),
        "components": facts["components"],
        "genus": facts["genus"],
        "guarantee": facts["guarantee"],
        "to_truth": {"mean": errors.mean(), "rms": np.sqrt(np.mean(errors**2)), "max": errors.max()},
        "missed": missed(result.sdf, ball),
        "jump": jump(result.sdf, mesh.vertices),
        "status": result.report["fit"]["status"],
    }


def _processor_seconds() -> float:
    """Of this process and of those that it started and that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def missed(sdf: NeuralSDF, ball: Ball) -> float:
    """Return the mean distance of the field's surface from places of the true one, in spacings."""
    exact = ball.scan(seed=2, noisy=False, count=SAMPLES).points
    value, gradient = sdf.sdf_and_gradient(exact)
    return float(np.mean(np.abs(value) / np.linalg.norm(gradient, axis=1)))


def jump(sdf: NeuralSDF, vertices: Float) -> dict[str, float]:
    """Return by how much value (in radii) and gradient jump at borders of cells near the surface, at most.

    Of the value, what its slope says of the step is no jump.
    """
    assert sdf.detail is not None
    rng, partition = np.random.default_rng(0), sdf.detail.partition
    # Where cells end, and where neighbours' weights begin and end, in cells.
    borders = (0.0, partition.overlap / 2, 1.0 - partition.overlap / 2)
    u = (sdf.frame.to_unit(vertices[rng.integers(len(vertices), size=SAMPLES)]) - partition.origin) / partition.cell
    rows, axis, border = np.arange(SAMPLES), rng.integers(3, size=SAMPLES), rng.choice(borders, SAMPLES)
    u[rows, axis] = np.round(u[rows, axis] - border) + border
    x, across = partition.origin + partition.cell * u, STEP * np.eye(3)[axis]
    (low, low_slope), (high, high_slope) = (
        sdf.sdf_and_gradient(sdf.frame.to_world(x + side)) for side in (-across, across)
    )
    change = (high - low) / sdf.frame.scale - STEP * (low_slope + high_slope)[rows, axis]
    turn = np.linalg.norm(high_slope - low_slope, axis=1)
    return {"value": float(np.abs(change).max()), "gradient": float(turn.max())}


def main(folder: Path) -> None:
    """Measure the job in a folder."""
    job = json.loads((folder / "job.json").read_text(encoding="utf-8"))
    figures = measure(folder, job["points"], job["blocks"], job["options"])
    (folder / "figures.json").write_text(json.dumps(figures, indent=2), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))

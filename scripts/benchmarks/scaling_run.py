"""One reconstruction of a rippled ball, measured in a process of its own.

The scan may have any size. It samples a ball with one point per unit square, and its true surface is known in closed
form: |x| = R + h(x / |x|), where h sums waves of lengths from twenty spacings of the points up to the radius. Each
octave is as steep as the others, as on eroded ground. A scan of more points is one of a larger ball at the same
spacing, as with a real scanner: the finest detail is as many points wide at any size, so that cost and error per point
can be compared.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from threading import Event, Thread
from types import TracebackType
from typing import Any, Self

import numpy as np
import psutil

from benchmarks.harness.measurement import Stopwatch
from gnrecon import NeuralSDF, read_mesh, reconstruct
from gnrecon.geometry.arrays import Float
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.io import write_cloud


@dataclass(frozen=True)
class Ball:
    """The true surface of a scan of about `points` points of spacing one.

    Parameters
    ----------
    points : number of points
    seed : of its waves
    finest_spacings : length of the shortest waves, in spacings
    steepness : slope of an octave's steepest places
    waves : number of waves per octave
    batch : points that are computed together
    """

    points: int
    seed: int = 0
    finest_spacings: float = 20.0
    steepness: float = 0.12
    waves: int = 6
    batch: int = 100_000

    @cached_property
    def radius(self) -> float:
        """Of the ball, in spacings."""
        return float(np.sqrt(self.points / (4 * np.pi)))

    @cached_property
    def _waves(self) -> tuple[Float, Float, Float]:
        """Wave vectors on the unit sphere, of shape (W, 3), phases and heights, of shape (W,)."""
        rng = np.random.default_rng(self.seed)
        octaves = max(1, int(np.log2(self.radius / self.finest_spacings)) + 1)
        lengths = np.repeat(self.finest_spacings * 2.0 ** np.arange(octaves), self.waves)
        axes = rng.standard_normal((len(lengths), 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        heights = self.steepness / np.sqrt(self.waves) * lengths / (2 * np.pi)
        return 2 * np.pi * self.radius / lengths[:, None] * axes, rng.uniform(0, 2 * np.pi, len(lengths)), heights

    def height(self, u: Float) -> tuple[Float, Float]:
        """Return R + h, of shape (N,), and the gradient of h, of shape (N, 3), at unit vectors of shape (N, 3)."""
        vectors, phases, heights = self._waves
        z = u @ vectors.T + phases
        return self.radius + np.sin(z) @ heights, (np.cos(z) * heights) @ vectors

    def distances(self, x: Float) -> Float:
        """Return how far points, of shape (N, 3), lie outside of the surface, to first order, of shape (N,)."""
        parts = [np.zeros(0)]
        for start in range(0, len(x), self.batch):
            value, gradient = self._implicit(x[start : start + self.batch])
            parts.append(value / np.linalg.norm(gradient, axis=1))
        return np.concatenate(parts)

    def _implicit(self, x: Float) -> tuple[Float, Float]:
        """Return |x| - R - h(x / |x|) and its gradient."""
        far = np.linalg.norm(x, axis=1, keepdims=True)
        u = x / far
        height, slope = self.height(u)
        along = np.einsum("nc,nc->n", slope, u)[:, None]
        return far[:, 0] - height, u - (slope - along * u) / far

    def scan(
        self,
        seed: int = 1,
        noisy: bool = True,
        count: int | None = None,
        *,
        position_noise: float = 0.1,
        angle_noise_degrees: float = 3.0,
    ) -> PointCloud:
        """Return random points with normals, noisy or exact; by default as many as the scan has.

        Noise is given by standard deviations: of positions along the normal, in spacings, and of normals.
        """
        rng, count = np.random.default_rng(seed), self.points if count is None else count
        points, normals = np.empty((count, 3)), np.empty((count, 3))
        for start in range(0, count, self.batch):
            rows = slice(start, min(start + self.batch, count))
            u = rng.standard_normal((rows.stop - start, 3))
            u /= np.linalg.norm(u, axis=1, keepdims=True)
            exact = u * self.height(u)[0][:, None]
            gradient = self._implicit(exact)[1]
            outward = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
            points[rows] = exact + noisy * position_noise * rng.standard_normal((len(u), 1)) * outward
            turned = outward + noisy * np.radians(angle_noise_degrees) * rng.standard_normal(u.shape)
            normals[rows] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        return PointCloud(points, normals)


class TreeMemory:
    """Peak memory of this process and its children, with shared pages counted once (PSS), in MB of 10^6."""

    def __init__(self, *, interval_seconds: float = 0.5) -> None:
        self._interval = interval_seconds
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
        while not self._ended.wait(self._interval):
            own, others = _pss(me), [_pss(child) for child in me.children(recursive=True)]
            self.own = max(self.own, own)
            self.largest_other = max([self.largest_other, *others])
            self.together = max(self.together, own + sum(others))


def _pss(process: psutil.Process) -> float:
    try:
        return float(process.memory_full_info().pss) / 1e6
    except psutil.Error:  # it has just ended
        return 0.0


def measure_blocks(folder: str, points: int, blocks: bool, options: dict[str, Any]) -> dict[str, Any]:
    """Reconstruct the scan of so many points, by blocks or by gnrecon's own choice, and return the figures."""
    ball, place = Ball(points), Path(folder)
    scan = place / "scan.ply"
    write_cloud(ball.scan(), scan, overwrite=True)
    with Stopwatch() as watch, TreeMemory() as memory:
        result = reconstruct(scan, work_dir=str(place / "work") if blocks else None, **options)
        result.save(place / "mesh.ply", overwrite=True)
    result.sdf.save(place / "field.gnr", overwrite=True)
    (place / "report.json").write_text(json.dumps(result.report), encoding="utf-8")
    mesh = read_mesh(place / "mesh.ply")
    errors = np.abs(ball.distances(mesh.vertices))
    detail, facts = result.report["fit"]["detail"], result.report["mesh"]
    return {
        "points": points,
        "options": options,
        "seconds": watch.seconds,
        "cpu_seconds": watch.cpu_seconds,
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


def missed(sdf: NeuralSDF, ball: Ball, *, samples: int = 20_000) -> float:
    """Return the mean distance of the field's surface from `samples` points of the true one, in spacings."""
    exact = ball.scan(seed=2, noisy=False, count=samples).points
    value, gradient = sdf.sdf_and_gradient(exact)
    return float(np.mean(np.abs(value) / np.linalg.norm(gradient, axis=1)))


def jump(sdf: NeuralSDF, vertices: Float, *, samples: int = 20_000, step_radii: float = 1e-8) -> dict[str, float]:
    """Return the largest jumps of value (in radii) and gradient at cell borders near the surface.

    At `samples` places, the two sides are compared `step_radii` from the border. The change of the value that follows
    from its slope is not counted.
    """
    assert sdf.detail is not None
    rng, partition = np.random.default_rng(0), sdf.detail.partition
    # Where cells end, and where neighbours' weights begin and end, in cells.
    borders = (0.0, partition.overlap / 2, 1.0 - partition.overlap / 2)
    u = (sdf.frame.to_unit(vertices[rng.integers(len(vertices), size=samples)]) - partition.origin) / partition.cell
    rows, axis, border = np.arange(samples), rng.integers(3, size=samples), rng.choice(borders, samples)
    u[rows, axis] = np.round(u[rows, axis] - border) + border
    x, across = partition.origin + partition.cell * u, step_radii * np.eye(3)[axis]
    (low, low_slope), (high, high_slope) = (
        sdf.sdf_and_gradient(sdf.frame.to_world(x + side)) for side in (-across, across)
    )
    change = (high - low) / sdf.frame.scale - step_radii * (low_slope + high_slope)[rows, axis]
    turn = np.linalg.norm(high_slope - low_slope, axis=1)
    return {"value": float(np.abs(change).max()), "gradient": float(turn.max())}

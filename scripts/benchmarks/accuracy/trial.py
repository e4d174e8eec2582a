"""One run of one method on one scan, in a process of its own.

Every trial starts a new Python (`run_trial`), so that memory and threads are clean. It is confined to a few processors,
loads the method's libraries, times the method, notes the peak memory, and only then reads the truth and measures the
mesh (`measure_trial`).
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.accuracy.methods import METHODS
from benchmarks.accuracy.problem import load_mesh, load_scan, load_truth, save_mesh
from benchmarks.harness.measurement import Stopwatch, run_isolated
from gnrecon.export import measure, verify
from gnrecon.export.metrics import sample_surface
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.errors import MeshError
from gnrecon.runtime.memory import process_peak_mb


@dataclass(frozen=True)
class Job:
    """The task of a trial.

    Parameters
    ----------
    method : name in `METHODS`
    scan, truth : files that `save_scan` and `save_truth` wrote
    threads : processors and threads to use
    samples : samples on each surface for measuring
    settings : keyword arguments of the method
    surface_samples : samples on each surface for distances between samples; 0 for none
    lid : file of the faces that close the truth, which `save_mesh` wrote; None where the truth has no lid
    """

    method: str
    scan: str
    truth: str
    threads: int
    samples: int
    settings: dict[str, Any] = field(default_factory=dict)
    surface_samples: int = 0
    lid: str | None = None


def run_trial(job: Job, folder: Path, limit_seconds: float | None = None) -> dict[str, Any]:
    """Run a job in a new process within a new `folder`, and return its figures, in units of the truth.

    A failure of the method, an empty mesh, and a run of more than `limit_seconds` are results too: the sentence under
    ``"error"`` then replaces the figures.
    """
    arguments = asdict(job) | {"folder": str(folder)}
    call = "benchmarks.accuracy.trial:measure_trial"
    return run_isolated(call, arguments, folder, threads=job.threads, limit_seconds=limit_seconds)


def measure_trial(folder: str, **arguments: Any) -> dict[str, Any]:
    """Do a job, leaving mesh.npz in `folder`, and return its figures.

    Raises
    ------
    MeshError
        When the mesh is empty.
    """
    job = Job(**arguments)
    # Thread pools other than OpenMP's (TBB) go by the processors that the process may use; macOS cannot limit them.
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: job.threads])
    points, normals = load_scan(Path(job.scan))
    method = METHODS[job.method]()
    libraries_mb = process_peak_mb()
    with Stopwatch() as watch:
        mesh, details = method(points, normals, **job.settings)
    figures = {"seconds": watch.seconds, "cpu_seconds": watch.cpu_seconds}
    figures |= {"peak_memory_mb": process_peak_mb(), "libraries_memory_mb": libraries_mb}
    if not len(mesh.faces):
        raise MeshError("The mesh is empty.")
    save_mesh(mesh, Path(folder) / "mesh.npz")
    return figures | _distances(mesh, load_truth(Path(job.truth)), job) | verify(mesh).as_dict() | details


def _distances(mesh: Mesh, truth: Mesh | PointCloud, job: Job) -> dict[str, Any]:
    lid = None if job.lid is None else load_mesh(Path(job.lid))
    figures = measure(mesh, truth, samples=job.samples, lid=lid).as_dict()
    if job.surface_samples and isinstance(truth, Mesh):
        figures |= between_samples(mesh, truth, job.surface_samples)
    return figures


def between_samples(mesh: Mesh, truth: Mesh, count: int, seed: int = 0) -> dict[str, float]:
    """Return ``samples_chamfer`` and ``samples_hausdorff`` of `count` samples per surface, in the meshes' unit.

    They are defined as in the published figures of the Surface Reconstruction Benchmark (Ben-Shabat et al. 2022,
    DiGS): points are drawn on both surfaces, uniform by area, and each is measured to the nearest point of the other
    set. Chamfer is half the sum of the two mean distances, Hausdorff the largest distance, both ways. A distance to
    samples is never smaller than one to the surface: near zero it levels off at a share of their spacing.
    """
    rng = np.random.default_rng(seed)
    ours, theirs = (sample_surface(surface, count, rng).points for surface in (mesh, truth))
    there, back = cKDTree(ours).query(theirs)[0], cKDTree(theirs).query(ours)[0]
    return {
        "samples_chamfer": float(there.mean() + back.mean()) / 2,
        "samples_hausdorff": float(max(there.max(), back.max())),
    }

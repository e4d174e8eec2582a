"""One run of one method on one scan, in a process of its own.

So that memory and threads are clean, every trial starts a new Python (`run_trial`), which is confined to a few
processors, loads the method's libraries, times the method, notes the peak memory until then, and only afterwards reads
the truth and measures the mesh (`main`). The two sides meet in a folder: the job and the arrays go in, the mesh and
the figures come out.
"""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.alone import run_program
from benchmarks.arrays import load_scan, load_truth, save_mesh
from benchmarks.methods import METHODS
from benchmarks.samples_apart import between_samples
from gnrecon.export import measure, verify
from gnrecon.geometry.mesh import Mesh
from gnrecon.geometry.point_cloud import PointCloud
from gnrecon.runtime.errors import GnreconError, MeshError
from gnrecon.runtime.memory import process_peak_mb


@dataclass(frozen=True)
class Job:
    """What a trial does.

    Parameters
    ----------
    method : name in `METHODS`
    scan, truth : files that `arrays.save_scan` and `arrays.save_truth` wrote
    threads : processors and threads to use
    samples : samples on each surface for measuring
    settings : keyword arguments of the method
    samples_apart : samples on each surface for distances from sample to sample; 0 for none
    """

    method: str
    scan: str
    truth: str
    threads: int
    samples: int
    settings: dict[str, Any] = field(default_factory=dict)
    samples_apart: int = 0


def run_trial(job: Job, folder: Path, limit: float | None = None) -> dict[str, Any]:
    """Run a job in a new process within a new `folder`, and return its figures, in units of the truth.

    A failure of the method is a result too: the sentence under ``"error"`` then takes the figures' place. So is an
    empty mesh, and a run that takes more than `limit` seconds.
    """
    return run_program("benchmarks.trial", asdict(job), job.threads, folder, limit)


def main(folder: Path) -> None:
    """Do the job in `folder`, leaving mesh.npz and figures.json there."""
    job = Job(**json.loads((folder / "job.json").read_text(encoding="utf-8")))
    # Thread pools other than OpenMP's (TBB) go by the processors that the process may use; macOS cannot limit them.
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: job.threads])
    points, normals = load_scan(Path(job.scan))
    method = METHODS[job.method]()
    memory_before = process_peak_mb()
    start = time.perf_counter()
    mesh, details = method(points, normals, **job.settings)
    figures: dict[str, Any] = {
        "seconds": time.perf_counter() - start,
        "peak_memory_mb": process_peak_mb(),
        "libraries_memory_mb": memory_before,
    }
    if not len(mesh.faces):
        raise MeshError("The mesh is empty.")
    save_mesh(mesh, folder / "mesh.npz")
    figures |= _compared(mesh, load_truth(Path(job.truth)), job) | verify(mesh).as_dict() | details
    (folder / "figures.json").write_text(json.dumps(figures), encoding="utf-8")


def _compared(mesh: Mesh, truth: Mesh | PointCloud, job: Job) -> dict[str, Any]:
    figures = measure(mesh, truth, samples=job.samples).as_dict()
    if job.samples_apart and isinstance(truth, Mesh):
        figures |= between_samples(mesh, truth, job.samples_apart)
    return figures


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]))
    except GnreconError as error:
        sys.exit(str(error))

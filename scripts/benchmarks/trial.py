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

import numpy as np

from benchmarks.alone import run_program
from benchmarks.methods import METHODS
from gnrecon.cloud import Float
from gnrecon.errors import GnreconError
from gnrecon.export import measure, verify
from gnrecon.memory import process_peak_mb
from gnrecon.mesh import Mesh


@dataclass(frozen=True)
class Job:
    """What a trial does.

    Parameters
    ----------
    method : name in `METHODS`
    scan, truth : files of the arrays points and normals, and of vertices and faces (.npz)
    threads : processors and threads to use
    samples : samples on each surface for measuring
    settings : keyword arguments of the method
    """

    method: str
    scan: str
    truth: str
    threads: int
    samples: int
    settings: dict[str, Any] = field(default_factory=dict)


def run_trial(job: Job, folder: Path) -> dict[str, Any]:
    """Run a job in a new process within an empty `folder`, and return its figures, in units of the truth.

    A failure of the method is a result too: the sentence under ``"error"`` then takes the figures' place.
    """
    return run_program("benchmarks.trial", asdict(job), job.threads, folder)


def load_mesh(path: Path) -> Mesh:
    """Return a mesh that `save_mesh` wrote."""
    with np.load(path) as arrays:
        return Mesh(arrays["vertices"], arrays["faces"])


def save_mesh(mesh: Mesh, path: Path) -> None:
    """Write vertices and faces as they are (.npz)."""
    np.savez(path, vertices=mesh.vertices, faces=mesh.faces)


def load_scan(path: Path) -> tuple[Float, Float]:
    """Return the points and normals that `save_scan` wrote."""
    with np.load(path) as arrays:
        return arrays["points"], arrays["normals"]


def save_scan(points: Float, normals: Float, path: Path) -> None:
    """Write the points and normals of a scan as they are (.npz)."""
    np.savez(path, points=points, normals=normals)


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
    save_mesh(mesh, folder / "mesh.npz")
    figures |= (
        measure(mesh, load_mesh(Path(job.truth)), samples=job.samples).as_dict() | verify(mesh).as_dict() | details
    )
    (folder / "figures.json").write_text(json.dumps(figures), encoding="utf-8")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]))
    except GnreconError as error:
        sys.exit(str(error))

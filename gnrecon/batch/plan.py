"""From what was asked for to the jobs that are to be done; what is wrong with the whole is said before any work."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gnrecon.batch.find import Search, find_scans
from gnrecon.batch.job import Job
from gnrecon.batch.naming import named
from gnrecon.batch.request import Request
from gnrecon.errors import UsageError
from gnrecon.options import Options

THREADS = 1
"""Of a job that is not told otherwise: several scans at a time use the cores better than several threads for one do."""


def plan(request: Request) -> list[Job]:
    """Return the jobs of a batch, in the order of their scans.

    The number of threads is one of each job's options, whatever the machine, because sums in another order may round
    otherwise: so a batch that is resumed, or run with more jobs at a time, makes the same bytes.

    Raises
    ------
    InputError
        When a source is missing, or there is no scan.
    UsageError
        When options, names or formats make no sense.
    """
    search = Search(request.patterns, request.recursive, request.output)
    found = find_scans(request.sources, request.lists, search)
    names = named(found, request.name)
    options = Options.of(**{"threads": THREADS, **request.options}).as_dict()
    jobs = [
        Job(
            name,
            one.scan,
            request.output,
            options,
            mesh_format=request.mesh_format,
            kinds=request.kinds,
            limits=request.limits,
            retry=request.retry,
            overwrite=request.overwrite,
            fresh=request.fresh,
        )
        for one, name in zip(found, names, strict=True)
    ]
    _require_harmless(jobs, [one.scan for one in found])
    return jobs


def _require_harmless(jobs: Sequence[Job], scans: Sequence[Path]) -> None:
    """Refuse outputs that are inputs."""
    inputs = {path.resolve() for path in scans}
    for job in jobs:
        for name in job.file_names().values():
            if (job.output / name).resolve() in inputs:
                raise UsageError(f"{job.output / name} is a scan itself; choose another folder for the meshes.")

"""From what was asked for to the jobs that are to be done; what is wrong with the whole is said before any work."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from gnrecon.batch.job import Job, Limits
from gnrecon.batch.request import Request
from gnrecon.batch.scan_search import Found, Search, find_scans, named, reference_of
from gnrecon.config import settings_text
from gnrecon.io import all_members
from gnrecon.options import Options
from gnrecon.runtime.errors import UsageError

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
    pairs = [reference_of(one, index, request) for index, one in enumerate(found, 1)]
    if request.references is not None and not any(pairs):
        raise UsageError(f"None of the scans has a reference in {request.references}; see --reference-name.")
    jobs = [_job(request, one, name, reference) for one, name, reference in zip(found, names, pairs, strict=True)]
    _require_harmless(jobs, [*request.lists, *([config] if (config := request.settings.source) else [])])
    return jobs


def _job(request: Request, found: Found, name: str, paired: Path | None) -> Job:
    values = request.settings.of(found.scan)
    reference = values.pop("reference", None) or paired
    timeout, memory = values.pop("timeout", None), values.pop("memory", None)
    if values.get("work_dir"):  # a work folder is of one scan
        values["work_dir"] = str(Path(values["work_dir"]) / name)
    options = Options.of(**{"threads": THREADS, **values}).as_dict()
    return Job(
        name,
        found.scan,
        request.output,
        options,
        mesh_format=request.mesh_format,
        kinds=(*request.kinds, "config"),
        reference=reference,
        config=settings_text({**options, "reference": reference}, found.scan),
        limits=Limits(
            None if timeout is None else parse_seconds(timeout), None if memory is None else parse_megabytes(memory)
        ),
        retry=request.retry,
        overwrite=request.overwrite,
        fresh=request.fresh,
    )


def _require_harmless(jobs: Sequence[Job], others: Sequence[Path]) -> None:
    """Refuse outputs that are inputs: scans, files that scans name, references, or the `others`."""
    read = [path for job in jobs for path in (job.scan, job.reference) if path is not None]
    inputs = {path.resolve() for path in [*all_members(read), *others]}
    for job in jobs:
        for name in job.file_names().values():
            if (job.output / name).resolve() in inputs:
                raise UsageError(f"{job.output / name} is an input of the batch; choose another folder for the meshes.")


SECONDS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86400.0}

MEGABYTES = {"kb": 1e-3, "mb": 1.0, "gb": 1e3, "tb": 1e6, "kib": 2**10 / 1e6, "mib": 2**20 / 1e6, "gib": 2**30 / 1e6}

_QUANTITY = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*([a-z]*)\s*", re.IGNORECASE)


# Times and amounts of memory as people write them.
def parse_seconds(text: str) -> float:
    """Return a positive time in seconds, from text such as ``90``, ``30s``, ``10m`` or ``1.5h``.

    Raises
    ------
    UsageError
        When it is none.
    """
    return _parsed(text, SECONDS, "time such as 90, 30s, 10m or 2h")


def parse_megabytes(text: str) -> float:
    """Return a positive amount of memory in MB of 10^6 bytes, from text such as ``800MB`` or ``4GB``.

    Raises
    ------
    UsageError
        When it is none.
    """
    return _parsed(text, MEGABYTES, "amount of memory such as 800MB, 4GB or 2GiB")


def _parsed(text: str, units: dict[str, float], expected: str) -> float:
    match = _QUANTITY.fullmatch(text)
    unit = None if match is None else units.get(match[2].lower())
    if match is None or unit is None or float(match[1]) <= 0:
        raise UsageError(f"{text!r} is no {expected}.")
    return float(match[1]) * unit

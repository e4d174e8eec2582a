"""Plans a batch: turns a request into jobs, and reports errors that concern the whole batch before any work starts."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from gnrecon.batch.job import SUMMARY_FILES, Job, Limits
from gnrecon.batch.request import Request
from gnrecon.batch.scan_search import FoundScan, ScanSearch, find_scans, output_names, reference_of
from gnrecon.config import settings_text
from gnrecon.io import all_input_files
from gnrecon.options import Options
from gnrecon.runtime.errors import UsageError
from gnrecon.runtime.typed_values import parse_megabytes, parse_seconds


def plan(request: Request) -> list[Job]:
    """Return the jobs of a batch, in the order of their scans.

    The number of threads is one of each job's options, whatever the machine, because sums in another order may round
    differently. A batch that is resumed, or run with more jobs at a time, therefore makes the same bytes.

    Raises
    ------
    InputError
        When a source is missing, or there is no scan.
    UsageError
        When options, names or formats are invalid.
    """
    search = ScanSearch(request.patterns, request.recursive, request.output)
    found = find_scans(request.sources, request.lists, search)
    names = output_names(found, request.name)
    references = [reference_of(scan, index, request) for index, scan in enumerate(found, 1)]
    if request.references is not None and not any(references):
        raise UsageError(f"None of the scans has a reference in {request.references}; see --reference-name.")
    jobs = [_job(request, *planned) for planned in zip(found, names, references, strict=True)]
    _require_distinct_from_inputs(jobs, [*request.lists, *([config] if (config := request.settings.source) else [])])
    return jobs


def _job(request: Request, found: FoundScan, name: str, paired: Path | None) -> Job:
    values = request.settings.of(found.scan)
    reference = values.pop("reference", None) or paired
    timeout, memory = values.pop("timeout", None), values.pop("memory", None)
    if values.get("work_dir"):  # each scan needs a work folder of its own
        values["work_dir"] = str(Path(values["work_dir"]) / name)
    # By default one thread for each job: several scans at a time use the cores better than several threads for one.
    options = Options.of(**{"threads": 1, **values}).as_dict()
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


def _require_distinct_from_inputs(jobs: Sequence[Job], others: Sequence[Path]) -> None:
    """Refuse outputs, the summary included, that are inputs: scans, files that scans name, references, or the `others`.

    A scan's output must not have the name of a file of the summary, either.
    """
    read = [path for job in jobs for path in (job.scan, job.reference) if path is not None]
    inputs = {identity for path in [*all_input_files(read), *others] for identity in _identities(path)}
    summary = {name: jobs[0].output / name for name in SUMMARY_FILES} if jobs else {}
    for job in jobs:
        for name in job.file_names().values():
            if name.casefold() in summary:
                raise UsageError(f"{name} would be an output of {job.scan} and the batch's summary; choose --name.")
            if inputs & _identities(job.output / name):
                raise UsageError(f"{job.output / name} is an input of the batch; choose another folder for the meshes.")
    for path in summary.values():
        if inputs & _identities(path):
            raise UsageError(f"{path} is an input of the batch, whose summary has that name; choose another folder.")


def _identities(path: Path) -> set[str | tuple[int, int]]:
    """What tells one file from others: links, relative paths and letters of either case may lead to the same one."""
    name = os.path.realpath(path)
    try:
        status = path.stat()
    except OSError:  # it does not exist yet
        return {name}
    return {name, (status.st_dev, status.st_ino)}

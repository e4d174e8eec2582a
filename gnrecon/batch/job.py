"""A batch job: one scan to reconstruct, the record of its result and its outcome, all as plain values.

Plain values can be sent to any process on any machine. A `JobRecord` lies in the output folder and lets a batch that is
started again skip what is done already.
"""

from __future__ import annotations

import enum
import hashlib
import json
import signal
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

from gnrecon.io import all_input_files
from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.files import write_text
from gnrecon.version import __version__

FILE_ENDINGS = {
    "mesh": ".{mesh_format}",
    "report": ".report.json",
    "page": ".html",
    "preview": ".preview.png",
    "model": ".gnr",
    "config": ".config.toml",
}
"""Kinds of output files, and what each adds to the name of a scan's outputs."""

SUMMARY_FILES = ("summary.json", "summary.csv", "summary.html")
"""Files of the summary in a batch's output folder: of all figures, of a table, and to look at."""

MESH_FIGURES = ("vertices", "faces", "components", "genus", "closed", "area", "volume", "invented_area_share")
"""Entries of a report's ``mesh`` that a table of many runs shows."""


class Stop(Protocol):
    """Says whether work should end now, as `threading.Event` does."""

    def is_set(self) -> bool:
        """Whether work should end."""


@dataclass(frozen=True)
class Limits:
    """Limits of one attempt at a scan.

    Parameters
    ----------
    seconds : of time, or None
    memory_mb : of resident memory of all its processes together, in MB of 10^6 bytes, or None
    """

    seconds: float | None = None
    memory_mb: float | None = None


@dataclass(frozen=True)
class Job:
    """One scan to be reconstructed.

    Parameters
    ----------
    name : of the outputs, relative to `output` and without an extension, such as ``"rooms/kitchen"``
    scan : file to read
    output : folder of the batch's outputs
    options : fields of `gnrecon.options.Options`; `threads` is a number
    mesh_format : extension of the mesh, without the dot
    kinds : kinds of files to write in addition to the mesh, of `FILE_ENDINGS`
    reference : ground truth to measure the mesh against
    config : text of a configuration that makes the same mesh, written next to it
    limits : of each attempt
    retry : how often a transient failure is tried again
    overwrite : whether files that no record of this folder knows may be replaced
    fresh : whether the work is done again even where nothing has changed
    """

    name: str
    scan: Path
    output: Path
    options: Mapping[str, Any]
    mesh_format: str = "obj"
    kinds: tuple[str, ...] = ()
    reference: Path | None = None
    config: str = ""
    limits: Limits = field(default_factory=Limits)
    retry: int = 0
    overwrite: bool = False
    fresh: bool = False

    def file_names(self) -> dict[str, str]:
        """Return the path of each kind of file to write, relative to the output folder."""
        return {
            kind: self.name + ending.format(mesh_format=self.mesh_format)
            for kind, ending in FILE_ENDINGS.items()
            if kind in ("mesh", *self.kinds)
        }

    def record(self) -> Path:
        """Return the path of the record of finished work."""
        return records_folder(self.output) / f"{self.name}.json"

    def log(self) -> Path:
        """Return the path of the last attempt's log."""
        return state_folder(self.output) / "logs" / f"{self.name}.log"

    def thumbnail(self) -> Path:
        """Return the path of a small picture of the mesh."""
        return state_folder(self.output) / "thumbnails" / f"{self.name}.png"


def state_folder(output: Path) -> Path:
    """Return the folder for records, logs, thumbnails and running attempts, within the output folder."""
    return output / ".gnrecon"


def records_folder(output: Path) -> Path:
    """Return the folder of the records of finished work."""
    return state_folder(output) / "records"


def running_folder(output: Path) -> Path:
    """Return the folder in which each running attempt has a folder of its own."""
    return state_folder(output) / "running"


def progress_file(folder: Path) -> Path:
    """Return the file in an attempt's folder that states its progress."""
    return folder / "progress.json"


def failure_file(folder: Path) -> Path:
    """Return the file in an attempt's folder that holds the sentence on its failure."""
    return folder / "failure.txt"


def identity_of(job: Job) -> dict[str, Any]:
    """Return everything that a job's result depends on, as plain values; equal identities give equal results.

    Raises
    ------
    OSError
        When a file cannot be read.
    """
    reference = [] if job.reference is None else all_input_files([job.reference])
    return {
        "version": __version__,
        "inputs": {str(path.name): file_hash(path) for path in all_input_files([job.scan])},
        "reference": [file_hash(path) for path in reference],
        # Through JSON, so that it compares equal to what is read back from a record.
        "options": json.loads(json.dumps(dict(job.options))),
        "files": job.file_names(),
    }


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal digits.

    Raises
    ------
    OSError
        When it cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_if_exists(path: Path) -> str | None:
    """Return the hash of a file's bytes, or None where there is no such file."""
    try:
        return file_hash(path)
    except OSError:
        return None


# A record is written after a result was verified and hashed, and before its files are moved into place. At whatever
# moment a batch is killed, the files of a record are therefore either in place or still in the attempt's folder, from
# where the next start moves them. And every file in place is either known to a record, as its result or as what it was
# about to replace, or was not written by the batch.


@dataclass(frozen=True)
class JobRecord:
    """Record of finished work.

    Parameters
    ----------
    identity : what it depends on, as of `identity_of`
    outputs : hash of each file of the result, by its path relative to the output folder
    replaced : hash of each file that this result was to replace
    staged : folder that holds the files until they are moved into place, relative to the output folder
    facts : further fields of the `JobOutcome`, such as its figures
    """

    identity: Mapping[str, Any]
    outputs: Mapping[str, str]
    replaced: Mapping[str, str]
    staged: str
    facts: Mapping[str, Any]

    def is_current(self, identity: Mapping[str, Any], folder: Path) -> bool:
        """Whether this is the result of the same work, and its files exist as they were written."""
        return identity == self.identity and all(
            hash_if_exists(folder / name) == known for name, known in self.outputs.items()
        )

    def knows(self, name: str, content_hash: str) -> bool:
        """Whether a file of this name and hash was written by the batch."""
        return content_hash in (self.outputs.get(name), self.replaced.get(name))

    def move_into_place(self, folder: Path) -> None:
        """Move the files that are still in the attempt's folder to their final names."""
        for name, known in self.outputs.items():
            if hash_if_exists(folder / self.staged / name) == known:
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / self.staged / name).replace(folder / name)

    def write(self, path: Path) -> None:
        """Write the record atomically; an older one is replaced.

        Raises
        ------
        OutputError
            When it cannot be written.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(asdict(self), indent=2) + "\n", overwrite=True)


def read_record(path: Path) -> JobRecord | None:
    """Return the record in a file; None where there is no valid one."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if "told" in values:  # how earlier versions named the field
            values["facts"] = values.pop("told")
        return JobRecord(**values)
    except (OSError, ValueError, TypeError):
        return None


def all_records(output: Path) -> list[JobRecord]:
    """Return the records in an output folder; hidden files are incomplete ones."""
    files = sorted(records_folder(output).rglob("*.json"))
    records = [read_record(path) for path in files if not path.name.startswith(".")]
    return [record for record in records if record is not None]


class Status(enum.StrEnum):
    """Result of a scan."""

    MADE = "made"
    UNCHANGED = "unchanged"
    FAILED = "failed"


class Cause(enum.StrEnum):
    """Why a scan failed; each is a group of the summary. Names are those of `ExitCode` where it has such a code."""

    INPUT = "input"
    USAGE = "usage"
    FIT = "fit"
    MESH = "mesh"
    OUTPUT = "output"
    MEMORY = "memory"
    TIMEOUT = "timeout"
    SIGNAL = "signal"
    UNFORESEEN = "unforeseen"
    INTERRUPTED = "interrupted"

    @property
    def is_transient(self) -> bool:
        """Whether another attempt may succeed; other causes depend only on the scan and the options."""
        return self in (Cause.OUTPUT, Cause.MEMORY, Cause.TIMEOUT, Cause.SIGNAL, Cause.UNFORESEEN)


@dataclass(frozen=True)
class JobOutcome:
    """What happened to one scan.

    Parameters
    ----------
    name : of its outputs, relative to the output folder and without an extension
    scan : path
    status : Status
    cause : why it failed, or None
    message : one sentence on the failure, or nothing
    exit_code : of its process; negative for a signal, None where it was killed for taking too long
    files : path of each kind of file that was written, of `FILE_ENDINGS`
    thumbnail, log : paths; empty where there is none
    attempts : number of attempts in this batch
    seconds : from the first attempt to the end of the last one
    peak_memory_mb : greatest resident memory of its process, in MB of 10^6 bytes; None where nothing was run
    figures : properties of the mesh, see `figures_of`
    metrics : distances to the reference, where there is one
    """

    name: str
    scan: str
    status: Status
    cause: Cause | None = None
    message: str = ""
    exit_code: int | None = 0
    files: Mapping[str, str] = field(default_factory=dict)
    thumbnail: str = ""
    log: str = ""
    attempts: int = 0
    seconds: float = 0.0
    peak_memory_mb: float | None = None
    figures: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, Any] | None = None

    @property
    def failed(self) -> bool:
        """Whether there is no mesh of this scan."""
        return self.status == Status.FAILED

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain values, with an entry for every kind of file."""
        values = asdict(self)
        files = values.pop("files")
        return {**values, **{kind: files.get(kind, "") for kind in FILE_ENDINGS}}


def cause_of(exit_code: int) -> Cause | None:
    """Return the cause of failure for an exit code; None for success."""
    if exit_code == ExitCode.OK:
        return None
    if exit_code < 0:
        return Cause.SIGNAL
    name = ExitCode(exit_code).name if exit_code in list(ExitCode) else ""
    return Cause.__members__.get(name, Cause.UNFORESEEN)


def describe_signal(number: int) -> str:
    """Return a sentence on a process that was killed by a signal."""
    name = signal.Signals(number).name if number in list(signal.Signals) else f"signal {number}"
    hint = " Perhaps the system was out of memory." if number == signal.SIGKILL else ""
    return f"Killed by {name}.{hint}"


def figures_of(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of a run's report that a table of many runs shows."""
    mesh = report["mesh"]
    return {"points": report["ingest"]["kept"], **{name: mesh[name] for name in MESH_FIGURES}}

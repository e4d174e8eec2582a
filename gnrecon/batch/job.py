"""One scan of a batch as a piece of work: plain values, so that any process on any machine can take it over."""

from __future__ import annotations

import enum
import hashlib
import json
import signal
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

from gnrecon.io.merge import members
from gnrecon.runtime.errors import ExitCode
from gnrecon.runtime.files import write_text
from gnrecon.version import __version__

STATE = ".gnrecon"
"""Folder within the output folder: records, logs, thumbnails and what is being worked at."""

PROGRESS, FAILURE = "progress.json", "failure.txt"
"""Files in an attempt's folder: how far it is, and the sentence on its failure."""


class Stop(Protocol):
    """Tells whether work is to end now, as `threading.Event` does."""

    def is_set(self) -> bool:
        """Whether it is to end."""


@dataclass(frozen=True)
class Limits:
    """What one attempt at a scan may take.

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
    kinds : of files that are wanted beside the mesh, of `gnrecon.batch.job.FILES`
    reference : truth to measure the mesh against
    config : text of a configuration that makes the same mesh, for the file beside it
    limits : of each attempt
    retry : how often a failure that may pass is tried again
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
        """Return the path of each wanted kind of file, relative to the output folder."""
        endings = {
            "mesh": f".{self.mesh_format}",
            "report": ".report.json",
            "page": ".html",
            "preview": ".preview.png",
            "model": ".gnr",
            "config": ".config.toml",
        }
        return {kind: self.name + ending for kind, ending in endings.items() if kind in ("mesh", *self.kinds)}

    def record(self) -> Path:
        """Return where the record of finished work lies."""
        return self.output / STATE / "records" / f"{self.name}.json"

    def log(self) -> Path:
        """Return where the last attempt's words lie."""
        return self.output / STATE / "logs" / f"{self.name}.log"

    def thumbnail(self) -> Path:
        """Return where a small picture of the mesh lies."""
        return self.output / STATE / "thumbnails" / f"{self.name}.png"


def running_folder(output: Path) -> Path:
    """Return the folder in which each attempt has a folder of its own while it runs."""
    return output / STATE / "running"


# What a result depends on, as one hash: the bytes that are read, the options, the wanted files and the version.


def identity_of(job: Job) -> dict[str, Any]:
    """Return what a job's result depends on, as plain values; equal ones make equal results.

    Raises
    ------
    OSError
        When a file cannot be read.
    """
    reference = [] if job.reference is None else members(job.reference)
    return {
        "version": __version__,
        "inputs": {str(path.name): file_hash(path) for path in members(job.scan)},
        "reference": [file_hash(path) for path in reference],
        # As JSON has it, so that what was read back from a record compares equal.
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


def hash_if_there(path: Path) -> str | None:
    """Return the hash of a file's bytes, or None where there is no such file."""
    try:
        return file_hash(path)
    except OSError:
        return None


# The record of a finished scan: by it a batch that is started again knows what need not be done twice.
#
# A record is written when a result was verified and hashed, and before its files receive their names. So at whatever
# moment a batch is killed, what a record tells of is either in place, or in the attempt's folder, from where the next
# start brings it; and a file that is there is either known to a record, as the result or as what it was about to
# replace, or somebody else's.


@dataclass(frozen=True)
class Record:
    """Finished work.

    Parameters
    ----------
    identity : what it depends on, as of `identity_of`
    outputs : hash of each file of the result, by its path relative to the output folder
    replaced : hash of each file that this result was to replace
    staged : folder that holds the files until they receive their names, relative to the output folder
    told : what is told of it beside its files, fields of `Outcome`
    """

    identity: Mapping[str, Any]
    outputs: Mapping[str, str]
    replaced: Mapping[str, str]
    staged: str
    told: Mapping[str, Any]

    def holds(self, identity: Mapping[str, Any], folder: Path) -> bool:
        """Whether the same work was asked for, and its files are there as they were written."""
        return identity == self.identity and all(
            hash_if_there(folder / name) == known for name, known in self.outputs.items()
        )

    def knows(self, name: str, found: str) -> bool:
        """Whether a file of this name and hash is one of the batch's own."""
        return found in (self.outputs.get(name), self.replaced.get(name))

    def place(self, folder: Path) -> None:
        """Let the files that still wait in the attempt's folder have their names."""
        for name, known in self.outputs.items():
            if hash_if_there(folder / self.staged / name) == known:
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


def read_record(path: Path) -> Record | None:
    """Return the record in a file; None where there is none, or what is there is none."""
    try:
        return Record(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def all_records(folder: Path) -> list[Record]:
    """Return the records below a folder; a hidden file is one that was not yet written to its end."""
    records = [read_record(path) for path in sorted(folder.rglob("*.json")) if not path.name.startswith(".")]
    return [record for record in records if record is not None]


# What became of one scan of a batch, and by which cause where it failed.


class Status(enum.StrEnum):
    """What was done about a scan."""

    MADE = "made"
    UNCHANGED = "unchanged"
    FAILED = "failed"


class Cause(enum.StrEnum):
    """Why a scan failed; each names a group of the summary."""

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


_CAUSES = {
    ExitCode.USAGE: Cause.USAGE,
    ExitCode.INPUT: Cause.INPUT,
    ExitCode.FIT: Cause.FIT,
    ExitCode.MESH: Cause.MESH,
    ExitCode.OUTPUT: Cause.OUTPUT,
    ExitCode.MEMORY: Cause.MEMORY,
    ExitCode.INTERRUPTED: Cause.INTERRUPTED,
}

PASSING = frozenset({Cause.OUTPUT, Cause.MEMORY, Cause.TIMEOUT, Cause.SIGNAL, Cause.UNFORESEEN})
"""Causes that may be gone at the next attempt; the others depend on the scan and the options alone."""

FILES = ("mesh", "report", "page", "preview", "model", "config")
"""Kinds of files that a scan may be given."""


@dataclass(frozen=True)
class Outcome:
    """What became of one scan.

    Parameters
    ----------
    name : of its outputs, relative to the output folder and without an extension
    scan : path
    status : Status
    cause : why it failed, or None
    message : one sentence on the failure, or nothing
    exit_code : of its process; negative for a signal, None where it was ended for taking too long
    files : path of each kind of file that was written, of `FILES`
    thumbnail, log : paths; empty where there is none
    attempts : how often it was tried, this time
    seconds : from the first attempt to the end of the last one
    peak_memory_mb : greatest resident memory of its process, in MB of 10^6 bytes; None where nothing was run
    figures : what the mesh is like, see `figures_of`
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
        """Return the fields as plain values, every kind of file by its name."""
        values = asdict(self)
        files = values.pop("files")
        return {**values, **{kind: files.get(kind, "") for kind in FILES}}


def cause_of(exit_code: int) -> Cause | None:
    """Return the cause that an exit code stands for; None for success."""
    if exit_code == ExitCode.OK:
        return None
    if exit_code < 0:
        return Cause.SIGNAL
    return _CAUSES.get(ExitCode(exit_code), Cause.UNFORESEEN) if exit_code in list(ExitCode) else Cause.UNFORESEEN


def describe_signal(number: int) -> str:
    """Return a sentence on a process that was killed by a signal."""
    name = signal.Signals(number).name if number in list(signal.Signals) else f"signal {number}"
    hint = " Perhaps the system was out of memory." if number == signal.SIGKILL else ""
    return f"Killed by {name}.{hint}"


def figures_of(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the few figures of a run's report that a table of many runs shows."""
    mesh = report["mesh"]
    names = ("vertices", "faces", "components", "genus", "closed", "area", "volume", "invented_area_share")
    return {"points": report["ingest"]["kept"], **{name: mesh[name] for name in names}}

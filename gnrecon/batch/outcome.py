"""What became of one scan of a batch, and by which cause where it failed."""

from __future__ import annotations

import enum
import signal
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from gnrecon.runtime.errors import ExitCode


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

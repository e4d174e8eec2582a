"""One scan of a batch as a piece of work: plain values, so that any process on any machine can take it over."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

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
    kinds : of files that are wanted beside the mesh, of `gnrecon.batch.outcome.FILES`
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

"""The request for a batch, as the command line gives it, with its validation."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from gnrecon.config import Settings
from gnrecon.io import writable
from gnrecon.runtime.errors import UsageError


@dataclass(frozen=True)
class Request:
    """A batch as requested on the command line.

    Parameters
    ----------
    sources : files, folders and patterns
    output : folder for the meshes, created when missing
    lists : files with a source on each line
    patterns : of the files to take from folders; empty: all that can be read
    recursive : whether subfolders are searched
    name : template of the outputs' names, see `gnrecon.batch.scan_search`
    mesh_format : extension of the meshes, without the dot
    kinds : kinds of files to write in addition to each mesh, of `gnrecon.batch.job.FILE_ENDINGS`
    settings : options, references and limits, for all scans or for some
    references : folder of references
    reference_name : template of a reference's path in that folder, with or without its extension
    jobs : number of jobs at a time; None: as many as the machine takes
    retry : how often a transient failure is tried again
    engine : ``"local"`` or ``"dask"``
    scheduler : address of a Dask scheduler; implies the engine ``"dask"``
    overwrite, fresh : as of `Job`
    quiet : whether only failures are printed
    command : the command line

    Raises
    ------
    UsageError
        When a value is out of its range.
    """

    sources: tuple[str, ...]
    output: Path
    lists: tuple[Path, ...] = ()
    patterns: tuple[str, ...] = ()
    recursive: bool = False
    name: str | None = None
    mesh_format: str = "obj"
    kinds: tuple[str, ...] = ()
    settings: Settings = field(default_factory=Settings)
    references: Path | None = None
    reference_name: str | None = None
    jobs: int | None = None
    retry: int = 0
    engine: str = "local"
    scheduler: str | None = None
    overwrite: bool = False
    fresh: bool = False
    quiet: bool = False
    command: str | None = None

    def __post_init__(self) -> None:
        if f".{self.mesh_format}" not in (known := writable()):
            supported = ", ".join(suffix[1:] for suffix in known)
            raise UsageError(f"Meshes cannot be written as {self.mesh_format!r}; use {supported}.")
        if not self.sources and not self.lists:
            raise UsageError("Name a folder, a pattern or scans, or give a list of them with --list.")
        if "-" in self.sources:
            raise UsageError("A batch does not read standard input; name a folder, a pattern or scans.")
        if self.jobs is not None and self.jobs < 1:
            raise UsageError(f"The number of jobs must be positive, not {self.jobs}.")
        if self.reference_name is not None and self.references is None:
            raise UsageError("A template of references needs the folder of the references: add --reference-dir.")
        if self.engine not in ("local", "dask"):
            raise UsageError(f"The engine is local or dask, not {self.engine!r}.")
        if self.retry < 0:
            raise UsageError(f"The number of further attempts must not be negative, not {self.retry}.")

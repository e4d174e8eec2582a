"""What a result depends on, as one hash: the bytes that are read, the options, the wanted files and the version."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from gnrecon.batch.job import Job
from gnrecon.io.merge import members
from gnrecon.version import __version__


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

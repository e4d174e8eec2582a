"""Pairing scans with references by the names of their files."""

from __future__ import annotations

from pathlib import Path

from gnrecon.batch.naming import Found, filled
from gnrecon.batch.request import Request
from gnrecon.io import readable
from gnrecon.runtime.errors import InputError

_TEMPLATES = ("{folder}/{stem}", "{stem}")


def reference_of(found: Found, index: int, request: Request) -> Path | None:
    """Return a scan's reference in the folder of references; None where it has none.

    The template names a file there, with its extension or, to take whichever there is, without. When none is given, the
    reference has the scan's stem, and lies in the same subfolder as the scan or in the folder itself.

    Raises
    ------
    InputError
        When there is no such folder.
    UsageError
        When the template makes no sense.
    """
    if request.references is None:
        return None
    if not request.references.is_dir():
        raise InputError(f"There is no folder {request.references}.")
    for template in _TEMPLATES if request.reference_name is None else (request.reference_name,):
        wanted = request.references / filled(template, found, index)
        candidates = [wanted, *(wanted.with_name(wanted.name + extension) for extension in readable())]
        there = next((path for path in candidates if path.is_file()), None)
        if there is not None:
            return there
    return None

"""Guarding a call into a library that parses files."""

from __future__ import annotations

from contextlib import AbstractContextManager

from gnrecon.runtime.errors import InputError
from gnrecon.runtime.plugins import guarded, told


def parsing(kind: str) -> AbstractContextManager[None]:
    """Guard a block that parses a file of a kind, such as ``"LAS"``.

    Raises
    ------
    InputError
        When the library in the block fails in whichever way; see `gnrecon.runtime.plugins.guarded`.
    """
    return guarded(InputError, lambda error: f"the file is not a well-formed {kind} file ({told(error)}).")

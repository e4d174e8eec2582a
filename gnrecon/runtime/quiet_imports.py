"""Imports of libraries that print something, or abort on an interrupt, while they are imported."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from importlib import import_module
from io import StringIO
from typing import Any

from gnrecon.runtime.interrupts import postponed_interrupts


def import_open3d() -> Any:
    """Return open3d, imported without the lines that it prints in a notebook about its own viewer."""
    if "open3d" in sys.modules:
        return sys.modules["open3d"]
    with redirect_stdout(StringIO()):
        import open3d
    return open3d


def import_uninterrupted(name: str) -> Any:
    """Return a library that is made with nanobind, which aborts where Python raises an exception during its import."""
    with postponed_interrupts():
        return import_module(name)

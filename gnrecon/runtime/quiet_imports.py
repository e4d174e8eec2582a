"""Imports of libraries that print something when they are imported."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from io import StringIO
from typing import Any


def import_open3d() -> Any:
    """Return open3d, imported without the lines that it prints in a notebook about its own viewer."""
    if "open3d" in sys.modules:
        return sys.modules["open3d"]
    with redirect_stdout(StringIO()):
        import open3d
    return open3d

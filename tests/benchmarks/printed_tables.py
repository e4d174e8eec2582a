"""The text of tables, as they are printed."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table


def printed(*tables: Table, width: int = 200) -> str:
    """Return what a console of a width prints."""
    console = Console(width=width, highlight=False)
    with console.capture() as capture:
        console.print(*tables)
    return capture.get()

"""The progress of a batch: a live table on a terminal, a line for each scan elsewhere."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from gnrecon.batch.job import PROGRESS, Outcome, Status, running_folder
from gnrecon.run import STAGES

_STYLES = {Status.MADE: "green", Status.UNCHANGED: "dim", Status.FAILED: "red"}
_FINISHED_SHOWN = 8


class Board:
    """What is shown of a batch.

    Parameters
    ----------
    console : where
    total : number of scans
    output : folder of the batch's outputs
    """

    def __init__(self, console: Console, total: int, output: Path) -> None:
        self._console, self._total, self._output = console, total, output
        self._outcomes: list[Outcome] = []
        self._start = time.monotonic()

    def done(self, outcome: Outcome) -> None:
        """Show a scan's end."""
        self._outcomes.append(outcome)
        if not self._console.is_terminal:
            result = outcome.message if outcome.failed else f"{outcome.files['mesh']} ({outcome.status})"
            line = f"[{len(self._outcomes)}/{self._total}] {outcome.scan}: {outcome.cause or ''}"
            self._console.print(f"{line.rstrip(': ')}: {result}", highlight=False, markup=False, soft_wrap=True)

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Show the table while the block runs, on a terminal."""
        live = Live(console=self._console, get_renderable=self._table, refresh_per_second=2, transient=True)
        if not self._console.is_terminal or self._console.quiet:
            yield
            return
        with live:
            yield

    def _table(self) -> RenderableType:
        return Group(self._head(), self._running(), self._finished())

    def _head(self) -> Text:
        counts = {status: sum(one.status == status for one in self._outcomes) for status in Status}
        seconds = time.monotonic() - self._start
        text = Text(f"{len(self._outcomes)} of {self._total} scans")
        for status, count in counts.items():
            if count:
                text.append(f"  {count} {status}", style=_STYLES[status])
        worked = [one for one in self._outcomes if one.attempts]
        text.append(f"  {_clock(seconds)}")
        if worked and len(self._outcomes) < self._total:
            left = seconds / len(worked) * (self._total - len(self._outcomes))
            text.append(f", about {_clock(left)} left", style="dim")
        return text

    def _running(self) -> Table:
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
        for name, stage, share, seconds in _states(self._output):
            words = STAGES.get(stage, "Starting")
            table.add_row(name, words, ProgressBar(total=1.0, completed=share, width=24), _clock(seconds))
        return table

    def _finished(self) -> Table:
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
        for outcome in self._outcomes[-_FINISHED_SHOWN:]:
            told = outcome.message if outcome.failed else outcome.files["mesh"]
            status = Text(str(outcome.cause or outcome.status), style=_STYLES[outcome.status])
            table.add_row(outcome.name, status, Text(told, overflow="ellipsis", no_wrap=True, style="dim"))
        return table


def _states(output: Path) -> list[tuple[str, str, float, float]]:
    """Name, stage, share of it that is done and seconds until now of each scan that is being worked at."""
    found = []
    for folder in sorted(running_folder(output).glob("*")):
        try:
            state = json.loads((folder / PROGRESS).read_text(encoding="utf-8"))
            seconds = max(0.0, time.time() - state["begun"])
        except (OSError, ValueError):  # not begun yet, just ended, or being written
            continue
        found.append((state["name"], state["stage"], float(state["share"]), seconds))
    return found


def _clock(seconds: float) -> str:
    hours, rest = divmod(int(seconds), 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60}:{rest % 60:02d}"

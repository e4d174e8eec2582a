"""The progress of a batch: a live table on a terminal, a line for each finished scan elsewhere."""

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

from gnrecon.batch.job import JobOutcome, Status, progress_file, running_folder
from gnrecon.run import STAGES
from gnrecon.runtime.files import one_line


class ProgressBoard:
    """Shows the progress of a batch.

    Parameters
    ----------
    console : to print to
    total : number of scans
    output : folder of the batch's outputs
    finished_rows : the last finished scans that the table lists; more would not fit on a small terminal
    """

    def __init__(self, console: Console, total: int, output: Path, *, finished_rows: int = 8) -> None:
        self._console, self._total, self._output = console, total, output
        self._finished_rows = finished_rows
        self._outcomes: list[JobOutcome] = []
        self._start = time.monotonic()

    def done(self, outcome: JobOutcome) -> None:
        """Show that a scan has finished."""
        self._outcomes.append(outcome)
        if not self._console.is_terminal:
            result = outcome.message if outcome.failed else f"{outcome.files['mesh']} ({outcome.status})"
            line = f"[{len(self._outcomes)}/{self._total}] {outcome.scan}: {outcome.cause or ''}"
            self._console.print(
                one_line(f"{line.rstrip(': ')}: {result}"), highlight=False, markup=False, soft_wrap=True
            )

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
        counts = {status: sum(outcome.status == status for outcome in self._outcomes) for status in Status}
        seconds = time.monotonic() - self._start
        text = Text(f"{len(self._outcomes)} of {self._total} scans")
        for status, count in counts.items():
            if count:
                text.append(f"  {count} {status}", style=_style(status))
        run = [outcome for outcome in self._outcomes if outcome.attempts]
        text.append(f"  {_clock(seconds)}")
        if run and len(self._outcomes) < self._total:
            # Unchanged scans take no time, so the estimate counts only those that were run.
            left = seconds / len(run) * (self._total - len(self._outcomes))
            text.append(f", about {_clock(left)} left", style="dim")
        return text

    def _running(self) -> Table:
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
        for name, stage, share, seconds in _running_scans(self._output):
            title = STAGES.get(stage, "Starting")
            table.add_row(
                Text(one_line(name)), title, ProgressBar(total=1.0, completed=share, width=24), _clock(seconds)
            )
        return table

    def _finished(self) -> Table:
        table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
        for outcome in self._outcomes[-self._finished_rows :]:
            result = outcome.message if outcome.failed else outcome.files["mesh"]
            status = Text(str(outcome.cause or outcome.status), style=_style(outcome.status))
            table.add_row(
                Text(one_line(outcome.name)),
                status,
                Text(one_line(result), overflow="ellipsis", no_wrap=True, style="dim"),
            )
        return table


def _style(status: Status) -> str:
    return {Status.MADE: "green", Status.UNCHANGED: "dim", Status.FAILED: "red"}[status]


def _running_scans(output: Path) -> list[tuple[str, str, float, float]]:
    """Name, stage, finished share of it, and seconds so far of each running scan."""
    found = []
    for folder in sorted(running_folder(output).glob("*")):
        try:
            state = json.loads(progress_file(folder).read_text(encoding="utf-8"))
            seconds = max(0.0, time.time() - state["begun"])
        except (OSError, ValueError):  # not started yet, just ended, or being written
            continue
        found.append((state["name"], state["stage"], float(state["share"]), seconds))
    return found


def _clock(seconds: float) -> str:
    hours, rest = divmod(int(seconds), 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60}:{rest % 60:02d}"

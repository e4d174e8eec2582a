"""The summary of a batch: ``summary.json`` for programs, ``summary.csv`` for tables, ``summary.html`` for people.

The HTML page is one file with a picture of each mesh, its figures, and the failures grouped by their causes.
"""

from __future__ import annotations

import base64
import csv
import io
import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from gnrecon.batch.job import FILE_ENDINGS, MESH_FIGURES, SUMMARY_FILES, Cause, JobOutcome, Status
from gnrecon.report.html import scales as numbers
from gnrecon.report.html import style_text
from gnrecon.runtime.files import write_text
from gnrecon.version import __version__

CAUSE_DESCRIPTIONS = {
    Cause.INPUT: "the scan cannot be read or reconstructed",
    Cause.USAGE: "the options do not fit the scan",
    Cause.FIT: "the fit failed",
    Cause.MESH: "the mesh is not sound",
    Cause.OUTPUT: "a file could not be written",
    Cause.MEMORY: "not enough memory",
    Cause.TIMEOUT: "it took too long",
    Cause.SIGNAL: "the process was killed",
    Cause.UNFORESEEN: "a fault of gnrecon",
    Cause.INTERRUPTED: "interrupted",
}


@dataclass(frozen=True)
class BatchSummary:
    """Results of a batch.

    Parameters
    ----------
    outcomes : in the order of the scans
    total : number of scans in the batch; more than the outcomes where it was interrupted
    jobs : number of jobs at a time
    threads : of each job
    seconds : duration of the batch
    command : the command line
    """

    outcomes: tuple[JobOutcome, ...]
    total: int
    jobs: int
    threads: int
    seconds: float
    command: str | None = None

    def count(self, status: Status) -> int:
        """Return how many scans have a status."""
        return sum(outcome.status == status for outcome in self.outcomes)

    def causes(self) -> dict[str, int]:
        """Return how many scans failed by each cause, the most frequent first."""
        failures = [str(outcome.cause) for outcome in self.outcomes if outcome.cause is not None]
        return dict(Counter(failures).most_common())

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain values."""
        return {
            "version": __version__,
            "command": self.command,
            "scans_asked_for": self.total,
            "made": self.count(Status.MADE),
            "unchanged": self.count(Status.UNCHANGED),
            "failed": self.count(Status.FAILED),
            "causes": self.causes(),
            "jobs": self.jobs,
            "threads": self.threads,
            "seconds": round(self.seconds, 2),
            "scans": [outcome.as_dict() for outcome in self.outcomes],
        }


def write_summary(summary: BatchSummary, folder: Path) -> Path:
    """Write the summary into a folder in three formats, each atomically, and return the path of the JSON file.

    Older summaries are replaced.

    Raises
    ------
    OutputError
        When a file cannot be written.
    """
    # JSON has no NaN; a value that is not finite would make the file unreadable for other programs.
    text = json.dumps(summary.as_dict(), indent=2, allow_nan=False) + "\n"
    texts = (text, summary_csv(summary.outcomes), summary_html(summary.as_dict(), folder))
    for name, contents in zip(SUMMARY_FILES, texts, strict=True):
        write_text(folder / name, contents, overwrite=True)
    return folder / SUMMARY_FILES[0]


def summary_csv(outcomes: Sequence[JobOutcome]) -> str:
    """Return the outcomes as comma-separated values: a line of column names, then one line for each scan.

    There are columns for distances to references if a scan has a reference.
    """
    metrics = [name for outcome in outcomes for name in _numeric(outcome.metrics)]
    columns = ["name", "scan", "status", "cause", "message", "exit_code", "attempts", "seconds", "peak_memory_mb"]
    columns += ["points", *MESH_FIGURES, *dict.fromkeys(metrics), *FILE_ENDINGS]
    text = io.StringIO(newline="")
    table, quoted = (
        csv.DictWriter(text, columns, restval="", extrasaction="ignore", lineterminator="\n", quoting=quoting)
        for quoting in (csv.QUOTE_MINIMAL, csv.QUOTE_ALL)
    )
    table.writeheader()
    for outcome in outcomes:
        row = {**outcome.as_dict(), **outcome.figures, **_numeric(outcome.metrics)}
        # A carriage return ends a line for programs that read the table, and Python does not quote it by itself.
        writer = quoted if any("\r" in str(value) for value in row.values()) else table
        writer.writerow({name: _not_a_formula(value) for name, value in row.items()})
    return text.getvalue()


def _not_a_formula(value: Any) -> Any:
    """Text that a spreadsheet would run as a formula begins with an apostrophe, which spreadsheets take for text.

    Source: https://owasp.org/www-community/attacks/CSV_Injection
    """
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) else value


def _numeric(metrics: Mapping[str, Any] | None) -> dict[str, float]:
    return {name: value for name, value in (metrics or {}).items() if isinstance(value, int | float)}


def summary_html(summary: Mapping[str, Any], folder: Path) -> str:
    """Return the page as text.

    Parameters
    ----------
    summary : as `BatchSummary.as_dict` returns it
    folder : where the page will lie; links to files are relative to it
    """
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {
        "count": numbers.count,
        "figure": numbers.figure,
        "seconds": numbers.seconds,
        "memory": numbers.memory,
        "percent": lambda value: numbers.share(value, 1.0),
    }
    scans = [_row(scan, folder) for scan in summary["scans"]]
    causes = [
        {
            "name": name,
            "description": CAUSE_DESCRIPTIONS[Cause(name)],
            "scans": [scan for scan in scans if scan["cause"] == name],
        }
        for name in summary["causes"]
    ]
    return environment.get_template("summary.html.j2").render(
        summary=summary,
        folder=folder.absolute().name,
        scans=scans,
        causes=causes,
        compared=any(scan["metrics"] for scan in scans),
        style=Markup(style_text()),
    )


def _row(scan: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    links = [(kind, _link(scan[kind], folder)) for kind in FILE_ENDINGS if scan[kind]]
    links += [("log", _link(scan["log"], folder))] if scan["log"] else []
    return {**scan, "links": links, "picture": _picture_uri(scan["thumbnail"])}


def _link(path: str, folder: Path) -> str:
    return quote(os.fsencode(os.path.relpath(path, folder)))


def _picture_uri(path: str, *, colors: int = 64) -> str | None:
    """A picture as a data URI, reduced to `colors` because a page may hold thousands; None where there is none."""
    from PIL import Image

    packed = io.BytesIO()
    try:
        with Image.open(path) as picture:
            picture.convert("RGB").quantize(colors).save(packed, format="PNG", optimize=True)
    except OSError:
        return None
    return f"data:image/png;base64,{base64.b64encode(packed.getvalue()).decode('ascii')}"

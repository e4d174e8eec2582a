"""The account of a batch: ``summary.json`` for programs, ``summary.csv`` for tables, ``summary.html`` to look at."""

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

from gnrecon.batch.job import FILES, Cause, Outcome, Status
from gnrecon.report.html import scales as numbers
from gnrecon.report.html import style_text
from gnrecon.runtime.files import write_text
from gnrecon.version import __version__

NAME = "summary"


@dataclass(frozen=True)
class Account:
    """What a batch did.

    Parameters
    ----------
    outcomes : in the order of the scans
    total : how many scans it was about, which are more where it was interrupted
    jobs : at a time, and `threads` of each
    seconds : that it took
    command : the line that asked for it
    """

    outcomes: tuple[Outcome, ...]
    total: int
    jobs: int
    threads: int
    seconds: float
    command: str | None = None

    def count(self, status: Status) -> int:
        """Return how many scans came to a status."""
        return sum(outcome.status == status for outcome in self.outcomes)

    def causes(self) -> dict[str, int]:
        """Return how many scans failed by each cause, the most frequent first."""
        return dict(Counter(str(one.cause) for one in self.outcomes if one.cause is not None).most_common())

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


def write_summary(account: Account, folder: Path) -> None:
    """Write the account into a folder in three formats, each atomically; older ones are replaced.

    Raises
    ------
    OutputError
        When a file cannot be written.
    """
    text = json.dumps(account.as_dict(), indent=2, allow_nan=False) + "\n"
    write_text(folder / f"{NAME}.json", text, overwrite=True)
    write_text(folder / f"{NAME}.csv", table_text(account.outcomes), overwrite=True)
    write_text(folder / f"{NAME}.html", overview_text(account.as_dict(), folder), overwrite=True)


_PLAIN = ("name", "scan", "status", "cause", "message", "exit_code", "attempts", "seconds", "peak_memory_mb")

_FIGURES = ("points", "vertices", "faces", "components", "genus", "closed", "area", "volume", "invented_area_share")


def table_text(outcomes: Sequence[Outcome]) -> str:
    """Return the outcomes as comma-separated values, one line a scan below a line of names.

    Distances to references are there where a scan has some.
    """
    metrics = [name for outcome in outcomes for name in _numbers(outcome.metrics)]
    columns = [*_PLAIN, *_FIGURES, *dict.fromkeys(metrics), *FILES]
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, columns, restval="", extrasaction="ignore", lineterminator="\n")
    table.writeheader()
    for outcome in outcomes:
        table.writerow({**outcome.as_dict(), **outcome.figures, **_numbers(outcome.metrics)})
    return text.getvalue()


def _numbers(metrics: Mapping[str, Any] | None) -> dict[str, float]:
    return {name: value for name, value in (metrics or {}).items() if isinstance(value, int | float)}


COLORS = 64
"""Of a thumbnail on the page."""

WORDS = {
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
"""What each cause means, in a few words."""


# The summary to look at: one HTML file with a picture of each mesh, its figures, and the failures by their causes.


def overview_text(account: Mapping[str, Any], folder: Path) -> str:
    """Return the page as text.

    Parameters
    ----------
    account : as `Account.as_dict` gives it
    folder : that the page is to lie in, from which it links to the files
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
    scans = [_row(scan, folder) for scan in account["scans"]]
    causes = [
        {"name": name, "words": WORDS[Cause(name)], "scans": [scan for scan in scans if scan["cause"] == name]}
        for name in account["causes"]
    ]
    return environment.get_template("overview.html.j2").render(
        account=account,
        folder=folder.absolute().name,
        scans=scans,
        causes=causes,
        compared=any(scan["metrics"] for scan in scans),
        style=Markup(style_text()),
    )


def _row(scan: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    links = [(kind, _link(scan[kind], folder)) for kind in FILES if scan[kind]]
    links += [("log", _link(scan["log"], folder))] if scan["log"] else []
    return {**scan, "links": links, "picture": _picture(scan["thumbnail"])}


def _link(path: str, folder: Path) -> str:
    return quote(os.path.relpath(path, folder))


def _picture(path: str) -> str | None:
    """A picture as a data URI, in few colours, because a page may hold thousands; None where it is not there."""
    from PIL import Image

    packed = io.BytesIO()
    try:
        with Image.open(path) as picture:
            picture.convert("RGB").quantize(COLORS).save(packed, format="PNG", optimize=True)
    except OSError:
        return None
    return f"data:image/png;base64,{base64.b64encode(packed.getvalue()).decode('ascii')}"

"""The account of a batch: ``summary.json`` for programs, ``summary.csv`` for tables, ``summary.html`` to look at."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gnrecon.batch.outcome import FILES, Outcome, Status
from gnrecon.batch.overview import overview_text
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

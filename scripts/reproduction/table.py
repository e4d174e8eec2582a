"""The numbers of finished experiments: a row each, as CSV and as a table beside the authors' figures."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

from reproduction.experiments import Experiment

COLUMNS = ("problem", "optimiser", "seconds", "steps", "loss", "chamfer", "authors_quantity", "authors")

AUTHORS: dict[str, tuple[str, dict[str, float | None]]] = {
    "bunny": ("loss", {"gn": 7.1e-5, "lbfgs": 2.4e-4, "adam": 1.4e-3}),
    "bunny-sparse": ("loss", {"gn": 5.8e-5, "lbfgs": 1.9e-4, "adam": 1.0e-3}),
    "rockerarm": ("loss", {"gn": 1.9e-5, "lbfgs": 1.9e-4, "adam": 7.3e-4}),
    "catenoid": ("chamfer", {"gn": 1.6e-6, "lbfgs": 5.9e-5, "adam": 1.8e-4}),
    "enneper": ("chamfer", {"gn": 7.8e-7, "lbfgs": None, "adam": 1.8e-4}),
    "cone": ("loss", {"gn": 5.0e-11, "lbfgs": None, "adam": 2.6e-6}),
}
"""The authors' figures, of 600 s for the scans and of 1,200 s for the rest; None where their run was unstable."""


def row(one: Experiment) -> dict[str, Any]:
    """Return the numbers of a finished experiment by the names of the columns."""
    figures = one.figures()
    quantity, theirs = AUTHORS[one.problem]
    known = {name: figures[name] for name in ("seconds", "steps", "loss", "chamfer")}
    return {
        "problem": one.problem,
        "optimiser": one.optimiser,
        **known,
        "authors_quantity": quantity,
        "authors": theirs[one.optimiser],
    }


def as_csv(done: Sequence[Experiment]) -> str:
    """Return the rows as the text of a CSV file."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(row(one) for one in done)
    return text.getvalue()


def as_markdown(done: Sequence[Experiment]) -> str:
    """Return the rows as a Markdown table."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS)]
    lines += ["| " + " | ".join(_cell(value) for value in row(one).values()) + " |" for one in done]
    return "\n".join(lines) + "\n"


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.2g}" if isinstance(value, float) else str(value)

"""Tables of figures, printed with rich."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

from rich.table import Table


@dataclass(frozen=True)
class Figure:
    """A figure of a table.

    Parameters
    ----------
    key : name in a record; dots lead into dictionaries within it
    label : heading of its row or column
    form : format of the value
    factor : multiplies the value
    is_length : whether it is a length, for tables that choose the unit by row
    """

    key: str
    label: str
    form: str = "{:,.0f}"
    factor: float = 1.0
    is_length: bool = False

    def value(self, record: Mapping[str, Any]) -> Any:
        """Return the figure of a record.

        Raises
        ------
        KeyError
            When the record does not have it.
        """
        return reduce(lambda inner, key: inner[key], self.key.split("."), record)

    def cell(self, record: Mapping[str, Any]) -> str:
        """Return the formatted figure; a record under whose ``"error"`` there is a sentence has failed."""
        if "error" in record:
            return "failed"
        value = self.value(record)
        return self.form.format(value if self.factor == 1.0 else self.factor * value)


def row_table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], *, title: str | None = None, caption: str | None = None
) -> Table:
    """Return a table of rows; the first column is aligned left, the others right."""
    table = Table(title=title, caption=caption)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="left" if number == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def column_table(
    records: Sequence[Mapping[str, Any]], headings: Sequence[str], figures: Sequence[Figure], first: str, caption: str
) -> Table:
    """Return a table with a column per record and a row per figure; `first` is the heading of the labels."""
    rows = [(figure.label, *(figure.cell(record) for record in records)) for figure in figures]
    return row_table([first, *headings], rows, caption=caption)


def number_or_dash(value: float | None, form: str) -> str:
    """Return a formatted number, or a dash for None."""
    return "-" if value is None else form.format(value)

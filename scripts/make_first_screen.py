"""Measures gnrecon and screened Poisson on the sample scans, and writes the figures and the picture of the README.

Run it as ``.venv/bin/python scripts/make_first_screen.py`` on an idle machine; it takes some minutes. The README gets
one scan's figures and its picture, docs/accuracy.md those of all. ``./scripts/bench accuracy --cases samples`` prints
the same figures and more.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.accuracy.cases import GROUPS
from benchmarks.accuracy.comparison import Protocol, problems_of, run_case
from benchmarks.accuracy.many_scans import sheet_row
from benchmarks.accuracy.summary import summarise
from benchmarks.harness.command_line import scratch_folder
from benchmarks.harness.contact_sheet import Row, draw_row, write_sheet
from marked_page import with_part

from gnrecon.runtime.files import write_text

REPOSITORY = Path(__file__).resolve().parents[1]
SHOWN = "bracket_dense"
BEGIN = "<!-- The table below is made by scripts/make_first_screen.py. -->"
END = "<!-- The table ends. -->"


def first_screen(summary: dict[str, Any], threads: int) -> list[str]:
    """Return the README's table: three figures of one scan, gnrecon's next to screened Poisson's."""
    ours, theirs = (summary["methods"][name] for name in ("gnrecon", "Poisson"))
    rows = {
        "mean distance to the true surface": ("chamfer_mean", "{:.3f} mm"),
        "largest distance": ("hausdorff", "{:.1f} mm"),
        f"time with {threads} threads": ("seconds", "{:.0f} s"),
    }
    return [
        f"| | gnrecon | screened Poisson (open3d, its best depth: {theirs['settings']['depth']}) |",
        "|---|---|---|",
        *(
            f"| {title} | {form.format(ours[key])} | {form.format(theirs[key])} |"
            for title, (key, form) in rows.items()
        ),
    ]


def all_scans(summaries: Sequence[dict[str, Any]]) -> list[str]:
    """Return the table of docs/accuracy.md: a line for each sample scan and method."""
    lines = ["| sample scan | method | mean | Hausdorff | genus | time |", "|---|---|---|---|---|---|"]
    for summary in summaries:
        for name, found in summary["methods"].items():
            method = f"{name}, depth {found['settings']['depth']}" if "depth" in found["settings"] else name
            genus = "no manifold" if found["genus"] is None else f"{found['genus']:g} ({summary['genus']})"
            distances = f"{found['chamfer_mean']:.3f} | {found['hausdorff']:.2f}"
            lines.append(f"| `{summary['case']}` | {method} | {distances} | {genus} | {found['seconds']:.0f} s |")
    return lines


def main() -> int:
    """Measure, and write both tables and the picture.

    Raises
    ------
    ValueError
        When a page lacks the marks of its table.
    """
    protocol, summaries = Protocol(), []
    for name, case in GROUPS["samples"].items():
        with scratch_folder() as scratch:
            folder, problem = scratch / "case", case.problem(REPOSITORY, 0)
            trials = run_case(name, problems_of(case, REPOSITORY), [0], ["gnrecon", "Poisson"], protocol, folder)
            summaries.append(summarise(trials, problem))
            if name == SHOWN:
                draw(sheet_row(summaries[-1], problem, folder), f"{len(problem.scan):,} points")
    shown = next(summary for summary in summaries if summary["case"] == SHOWN)
    tables = {"README.md": first_screen(shown, protocol.threads), "docs/accuracy.md": all_scans(summaries)}
    for name, lines in tables.items():
        page = REPOSITORY / name
        write_text(page, with_part(page.read_text(encoding="utf-8"), BEGIN, lines, END), overwrite=True)
        print("\n".join(lines))
    return 0


def draw(row: Row, title: str, *, panel: tuple[int, int] = (400, 420)) -> None:
    """Draw the scan, gnrecon's mesh and Poisson's side by side, each under its name."""
    scan, ours, theirs, _ = row.parts.values()
    parts = {title: scan, "gnrecon": ours, "screened Poisson": theirs}
    write_sheet([draw_row(Row(parts, row.up, row.view), panel)], REPOSITORY / "docs" / "images" / "bracket.png")


if __name__ == "__main__":
    sys.exit(main())

"""The README's first screen: its figures come from the benchmark, are put in their place, and still hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import make_first_screen as first_screen
import pytest
from benchmarks.accuracy.cases import GROUPS
from marked_page import with_part

REPOSITORY = Path(__file__).resolve().parents[1]


def summary() -> dict[str, Any]:
    ours = {"chamfer_mean": 0.0512, "hausdorff": 3.14, "seconds": 61.4, "genus": 7, "settings": {}}
    theirs = {"chamfer_mean": 0.2, "hausdorff": 5.26, "seconds": 2.6, "genus": None, "settings": {"depth": 9}}
    return {"case": "bracket_dense", "genus": 8, "methods": {"gnrecon": ours, "Poisson": theirs}}


def test_the_tables_show_both_methods_side_by_side() -> None:
    assert first_screen.first_screen(summary(), threads=2) == [
        "| | gnrecon | screened Poisson (open3d, its best depth: 9) |",
        "|---|---|---|",
        "| mean distance to the true surface | 0.051 mm | 0.200 mm |",
        "| largest distance | 3.1 mm | 5.3 mm |",
        "| time with 2 threads | 61 s | 3 s |",
    ]
    assert first_screen.all_scans([summary()])[2:] == [
        "| `bracket_dense` | gnrecon | 0.051 | 3.14 | 7 (8) | 61 s |",
        "| `bracket_dense` | Poisson, depth 9 | 0.200 | 5.26 | no manifold | 3 s |",
    ]


def test_a_part_between_marks_is_replaced_and_nothing_else() -> None:
    page = "# Title\nBEGIN\n\nold\n\nEND\nrest\n"
    made = with_part(page, "BEGIN", ["new", "lines"], "END")
    assert made == "# Title\nBEGIN\n\nnew\nlines\n\nEND\nrest\n"
    assert with_part(made, "BEGIN", ["new", "lines"], "END") == made
    assert with_part(page, "BEGIN", ["new"]) == "# Title\nBEGIN\n\nnew\n"
    for begin, end in (("NONE", None), ("BEGIN", "NONE")):
        with pytest.raises(ValueError, match="no line 'NONE'"):
            with_part(page, begin, [], end)


@pytest.mark.parametrize("name", ["README.md", "docs/accuracy.md"])
def test_the_pages_have_their_tables(name: str) -> None:
    page = (REPOSITORY / name).read_text(encoding="utf-8")
    part = page.partition(first_screen.BEGIN)[2].partition(first_screen.END)[0].strip().splitlines()
    assert page.count(first_screen.BEGIN) == page.count(first_screen.END) == 1
    # The head, its line, and three figures, or each scan by both methods.
    assert len(part) == (5 if name == "README.md" else 2 + 2 * len(GROUPS["samples"]))


@pytest.mark.parametrize("name", GROUPS["samples"])
def test_the_samples_are_cases_of_the_benchmark(name: str) -> None:
    problem = GROUPS["samples"][name].problem(Path("nowhere"), 0)
    assert problem.unit == "the scan's unit"
    assert problem.truth.euler_characteristic == 2 - 2 * problem.genus

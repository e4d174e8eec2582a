"""The progress of a batch: a table on a terminal, lines elsewhere."""

from __future__ import annotations

import io
import json
import time
from pathlib import Path

from rich.console import Console

from gnrecon.batch.job import Cause, JobOutcome, Status, progress_file, running_folder
from gnrecon.batch.progress_board import ProgressBoard

MADE = JobOutcome("ring", "s/ring.ply", Status.MADE, files={"mesh": "out/ring.obj"}, attempts=1)
OLD = JobOutcome("old", "s/old.ply", Status.UNCHANGED, files={"mesh": "out/old.obj"})
TORN = JobOutcome("torn", "s/torn.ply", Status.FAILED, Cause.INPUT, "s/torn.ply: it ends early.", 3, attempts=1)


def write_state(output: Path, text: str, name: str) -> None:
    folder = running_folder(output) / name
    folder.mkdir(parents=True)
    progress_file(folder).write_text(text)


def shown(output: Path, *, terminal: bool, quiet: bool = False) -> str:
    text = io.StringIO()
    board = ProgressBoard(
        Console(file=text, force_terminal=terminal, width=100, quiet=quiet, color_system=None), 5, output
    )
    with board.shown():
        for outcome in (MADE, OLD, TORN):
            board.done(outcome)
    return text.getvalue()


def test_a_table_on_a_terminal(tmp_path: Path) -> None:
    state = {"name": "plate", "pid": 1, "begun": time.time() - 75, "stage": "fit", "share": 0.5}
    write_state(tmp_path, json.dumps(state), "plate-1")
    write_state(tmp_path, "{half", "ball-1")
    (running_folder(tmp_path) / "new-1").mkdir()
    text = shown(tmp_path, terminal=True)
    last = text[text.rindex("3 of 5 scans") :]
    assert "1 made  1 unchanged  1 failed" in last
    assert " left" in last
    assert "plate  Fitting" in last
    assert "1:15" in last
    assert "torn  input" in last
    assert "s/torn.ply: it ends early." in last
    assert "ball" not in last


def test_a_line_for_each_scan_elsewhere(tmp_path: Path) -> None:
    assert shown(tmp_path, terminal=False).splitlines() == [
        "[1/5] s/ring.ply: out/ring.obj (made)",
        "[2/5] s/old.ply: out/old.obj (unchanged)",
        "[3/5] s/torn.ply: input: s/torn.ply: it ends early.",
    ]


def test_nothing_where_quiet_is_asked_for(tmp_path: Path) -> None:
    assert shown(tmp_path, terminal=True, quiet=True) == ""
    assert shown(tmp_path, terminal=False, quiet=True) == ""

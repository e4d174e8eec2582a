"""The fuzz benchmark: damaged and odd scans in whole runs, each of which ends in a mesh or in one sentence."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks import fuzz
from benchmarks.__main__ import main as bench
from benchmarks.damage import damaged_scan
from benchmarks.fuzz import Run, runs, table

from gnrecon import reconstruct
from gnrecon.batch.job import Limits
from gnrecon.runtime.errors import ExitCode, GnreconError


def test_damaged_scans_end_in_a_mesh_or_in_one_sentence() -> None:
    found = list(runs(range(17, 22), 0, 2, Limits(60.0, 4000.0)))
    assert [run.number for run in found] == list(range(17, 22))
    assert [f"{run.number} {run.scan} {run.fault}" for run in found if run.fault] == []
    assert {ExitCode.OK, ExitCode.INPUT} <= {run.code for run in found}


@pytest.mark.parametrize("first", range(1000, 1300, 50))
def test_damaged_scans_end_in_a_sound_mesh_or_in_one_sentence_in_one_process(tmp_path: Path, first: int) -> None:
    """With the smallest fit and the coarsest mesh, many more can be tried."""
    smallest: dict[str, Any] = {"widths": (40,), "steps": 1, "resolution": 16, "threads": 1, "keep_handles": True}
    foreseen, meshes = (ExitCode.INPUT, ExitCode.FIT, ExitCode.MESH, ExitCode.USAGE), 0
    for number in range(first, first + 50):
        folder = tmp_path / str(number)
        folder.mkdir()
        scan = damaged_scan(folder, np.random.default_rng([0, number]))
        sentence, result = "", None
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            try:
                result = reconstruct(scan, quality="draft", **smallest)
            except GnreconError as error:
                sentence = f"{error}, exit code {int(error.exit_code)}"
        assert "\n" not in sentence, number
        assert not sentence or int(sentence.rpartition(" ")[2]) in foreseen, number
        assert sentence or (result is not None and np.isfinite(result.mesh.vertices).all()), number
        meshes += not sentence
    assert 0 < meshes < 50


@pytest.mark.parametrize(
    ("code", "printed", "fault"),
    [
        (ExitCode.INPUT, "gnrecon: It is empty.\n", ""),
        (ExitCode.INPUT, "warning\ngnrecon: It is empty.\n", "printed 2 lines: warning"),
        (ExitCode.INPUT, "", "printed 0 lines: "),
        (ExitCode.UNFORESEEN, "gnrecon: Unforeseen.\n", "exit code 1: gnrecon: Unforeseen."),
        (-11, "", "exit code -11: "),
    ],
)
def test_what_a_fault_is(tmp_path: Path, code: int, printed: str, fault: str) -> None:
    assert fuzz._fault(code, printed, tmp_path / "mesh.ply", tmp_path / "report.json") == fault


def test_a_file_that_is_left_and_an_open_mesh_are_faults(tmp_path: Path) -> None:
    mesh = tmp_path / "mesh.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    report = tmp_path / "report.txt"
    report.write_text('{"mesh": {"closed": true}}')
    assert fuzz._fault(ExitCode.FIT, "gnrecon: No.\n", mesh, report) == "left mesh.obj, report.txt"
    assert fuzz._fault(ExitCode.OK, "", mesh, report) == "the mesh is not watertight"
    report.write_text('{"mesh": {"closed": false}}')
    assert fuzz._fault(ExitCode.OK, "", mesh, report) == ""


def test_its_exit_code_and_its_table_hold_every_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ended = [
        Run(0, "a.ply", (), 0, 1.0, 300.0, ""),
        Run(1, "b.ply", ("--trim", "3s"), -11, 2.0, 400.0, "exit code -11: "),
        Run(2, "c.ply", (), None, 60.0, 500.0, "It had not ended."),
        Run(9, "d.ply", (), None, 0.4, 200.0, "", killed=True),
    ]
    monkeypatch.setattr(fuzz, "runs", lambda *_: iter(ended))
    assert bench(["fuzz", "--count", "4"]) == ExitCode.UNFORESEEN
    printed = capsys.readouterr().out
    assert "1 (b.ply --trim 3s): exit code -11: " in printed
    assert "2 faults." in printed
    assert all(word in printed for word in ("exit 0 (ok)", "signal 11", "too long", "killed", "500 MB"))
    monkeypatch.setattr(fuzz, "runs", lambda *_: iter(ended[:1]))
    assert bench(["fuzz", "--count", "1"]) == ExitCode.OK
    assert table(ended).row_count == 4

"""The benchmark of the transport terms: its variants differ as they should, and its figures are what it says."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from benchmarks.__main__ import main as bench

from gnrecon.field import TANH, Network
from gnrecon.runtime.errors import ExitCode
from gnrecon.shape_learning import PROBLEMS, catenoid


def test_figures_of_a_small_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(PROBLEMS, "catenoid", lambda: replace(catenoid(), network=Network((8, 8), TANH)))
    out = tmp_path / "figures.json"
    assert bench(["transport", "--problem", "catenoid", "--steps", "0,2", "--json", str(out)]) == ExitCode.OK
    assert "convection" in capsys.readouterr().out
    figures = json.loads(out.read_text())["figures"]
    errors = {(one["step"], one["variant"]): one["error"] for one in figures if "variant" in one}
    assert set(errors) == {(step, kept) for step in (0, 2) for kept in ("neither", "stretch", "convection")}
    # Neither term alone is the whole: each variant is off by something, and none by nothing.
    assert min(errors.values()) > 1e-3
    runs = {one["points"]: one for one in figures if "points" in one}
    assert runs["move"]["chamfer"] != runs["stay"]["chamfer"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [(["--steps", "a"], "numbers of steps"), (["--steps", "0"], "numbers of steps"), (["--problem", "x"], "catenoid")],
)
def test_what_makes_no_sense_is_refused(words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench(["transport", *words]) == ExitCode.USAGE
    assert sentence in capsys.readouterr().err

"""The paper's experiments, a step each: what is finished is not run again, and everything is drawn and listed."""

from __future__ import annotations

import csv
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from reproduction.__main__ import main
from reproduction.figures import coloured, draw_surfaces

from gnrecon.geometry.mesh import Mesh


def test_an_experiment_is_run_once_and_drawn(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    small = partial(draw_surfaces, size=(70, 56), panel=(46, 40))
    monkeypatch.setattr("reproduction.__main__.draw_surfaces", small)
    words = ["-o", str(tmp_path), "--only", "cone", "--steps", "1", "--resolution", "16"]
    assert main(words) == 0
    assert "cone by gn" in capfd.readouterr().err
    made = {path.name for path in tmp_path.iterdir()}
    runs = {f"cone-{name}.{end}" for name in ("gn", "lbfgs", "adam") for end in ("ply", "json", "png")}
    assert made == runs | {"convergence.png", "surfaces.png", "table.csv", "table.md"}
    rows = list(csv.DictReader((tmp_path / "table.csv").read_text().splitlines()))
    assert [row["optimiser"] for row in rows] == ["gn", "lbfgs", "adam"]
    assert rows[0]["authors"] == "5e-11"
    assert all(float(row["loss"]) > 0 for row in rows)
    before = (tmp_path / "cone-gn.json").read_bytes()
    assert main(words) == 0
    said = capfd.readouterr()
    assert "by gn" not in said.err
    assert said.out == (tmp_path / "table.md").read_text()
    assert (tmp_path / "cone-gn.json").read_bytes() == before


def test_missing_data_is_one_sentence(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    assert main(["-o", str(tmp_path), "--only", "bunny-sparse", "--steps", "1"]) == 3
    said = capfd.readouterr().err.splitlines()
    assert said[-1] == "reproduce: The bunny is not part of gnrecon: --data names the folder that holds bun_zipper.ply."
    assert not list(tmp_path.iterdir())


def test_colours_are_white_at_zero() -> None:
    mesh = Mesh(np.zeros((3, 3)), np.zeros((0, 3), dtype=int))
    colors = coloured(mesh, np.array([-2.0, 0.0, 1.0]), 1.0).attributes["colors"]
    assert colors.tolist() == [[33, 102, 172], [247, 247, 247], [178, 24, 43]]
